"""Dampings that bend by a power of speed, in the place of those that bend in proportion to it.

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
    """Return a model's point with laws of a power for dampings that are bent, if any."""
    strengths = dict(model.fit.point.strengths)
    bent = [s for s in shifts_of(train, strengths) if isinstance(s.unit.effect, ViscousFriction)]
    for shift in bent:
        rise, speed = value_of(shift), _MIDDLE / shift.most
        if rise:
            law = PowerLawFriction.like(rise, speed)
            same = strengths.pop(shift.unit) * (1.0 + rise * speed) * speed ** (1.0 - law.power)
            unit = replace(shift.unit, effect=law)
            strengths[unit] = unit.inside(same)
    moved = strengths.keys() != model.fit.point.strengths.keys()
    return Point(model.fit.point.z, strengths) if moved else None
