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
_STILL = 1e-3  # rad or m: what moves less says nothing of a wave's length
_OVERTONES: Mapping[str, tuple[float, float, float]] = dict.fromkeys(
    ("sine2", "cosine2", "sine3", "cosine3"), (0.05, -1.0, 1.0)
)


class _Wave(ForceEffect):
    """A wave with overtones, ``sin a + Σₙ (bₙ sin na + cₙ cos na)`` for n = 2, 3."""

    def __init__(
        self,
        phase: float,
        *,
        sine2: float = 0.0,
        cosine2: float = 0.0,
        sine3: float = 0.0,
        cosine3: float = 0.0,
    ) -> None:
        self.phase = phase
        self.sine2, self.cosine2 = sine2, cosine2
        self.sine3, self.cosine3 = sine3, cosine3

    def _wave(self, angle: Tensor) -> Tensor:
        wave = (angle + self.phase).sin()
        for n, b, c in ((2, self.sine2, self.cosine2), (3, self.sine3, self.cosine3)):
            if b or c:
                turned = n * (angle + self.phase)
                wave = wave + b * turned.sin() + c * turned.cos()
        return wave


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


class PeriodicDisturbance(_Wave):
    """A force that oscillates with time: ``s w(2π f t + φ)``; up to 30 % of ``F_max``.

    ``w`` is a sine, or a wave with the overtones ``w(a) = sin a + Σₙ (bₙ sin na + cₙ cos na)``.

    Args:
        frequency: ``f``, Hz.
        phase: ``φ``, rad.
        sine2: ``b₂``. A diagnosis fits these, with ``f`` and ``φ``.
        cosine2: ``c₂``.
        sine3: ``b₃``.
        cosine3: ``c₃``.
    """

    name, unit, group = "periodic_disturbance", "N m", "disturbance"
    placed = ("frequency", "phase")

    def __init__(self, frequency: float = 1.0, phase: float = 0.0, **overtones: float) -> None:
        self.frequency = frequency
        super().__init__(phase, **overtones)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return all of its options."""
        slower = _MOVED / (2 * math.pi * max(reach.time, 1e-9))
        return {"frequency": (slower, *_ANY), "phase": (_MOVED, *_ANY), **_OVERTONES}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.3 ``F_max``."""
        return within(robot.force_scale, 0.0, 0.3)

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the force at this time."""
        angle = 2 * math.pi * self.frequency * now.time.to(now.velocity)
        return {"force": strength * self._wave(angle)}, memory


class Cogging(_Wave):
    """A force that oscillates with a joint's position: ``s w(k q + φ)``; up to 15 % of ``F_max``.

    ``w`` is a sine, or a wave with overtones as of a `PeriodicDisturbance`.

    Args:
        number: ``k``, periods per turn of a hinge, or per 2π m of a slide.
        phase: ``φ``, rad.
        sine2: ``b₂``. A diagnosis fits these, with ``k`` and ``φ``, also where they were given.
        cosine2: ``c₂``.
        sine3: ``b₃``.
        cosine3: ``c₃``.
    """

    name, unit, group = "cogging", "N m", "disturbance"
    placed = ("number", "phase")

    def __init__(self, number: float = 6, phase: float = 0.0, **overtones: float) -> None:
        self.number = number
        super().__init__(phase, **overtones)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return all of its options.

        Of a slide at least half a period lies within twice its distance from zero: what is longer
        is a spring. A hinge has at least two per turn, as one is gravity's; behind a gear they need
        not be whole.
        """
        far = 2 * max(reach.position, _STILL)
        least = min(math.pi / far if reach.slides else 2.0, self.number)
        return {
            "number": (2 * _MOVED / far, least, math.inf),
            "phase": (_MOVED, *_ANY),
            **_OVERTONES,
        }

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
        return {"force": strength * self._wave(self.number * now.position)}, memory
