"""What force effects add in one time step, for a batch of simulations of one model.

The laws speak of joints and actuators; a simulator wants additions to ``qfrc_applied``,
``dof_frictionloss`` and ``dof_damping``, one number per degree of freedom, and to ``ctrl``.
Actuator forces are computed from the state before the step, ``gain · ctrl + bias``, as in MuJoCo.
"""

from __future__ import annotations

__all__ = ["Forcing"]

from collections.abc import Sequence
from types import SimpleNamespace

import torch
from torch import Tensor

from ..envs.task import Readings
from .effect import ForceEffect, Memory, Now
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
        self._qpos, self._dofs = list(robot.qpos_index), list(robot.dof_index)
        # joint forces per actuator force, shape (A, J)
        self._moment = torch.zeros(model.nu, len(self._dofs), dtype=torch.float64)
        for i, joint in enumerate(robot.joint_of_actuator):
            if joint >= 0:
                self._moment[i, joint] = float(model.actuator_gear[i, 0])
        self._gain = torch.from_numpy(model.actuator_gainprm[:, 0].copy())
        affine = torch.from_numpy(model.actuator_biastype != 0)[:, None]
        self._bias = torch.where(affine, torch.from_numpy(model.actuator_biasprm[:, :3].copy()), 0)
        self._ctrl_limits = _limits(model.actuator_ctrllimited, model.actuator_ctrlrange)
        self._force_limits = _limits(model.actuator_forcelimited, model.actuator_forcerange)

    def start(self, active: Active, state: Readings) -> list[Memory]:
        """Return the memories at the beginning, for the batch of ``state``."""
        velocity = state.qvel[..., self._dofs]
        return [effect.start(velocity) for effect, _ in active]

    def __call__(
        self, active: Active, memories: Sequence[Memory], state: Readings
    ) -> tuple[dict[str, Tensor], list[Memory]]:
        """Return what is added in the coming time step, and the memories after it.

        Args:
            active: Effects and their strengths, shape ``(*batch, N)``. A change of commands is
                seen by the effects that follow.
            memories: As returned by `start` or the last call.
            state: ``qpos``, ``qvel``, ``time`` and ``ctrl``, shape ``(*batch, size)``.

        Returns:
            Any of ``qfrc_applied``, ``dof_frictionloss`` and ``dof_damping``, ``(*batch, nv)``, and
            ``ctrl``, ``(*batch, nu)``.
        """
        now = self._now(state)
        added: dict[str, Tensor] = {}
        after = []
        for (effect, strength), memory in zip(active, memories, strict=True):
            given, new = effect.forces(strength, memory, now)
            after.append(new)
            for kind, value in given.items():
                if kind == "command":
                    added["ctrl"] = added["ctrl"] + value if "ctrl" in added else value
                    self._command(now, now.command + value)
                else:
                    name = _WHERE[kind]
                    if name not in added:
                        shape = (*torch.broadcast_shapes(value.shape, now.velocity.shape)[:-1],)
                        added[name] = value.new_zeros(*shape, self._nv)
                    added[name][..., self._dofs] += value
        return added, after

    def _now(self, state: Readings) -> Now:
        now = SimpleNamespace(robot=self.robot, timestep=self._timestep, noise=None)
        now.time = state.time
        now.position = state.qpos[..., self._qpos]
        now.velocity = state.qvel[..., self._dofs]
        now.actuator_gain = self._gain
        now.actuator_velocity = now.velocity @ self._moment.T
        self._command(now, state.ctrl)
        return now

    def _command(self, now: Now, command: Tensor) -> None:
        """Set the command, and the forces that it exerts."""
        now.command = command
        low, high = self._ctrl_limits
        length = now.position @ self._moment.T
        force = self._gain * command.clamp(low, high)
        force = force + self._bias[:, 0] + self._bias[:, 1] * length
        force = force + self._bias[:, 2] * now.actuator_velocity
        now.actuator_force = force.clamp(*self._force_limits)
        now.load = now.actuator_force @ self._moment


def _limits(limited: object, ranges: object) -> tuple[Tensor, Tensor]:
    on = torch.as_tensor(limited).bool()
    low, high = torch.as_tensor(ranges).double().unbind(-1)
    infinite = torch.full_like(low, torch.inf)
    return torch.where(on, low, -infinite), torch.where(on, high, infinite)
