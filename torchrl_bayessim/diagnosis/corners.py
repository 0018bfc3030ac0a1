"""Laws with a corner, such as a limit, and the soft ones that lead a fit to them."""

from __future__ import annotations

__all__ = ["is_corner", "soft_start", "with_corners"]

from collections.abc import Collection

import numpy as np

from ..effects.effect import ActionEffect
from .free_numbers import Shift, shifts_of, value_of
from .model import Model, judged_fits, price
from .objective import Objective, Point, Unit

_LITTLE = 0.05  # of a law's range, to begin with


def soft_start(train: Objective, model: Model, offered: Collection[Unit]) -> Point | None:
    """Return a model's point with soft laws, of little strength, for those with a corner, if any.

    Nothing where it has none. Of effects on commands only: dry friction has a slope.
    """
    sharp, laws = (
        [unit for unit in units if isinstance(unit.effect, ActionEffect)]
        for units in (model.units, offered)
    )
    if not sharp:
        return None
    bends = [shift for shift in shifts_of(train, laws) if shift.least > 0.0]
    instead = {u: next((s.unit for s in bends if is_corner(u, s)), None) for u in sharp}
    if not any(instead.values()):
        return None
    strengths: dict[Unit, float] = {}
    for unit, strength in model.fit.point.strengths.items():
        soft = instead.get(unit)
        side = np.sign(strength) or 1.0
        strengths[soft or unit] = soft.inside(_LITTLE * side * soft.high) if soft else strength
    return Point(model.fit.point.z, strengths)


def with_corners(
    sets: tuple[Objective, Objective], model: Model, offered: Collection[Unit]
) -> Model:
    """Return the model with laws that have a corner in the place of those as sharp as can be.

    From afar only a soft law leads there: a limit that hardly ever cuts has no slope.
    """
    for shift in shifts_of(sets[0], model.units):
        if not 0.0 < value_of(shift) <= shift.least:
            continue
        corner = next((unit for unit in offered if is_corner(unit, shift)), None)
        if corner is not None:
            strengths = model.fit.point.strengths
            other = {corner if u == shift.unit else u: s for u, s in strengths.items()}
            start = Point(model.fit.point.z, {u: u.inside(s) for u, s in other.items()})
            (sharp,) = judged_fits(*sets, [start])
            # a number less, too
            model = sharp if sharp.fit.cost < model.fit.cost + price(model) else model
    return model


def is_corner(unit: Unit, shift: Shift) -> bool:
    """Return whether a unit is what the other becomes where its bend has no width.

    The same effect at the same place, the same but for that number, which is 0 or which it has not.
    """
    soft = shift.unit
    if unit.place != soft.place:
        return False
    mine, others = dict(unit.effect.form), dict(soft.effect.form)
    del others[shift.number]
    return not mine.pop(shift.number, 0.0) and mine == others
