"""What force effects add in one time step, for a batch of simulations of one model.

The laws speak of joints and actuators; a simulator wants additions to ``qfrc_applied``,
``dof_frictionloss`` and ``dof_damping``, one number per degree of freedom, and to ``ctrl``.
Actuator forces are computed from the state before the step, ``gain · ctrl + bias``, as in MuJoCo.
"""

from __future__ import annotations

__all__ = ["Forcing"]

from collections.abc import Sequence
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor

from ..envs.bias_forces import BeforeStep
from ..envs.task import Readings
from .effect import ForceEffect, Memory
from .robot import Robot

_WHERE = {
    "force": "qfrc_applied",
    "frictionloss": "dof_frictionloss",
    "damping": "dof_damping",
}
Active = Sequence[tuple[ForceEffect, Tensor]]


class Forcing:
    """Turns force effects into additions to a simulator's arrays.

    Example:
        >>> from torchrl_bayessim.effects.catalogue import effect
        >>> from torchrl_bayessim.effects.robot import robot_of
        >>> from torchrl_bayessim.envs.tasks.catalogue import known_task
        >>> forcing = Forcing(robot_of(known_task("InvertedPendulum-v5")))
        >>> active = [(effect("constant_force"), torch.tensor([[0.0, 0.2]]).double())]
        >>> state = Readings(
        ...     qpos=torch.zeros(1, 2).double(), qvel=torch.zeros(1, 2).double(),
        ...     ctrl=torch.zeros(1, 1).double(), time=torch.zeros(1, 1).double())
        >>> added, memories = forcing(active, forcing.start(active, state), state)
        >>> added
        {'qfrc_applied': tensor([[0.0000, 0.2000]], dtype=torch.float64)}

    Args:
        robot: A robot with a model.

    Raises:
        ValueError: The robot has no model.
    """

    def __init__(self, robot: Robot) -> None:
        model = robot.require_model()
        self.robot, self._nv, self._timestep = robot, model.nv, float(model.opt.timestep)
        self._qpos, self._dofs = _at(robot.qpos_index), _at(robot.dof_index)
        self._actuators = _Actuators(robot)

    def start(self, active: Active, state: Readings) -> list[Memory]:
        """Return the memories at the beginning, for the batch of ``state``."""
        velocity = self.velocity(state)
        return [effect.start(velocity) for effect, _ in active]

    def lasting(self, active: Active, memories: Sequence[Memory], state: Readings) -> list[int]:
        """Return which effects remember anything, or change commands that those see.

        Memories are the same without the others.
        """
        now = self._now(state, self._timestep)
        return [
            i
            for i, ((effect, strength), memory) in enumerate(zip(active, memories, strict=True))
            if memory or "command" in effect.forces(strength, memory, now)[0]
        ]

    def velocity(self, state: Readings) -> Tensor:
        """Return the joints' velocities, shape ``(*batch, J)``."""
        return state.qvel[..., self._dofs]

    def __call__(
        self,
        active: Active,
        memories: Sequence[Memory],
        state: Readings,
        *,
        timestep: float | None = None,
    ) -> tuple[dict[str, Tensor], list[Memory]]:
        """Return what is added in the coming time step, and the memories after it.

        Args:
            active: Effects and their strengths, shape ``(*batch, N)``. A change of commands is
                seen by the effects that follow.
            memories: As returned by `start` or the last call.
            state: ``qpos``, ``qvel``, ``time`` and ``ctrl``, shape ``(*batch, size)``; and
                ``qfrc_bias`` where a law looks at it.
            timestep: Seconds until the next call; default the model's time step.

        Returns:
            Any of ``qfrc_applied``, ``dof_frictionloss`` and ``dof_damping``, ``(*batch, nv)``, and
            ``ctrl``, ``(*batch, nu)``.
        """
        now = self._now(state, self._timestep if timestep is None else timestep)
        added: dict[str, Tensor] = {}
        after = []
        for (effect, strength), memory in zip(active, memories, strict=True):
            given, new = effect.forces(strength, memory, now)
            after.append(new)
            for kind, value in given.items():
                if kind == "command":
                    added["ctrl"] = added["ctrl"] + value if "ctrl" in added else value
                    now = now.under(now.command + value)
                else:
                    name = _WHERE[kind]
                    if name not in added:
                        shape = np.broadcast_shapes(value.shape, now.velocity.shape)[:-1]
                        added[name] = value.new_zeros(*shape, self._nv)
                    added[name][..., self._dofs] += value
        return added, after

    def _now(self, state: Readings, timestep: float) -> _TimeStep:
        return _TimeStep(
            robot=self.robot,
            timestep=timestep,
            time=state.time,
            position=state.qpos[..., self._qpos],
            velocity=self.velocity(state),
            command=state.ctrl,
            actuator_gain=self._actuators.gain,
            actuators=self._actuators,
            noise=None,
            state=state,
            dofs=self._dofs,
        )


