"""What a joint has by itself and a model may lack: friction, damping, a spring, a rotor's inertia.

Strengths are per joint and add to the model's own values. Dry friction is MuJoCo's
``frictionloss``, under which joints stick.
"""

from __future__ import annotations

__all__ = ["Armature", "CoulombFriction", "ParallelSpring", "ViscousFriction"]

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..physics.dry_friction import may_follow, reference
from .effect import Effect, Fields, ModelEffect, Reach
from .friction import PowerLawFriction, PreslidingFriction
from .laws import within
from .robot import Robot

# MuJoCo's damping in proportion to speed, and stiffness in proportion to the angle's square
_BY_SPEED, _BY_SQUARE = ("dof_dampingpoly", (0,)), ("jnt_stiffnesspoly", (1,))
_STEP = 0.05  # of a force at the farthest, to see what a change of the law does


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
        _add(fields, (self.field, ()), self._indices(robot), strength)

    def _indices(self, robot: Robot) -> tuple[int, ...]:
        return robot.dof_index


class CoulombFriction(_Joint):
    """Dry friction of ``s``; N m or N, 0 to 30 % of ``F_max``.

    In joints without dry friction of their own it turns round with the velocity, see
    `dry_friction`; in others it does as the model's own does.

    By the same name, with an option ``presliding``: `friction.PreslidingFriction`.
    """

    name, unit, group, field = "coulomb_friction", "N m", "friction", "dof_frictionloss"

    @classmethod
    def law(cls, **options: Any) -> Effect:
        """Return dry friction, with presliding if that is among the options."""
        return PreslidingFriction(**options) if options else cls()

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return the law without and with presliding."""
        del seconds
        return self, PreslidingFriction()

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Add to the joints' dry friction, which follows the velocity where there was none."""
        indices = self._indices(robot)
        free = [may_follow(fields[self.field, (d,)], fields["dof_solref", (d, 0)]) for d in indices]
        super().write(fields, strength, robot)
        for j, dof in enumerate(indices):
            new = free[j] & (strength[..., j] != 0)
            if not new.any():  # a replay's model has all its joints follow
                continue
            timestep = float(fields["opt.timestep", ()].flatten()[0])
            for (name, column), value in reference(timestep).items():
                entry = name, (dof, *column)
                fields[entry] = torch.where(new, value, fields[entry])

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.3 ``F_max``."""
        return within(robot.force_scale, 0.0, 0.3)


class ViscousFriction(_Joint):
    """Damping ``−s v (1 + r |v|)``; N m s/rad, up to 30 % of ``F_max`` at a quarter of ``v_max``.

    By the same name, with an option ``power``: `friction.PowerLawFriction`.

    Args:
        rise: ``r``, s/rad or s/m; negative for grease that thins. A diagnosis fits it.
    """

    name, unit, group, field = "viscous_friction", "N m s/rad", "friction", "dof_damping"

    def __init__(self, rise: float = 0.0) -> None:
        self.rise = rise

    @classmethod
    def law(cls, **options: Any) -> Effect:
        """Return the damping, by a power of speed if that is among the options."""
        return PowerLawFriction(**options) if "power" in options else cls(**options)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the rise: from half to twice the damping at the largest speed."""
        slowest = 1 / max(reach.velocity, 1e-9)
        return {"rise": (_STEP * slowest, -0.5 * slowest, slowest)}

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Add to the joints' damping, and to that in proportion to speed."""
        super().write(fields, strength, robot)
        if self.rise:
            _add(fields, _BY_SPEED, self._indices(robot), self.rise * strength)

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 1.2 ``F_max / v_max``."""
        return within(robot.force_scale / robot.velocity_scale, 0.0, 1.2)


class ParallelSpring(_Joint):
    """A spring ``−s x (1 + h x²)``, ``x = q − q_ref``; N m/rad, up to ``F_max`` at the range's end.

    Args:
        hardening: ``h``, rad⁻² or m⁻²; a diagnosis fits it.
    """

    name, unit, group, field = "parallel_spring", "N m/rad", "elasticity", "jnt_stiffness"

    def __init__(self, hardening: float = 0.0) -> None:
        self.hardening = hardening

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the hardening."""
        return {"hardening": (_STEP / max(reach.position, 1e-9) ** 2, 0.0, float("inf"))}

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Add to the joints' stiffness, and to that in proportion to the square of the angle."""
        super().write(fields, strength, robot)
        if self.hardening:
            _add(fields, _BY_SQUARE, self._indices(robot), self.hardening * strength)

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


def _add(
    fields: Fields, column: tuple[str, tuple[int, ...]], indices: tuple[int, ...], values: Tensor
) -> None:
    """Add values ``(*batch, J)`` to a field, or to a column of it."""
    name, rest = column
    for j, index in enumerate(indices):
        entry = name, (index, *rest)
        fields[entry] = fields[entry] + values[..., j]
