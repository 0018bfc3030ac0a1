"""The rotor of a motor, and what lies between it and its joint: what all such laws share.

A rotor of inertia ``I``, the nominal armature of a motor that has its joint for itself, and a load
of ``M = J − I``, for the inertia ``J`` at the joint in the model's initial pose, move against each
other. What this motion ``x`` takes of the motor's force ``F`` the joint gets later: ``F − I ẍ``
passes, of each time step the mean, so that steps may be longer than what happens within. The rotor
also lags behind where other forces move the joint: ``I ẍ`` loses ``I a`` for the joint's
acceleration ``a`` that ``F − I ẍ`` does not explain, as it was a time step ago.
"""

from __future__ import annotations

__all__ = ["at_rest", "handed_on", "lag", "reduced", "rotors", "seen"]

from collections.abc import Mapping
from functools import lru_cache

import torch
from torch import Tensor

from .effect import Memory, Now
from .history import filled
from .robot import Robot
from .transmission import at_actuators, change, servos

_ROBOTS = 16  # whose inertias are kept: laws ask at every time step


def handed_on(passed: Tensor, now: Now) -> Mapping[str, Tensor]:
    """Return the change of commands, and what is beyond their limits as forces at the joints.

    A rotor that is stopped may exert more than its motor.
    """
    changed = change(passed, now)
    command = now.command + changed["command"]
    beyond = passed - now.actuators.force(command, now.position, now.actuator_velocity)
    return {**changed, "force": beyond @ now.actuators.moment}


def at_rest(unknown: Tensor) -> Memory:
    """Return the memory of nothing seen yet."""
    return {"velocity": unknown, "passed": torch.zeros_like(unknown)}


def seen(passed: Tensor, now: Now) -> Memory:
    """Return what the next time step has to know of this one."""
    return {"velocity": now.actuator_velocity.expand_as(passed), "passed": passed}


def lag(memory: Memory, now: Now) -> Tensor:
    """Return ``I a J / M``, the force that keeps the rotor with a joint that others move.

    Never more than the motor's largest force, so that where ``I`` and ``J`` are not those of the
    simulator it does not grow for ever.
    """
    largest, _, gear = now.robot.actuator_limits
    own = memory["passed"] * gear**2 / _inertia(now.robot)
    before = filled(memory["velocity"], now.actuator_velocity)
    moved = (now.actuator_velocity - before) / now.timestep
    behind = (_kept_along(now.robot) * (moved - own)).clamp(-largest, largest)
    return torch.where(memory["velocity"].isnan(), 0.0, behind)


@lru_cache(_ROBOTS)
def _kept_along(robot: Robot) -> Tensor:
    """Return ``I J / M`` as each actuator has it, by the square of its gear.

    Where the rotor is more than a third of the inertia, ``J / 2``: an error of ``J``, which depends
    on the pose, would come back larger.
    """
    _, _, gear = robot.actuator_limits
    rotor, inertia = rotors(robot), _inertia(robot)
    return torch.minimum(rotor * inertia / (inertia - rotor), inertia / 2) / gear**2


@lru_cache(_ROBOTS)
def _inertia(robot: Robot) -> Tensor:
    """Return the inertia ``J`` at the joint of each actuator."""
    model = robot.require_model()
    return at_actuators(torch.from_numpy(model.dof_M0[list(robot.dof_index)]), robot)


@lru_cache(_ROBOTS)
def rotors(robot: Robot) -> Tensor:
    """Return the rotor's part of that, the armature ``I``; none of servos and of shared joints.

    A servo measures at the rotor or at the joint, nobody says which, and reacts to what the spring
    does. Nor where it is most of the inertia: the load's own, which moves against it, then is what
    is left of ``J`` in a pose, and nothing that one number tells.
    """
    model, joints = robot.require_model(), robot.joint_of_actuator
    armature = at_actuators(torch.from_numpy(model.dof_armature[list(robot.dof_index)]), robot)
    armature = torch.where(armature > _inertia(robot) / 2, 0.0, armature)
    for i, joint in enumerate(joints):
        if joints.count(joint) > 1 or i in servos(robot):
            armature[i] = 0.0
    return armature


@lru_cache(_ROBOTS)
def reduced(robot: Robot) -> Tensor:
    """Return ``μ`` at the joint of each actuator, ``J`` where there is no armature."""
    rotor, inertia = rotors(robot), _inertia(robot)
    both = rotor * (inertia - rotor) / inertia
    return torch.where(both > 0, both, inertia)
