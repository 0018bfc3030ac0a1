"""What a joint has by itself and a model may lack: friction, damping, a spring, a rotor's inertia.

Strengths are per joint and add to the model's own values. Dry friction is MuJoCo's
``frictionloss``, under which joints stick.
"""

from __future__ import annotations

__all__ = ["Armature", "CoulombFriction", "ParallelSpring", "ViscousFriction"]

from typing import ClassVar

import torch
from torch import Tensor

from .effect import Fields, ModelEffect
from .laws import within
from .robot import Robot


class _Joint(ModelEffect):
    field: ClassVar[str]

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the joints' names."""
        return () if robot.model is None else robot.joints

    def joint(self, robot: Robot, target: int) -> int:
        """Return the joint."""
        del robot
        return target

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Add to the joints' entries."""
        for j, index in enumerate(self._indices(robot)):
            entry = self.field, (index,)
            fields[entry] = fields[entry] + strength[..., j]

    def _indices(self, robot: Robot) -> tuple[int, ...]:
        return robot.dof_index


class CoulombFriction(_Joint):
    """Dry friction of ``s``; N m or N, 0 to 30 % of ``F_max``."""

    name, unit, group, field = "coulomb_friction", "N m", "friction", "dof_frictionloss"

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.3 ``F_max``."""
        return within(robot.force_scale, 0.0, 0.3)


class ViscousFriction(_Joint):
    """Damping ``−s v``; N m s/rad, up to 30 % of ``F_max`` at a quarter of ``v_max``."""

    name, unit, group, field = "viscous_friction", "N m s/rad", "friction", "dof_damping"

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 1.2 ``F_max / v_max``."""
        return within(robot.force_scale / robot.velocity_scale, 0.0, 1.2)


class ParallelSpring(_Joint):
    """A spring ``−s (q − q_ref)``; N m/rad, up to ``F_max`` at the end of the joint's range."""

    name, unit, group, field = "parallel_spring", "N m/rad", "elasticity", "jnt_stiffness"

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and ``F_max`` per range of positions."""
        return within(robot.force_scale / robot.position_scale, 0.0, 1.0)

    def _indices(self, robot: Robot) -> tuple[int, ...]:
        joint = robot.require_model().dof_jntid
        return tuple(int(joint[dof]) for dof in robot.dof_index)


class Armature(_Joint):
    """The inertia of a rotor, seen at the joint; kg m², up to that of what the joint moves."""

    name, unit, group, field = "armature", "kg m²", "inertia", "dof_armature"

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and the joint's inertia at the model's reference position."""
        inertia = robot.require_model().dof_M0[list(robot.dof_index)]
        return within(torch.from_numpy(inertia), 0.0, 1.0)
