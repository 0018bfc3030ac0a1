"""Forces that come from outside or from within a motor, at every time step.

Strengths are per joint, in N m or N; ``F_max`` is the joint's force scale.
"""

from __future__ import annotations

__all__ = ["Cogging", "ConstantForce", "PeriodicDisturbance"]

import math
from collections.abc import Mapping

from torch import Tensor

from .effect import ForceEffect, Memory, Now, Reach
from .laws import within
from .robot import Robot

_MOVED = 0.05  # rad by which an angle is moved to see what that does, at its farthest
_ANY = -math.inf, math.inf


class ConstantForce(ForceEffect):
    """A constant generalised force ``s``: wind, a hanging cable; up to 30 % of ``F_max``."""

    name, unit, group = "constant_force", "N m", "offset"

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return ±0.3 ``F_max``."""
        return within(robot.force_scale, -0.3, 0.3)

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the force."""
        return {"force": strength.expand_as(now.velocity)}, memory


class PeriodicDisturbance(ForceEffect):
    """A force that oscillates with time: ``s sin(2π f t + φ)``; up to 30 % of ``F_max``.

    Args:
        frequency: ``f``, Hz.
        phase: ``φ``, rad.
    """

    name, unit, group = "periodic_disturbance", "N m", "disturbance"

    def __init__(self, frequency: float = 1.0, phase: float = 0.0) -> None:
        self.frequency, self.phase = frequency, phase

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return both."""
        slower = _MOVED / (2 * math.pi * max(reach.time, 1e-9))
        return {"frequency": (slower, *_ANY), "phase": (_MOVED, *_ANY)}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.3 ``F_max``."""
        return within(robot.force_scale, 0.0, 0.3)

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the force at this time."""
        angle = 2 * math.pi * self.frequency * now.time.to(now.velocity) + self.phase
        return {"force": strength * angle.sin()}, memory


class Cogging(ForceEffect):
    """A force that oscillates with a joint's position: ``s sin(k q + φ)``; up to 15 % of ``F_max``.

    Args:
        number: ``k``, periods per turn of a hinge, or per 2π m of a slide.
        phase: ``φ``, rad.
    """

    name, unit, group = "cogging", "N m", "disturbance"

    def __init__(self, number: float = 6, phase: float = 0.0) -> None:
        self.number, self.phase = number, phase

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the phase, and a slide's number; a hinge has whole periods per turn."""
        wider = {"number": (_MOVED / max(reach.position, 1e-9), *_ANY)} if reach.slides else {}
        return wider | {"phase": (_MOVED, *_ANY)}

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the joints' names."""
        return robot.joints

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.15 ``F_max``."""
        return within(robot.force_scale, 0.0, 0.15)

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the force at this angle."""
        return {"force": strength * (self.number * now.position + self.phase).sin()}, memory