class _TimeStep(SimpleNamespace):
    """What laws may look at; forces of actuators are computed when one does."""

    def under(self, command: Tensor) -> _TimeStep:
        """Return the same time step under another command."""
        values = vars(self) | {"command": command}
        computed = "actuator_force", "demanded_force", "load"
        return _TimeStep(**{k: v for k, v in values.items() if k not in computed})

    @cached_property
    def actuator_velocity(self) -> Tensor:
        return self.velocity @ self.actuators.moment.T

    @cached_property
    def actuator_force(self) -> Tensor:
        return self.actuators.force(self.command, self.position, self.actuator_velocity)

    @cached_property
    def demanded_force(self) -> Tensor:
        return self.actuators.demanded(self.command, self.position, self.actuator_velocity)

    @cached_property
    def bias(self) -> Tensor:
        return self.state.qfrc_bias[..., self.dofs]

    def bias_of(self, some: Tensor) -> Tensor:
        if isinstance(self.state, BeforeStep):
            return self.state.bias_of(some)[..., self.dofs]
        return self.bias

    @cached_property
    def load(self) -> Tensor:
        return self.actuator_force @ self.actuators.moment


class _Actuators:
    """Actuators as MuJoCo computes them: a gain and an affine bias, within limits."""

    def __init__(self, robot: Robot) -> None:
        model = robot.require_model()
        # joint forces per actuator force, shape (A, J)
        self.moment = torch.zeros(model.nu, len(robot.joints), dtype=torch.float64)
        for i, joint in enumerate(robot.joint_of_actuator):
            if joint >= 0:
                self.moment[i, joint] = float(model.actuator_gear[i, 0])
        self.gain = torch.from_numpy(model.actuator_gainprm[:, 0].copy())
        affine = torch.from_numpy(model.actuator_biastype != 0)[:, None]
        self._bias = torch.where(affine, torch.from_numpy(model.actuator_biasprm[:, :3].copy()), 0)
        self._servos = bool(self._bias[:, 1:].any())
        self._command_limits = _limits(model.actuator_ctrllimited, model.actuator_ctrlrange)
        self._force_limits = _limits(model.actuator_forcelimited, model.actuator_forcerange)

    def force(self, command: Tensor, position: Tensor, velocity: Tensor) -> Tensor:
        """Return the force of each, given joint positions and the actuators' own velocities."""
        force = self.demanded(command.clamp(*self._command_limits), position, velocity)
        return force.clamp(*self._force_limits)

    def demanded(self, command: Tensor, position: Tensor, velocity: Tensor) -> Tensor:
        """Return the same without limits."""
        force = self.gain * command + self._bias[:, 0]
        if self._servos:
            force = force + self._bias[:, 1] * (position @ self.moment.T)
            force = force + self._bias[:, 2] * velocity
        return force


def _at(indices: Sequence[int]) -> slice | list[int]:
    """Return where numbers are, as a slice if they follow each other: a view costs less."""
    first, count = min(indices, default=0), len(indices)
    inside = tuple(indices) == tuple(range(first, first + count))
    return slice(first, first + count) if inside else list(indices)


def _limits(limited: object, ranges: object) -> tuple[Tensor, Tensor]:
    on = torch.as_tensor(limited).bool()
    low, high = torch.as_tensor(ranges).double().unbind(-1)
    infinite = torch.full_like(low, torch.inf)
    return torch.where(on, low, -infinite), torch.where(on, high, infinite)
