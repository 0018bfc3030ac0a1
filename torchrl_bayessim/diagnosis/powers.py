"""A damping that bends by a power of speed, in the place of one that bends in proportion to it.

A lubricant that thins rubs by a power of speed below 1, which is steep at rest. In proportion to
speed it is that nowhere, and what it lacks near rest looks like dry friction.
"""

from __future__ import annotations

__all__ = ["by_power"]

from dataclasses import replace

from ..effects.friction import PowerLawFriction
from ..effects.joints import ViscousFriction
from .free_numbers import shifts_of, value_of
from .model import Model
from .objective import Objective, Point

_MIDDLE = 0.3  # of the largest speed: where both laws are the same


def by_power(train: Objective, model: Model) -> Point | None:
    """Return a model's point with the law of a power for a damping that is bent, if there is one.

    Only where it is the one damping of the model: strengths of laws of several powers, or of these
    and straight ones, are no strengths of one effect.
    """
    strengths = model.fit.point.strengths
    every = [unit for unit in strengths if unit.name == ViscousFriction.name]
    shifts = [s for s in shifts_of(train, every) if isinstance(s.unit.effect, ViscousFriction)]
    if len(every) != 1 or not shifts or not value_of(shifts[0]):
        return None
    (bent,), (shift,) = every, shifts
    rise, speed = value_of(shift), _MIDDLE / shift.most
    law = PowerLawFriction.like(rise, speed)
    unit = replace(bent, effect=law)
    same = strengths[bent] * (1.0 + rise * speed) * speed ** (1.0 - law.power)
    instead = {bent: (unit, unit.inside(same))}
    return Point(model.fit.point.z, dict(instead.get(u, (u, s)) for u, s in strengths.items()))
