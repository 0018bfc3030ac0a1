"""Another effect in the place of one at the weaker of its places.

A round takes in an effect at all places that together explain most. Where one of them has little to
do, it may be a stopgap: friction of a pole's pivot and a little of the cart's rail may be friction
of the pivot alone, and a battery that sags.
"""

from __future__ import annotations

__all__ = ["at_weaker_places"]

from collections.abc import Sequence

from ..effects.effect import Effect
from .explanations import compare
from .model import Model, judged_fits
from .objective import Objective, Point, Unit

_WEAK = 0.05  # of the deviance that the same effect explains at its strongest place
_PLACES = 4  # of one effect: beyond, each is one of many of a kind
_RIVALS = 6  # effects that are tried in the place of one


def at_weaker_places(
    sets: tuple[Objective, Objective], best: Model, units: Sequence[Unit]
) -> list[Model]:
    """Return models with another effect at the weaker places of each effect that is at several.

    Args:
        sets: Where models are fitted, and where they are judged.
        best: The model.
        units: The effects to consider.
    """
    found = []
    for name in best.names:
        mine = [unit for unit in best.units if unit.name == name]
        if 1 < len(mine) <= _PLACES:
            for weaker in _weaker(best, judged_fits(*sets, [_without(best, u) for u in mine])):
                found += _others(sets, best, weaker, units)
    return found


def _without(best: Model, out: Unit) -> Point:
    strengths = best.fit.point.strengths
    return Point(best.fit.point.z, {unit: s for unit, s in strengths.items() if unit != out})


def _weaker(best: Model, smaller: Sequence[Model]) -> list[Model]:
    """Return the models without a place that has little to do, of those without each."""
    total = float(best.deviances().sum())
    lost = [float(model.deviances().sum()) - total for model in smaller]
    return [m for m, loss in zip(smaller, lost, strict=True) if loss < _WEAK * max(lost)]


def _others(
    sets: tuple[Objective, Objective], best: Model, weaker: Model, units: Sequence[Unit]
) -> list[Model]:
    """Return the model without a place, with each of the effects that show most beside it."""
    names = best.names
    left = [unit for unit in units if unit.name not in names]
    first: dict[Effect, tuple[Unit, float]] = {}
    for unit, (_, strength) in compare(sets[0], weaker.fit, left).seen.best(1.0).items():
        if len(first) < _RIVALS:
            first.setdefault(unit.effect, (unit, strength))
    starts = [weaker.fit.point.beside({unit: strength}) for unit, strength in first.values()]
    return judged_fits(*sets, starts, race=best.fit.cost) if starts else []
