"""What a drive does to the force of its motor, at every time step: a speed limit, a servo's laws.

Each changes the force ``F`` that an actuator exerts to another, ``F'``, by way of the command that
exerts it, ``u' = u + (F' − F) / g`` for the force per unit of command ``g``: so it works for motors
and for servos alike. Strengths are per actuator.
"""

from __future__ import annotations

__all__ = [
    "ServoDeadBand",
    "ServoGain",
    "TorqueSpeedLimit",
    "TransmissionEffect",
    "at_actuators",
    "change",
    "driven",
    "servo_damping",
    "servos",
]

from collections.abc import Mapping

import torch
from torch import Tensor

from .effect import ForceEffect, Memory, Now, Reach
from .robot import Robot


def driven(robot: Robot) -> list[int]:
    """Return the actuators whose force is a known function of command, position and velocity.

    Those that move a hinge or a slide, without dynamics of their own, by a constant gain.
    """
    model = robot.model
    if model is None:
        return []
    return [
        i
        for i, joint in enumerate(robot.joint_of_actuator)
        if joint >= 0
        and model.actuator_dyntype[i] == 0  # mjDYN_NONE
        and model.actuator_gaintype[i] == 0  # mjGAIN_FIXED
        and model.actuator_biastype[i] in (0, 1)  # mjBIAS_NONE, mjBIAS_AFFINE
        and model.actuator_gainprm[i, 0] != 0
    ]


def servos(robot: Robot) -> list[int]:
    """Return the actuators whose force grows with the distance from a commanded position."""
    model = robot.model
    return [] if model is None else [i for i in driven(robot) if model.actuator_biasprm[i, 1] != 0]


class TransmissionEffect(ForceEffect):
    """Acts on the force of actuators."""

    channel = "actuation"

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the actuators' names, none if the force of one is not known."""
        return robot.actuators if len(driven(robot)) == len(robot.actuators) else ()

    def joint(self, robot: Robot, target: int) -> int:
        """Return the joint that the actuator moves."""
        return robot.joint_of_actuator[target]


def at_actuators(values: Tensor, robot: Robot) -> Tensor:
    """Return values of joints for the actuators that move them."""
    return values[list(robot.joint_of_actuator)]


def change(force: Tensor, now: Now) -> Mapping[str, Tensor]:
    """Return the change of commands under which actuators exert ``force``, within their limits."""
    # of a command that is beyond its limits, all that is beyond has to go first
    missing = (force - now.demanded_force) / now.actuator_gain
    return {"command": torch.where(force == now.actuator_force, 0.0, missing)}


class TorqueSpeedLimit(TransmissionEffect):
    """A motor loses torque with speed: ``|F| ≤ F_max clip(1.2 − s |v| / v_max, 0.05, 1)``.

    Where it drives (``F v > 0``); ``F_max`` is the actuator's largest force and ``v_max`` the
    joint's velocity scale.
    A number from 0 to 6: the straight line of a DC motor between stall and no load. A model does
    not tell how fast its motors are; 1.2 is as fast as the velocity scale, 6 a fifth of that.

    Args:
        power: Of ``s |v| / v_max`` in the law; 1 for the straight line. A diagnosis fits it.
    """

    name, unit, group = "torque_speed_limit", "fraction", "gain"
    limit = True

    def __init__(self, power: float = 1.0) -> None:
        self.power = power

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the power."""
        del reach
        return {"power": (0.02, 0.5, 4.0)}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 6."""
        one = torch.ones(len(robot.actuators), dtype=torch.float64)
        return 0.0 * one, 6.0 * one

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the change of commands."""
        largest, fastest, _ = now.robot.actuator_limits
        speed = now.actuator_velocity / fastest
        share = (1.2 - (strength * speed.abs()) ** self.power).clamp(0.05, 1.0)
        limited = now.actuator_force.clamp(-share * largest, share * largest)
        drives = (share < 1) & (now.actuator_force * speed > 0)
        return change(torch.where(drives, limited, now.actuator_force), now), memory


class _OfServos(TransmissionEffect):
    """What acts on the force of servos, with the part that is their damping or without it."""

    damped: bool

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the actuators' names, none if the force of one is not known."""
        names = super().targets(robot)
        return names if self.damped or (names and bool(servo_damping(robot).any())) else ()

    def _error(self, now: Now) -> Tensor:
        """Return the force per unit of command: of a servo the distance from its target."""
        force = now.actuator_force
        if not self.damped:
            force = force - servo_damping(now.robot).to(force) * now.actuator_velocity
        return force / now.actuator_gain


class ServoGain(_OfServos):
    """A servo is stiffer or softer than told: its force is ``(1 + s) F``.

    A fraction, −0.5 to 0.5. In the logs it is as if all that the servo moves were lighter.

    Args:
        servo: Always; what tells it from a factor on the target, `ActionGain`.
        damped: Whether its damping changes with it. Otherwise ``F`` is the spring's force alone;
            only servos with damping have that.
    """

    name, unit, group = "action_gain", "fraction", "gain"

    def __init__(self, *, servo: bool = True, damped: bool = True) -> None:
        self.servo, self.damped = servo, damped

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the actuators' names, none if no servo is among them."""
        return super().targets(robot) if servos(robot) else ()

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return −0.5 and 0.5, and nothing for motors."""
        half = torch.zeros(len(robot.actuators), dtype=torch.float64)
        half[servos(robot)] = 0.5
        return -half, half

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the change of commands."""
        return {"command": strength * self._error(now)}, memory


class ServoDeadBand(_OfServos):
    """A servo does nothing within ``s`` of its target, and elsewhere acts as if that much nearer.

    ``e' = sgn(e) max(|e| − s, 0)`` for the error ``e = F / g``, the force per unit of command: of a
    position servo the distance from its target, less what its damping adds; of a motor the command,
    as in `DeadBand`. In units of the command, up to 0.1 (6°).

    Args:
        damped: Whether the servo's damping is lost within the band too. Otherwise ``e`` is the
            distance alone, and the damping acts everywhere; only servos with damping have that.
    """

    name, unit, group = "dead_band", "command", "dead zone"
    stage = 18  # of the error, before the gain of the force that it makes

    def __init__(self, *, damped: bool = True) -> None:
        self.damped = damped

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and a tenth of a unit or of ``u_max``."""
        wide = 0.1 * robot.command_scale.clamp(max=1.0)
        return torch.zeros_like(wide), wide

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the change of commands."""
        return {"command": -self._error(now).clamp(-strength, strength)}, memory


def servo_damping(robot: Robot) -> Tensor:
    """Return the force of each actuator per unit of its velocity."""
    model = robot.require_model()
    return torch.from_numpy(model.actuator_biasprm[:, 2] * (model.actuator_biastype != 0))
