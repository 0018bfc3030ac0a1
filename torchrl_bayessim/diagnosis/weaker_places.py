"""Another effect in the place of one at the weakest of its places.

A round takes in an effect at all places that together explain most. Where one of them has little to
do, it may be a stopgap: friction of a pole's pivot and a little of the cart's rail may be friction
of the pivot alone, and a battery that sags.
"""

from __future__ import annotations

__all__ = ["without_weaker_places"]

import math
from collections.abc import Sequence
from functools import partial

from ..effects.effect import Effect
from .explanations import compare
from .free_numbers import priced
from .model import LIKELY, WHITE, Model, judged_fits, shown
from .objective import Objective, Unit

_WEAK = 0.05  # of the deviance that the same effect explains at its strongest place
_PLACES = 4  # of one effect: beyond, each is one of many of a kind
_RIVALS = 6  # effects that are tried in the place of one


def without_weaker_places(
    sets: tuple[Objective, Objective],
    best: Model,
    units: Sequence[Unit],
    offered: Sequence[Unit],
) -> Model:
    """Return the best of a model and those with another effect at the weakest place of one of its.

    That has to leave noise alone, to show beside the others, and to explain more than chance would.

    Args:
        sets: Where models are fitted, and where they are judged.
        best: The model.
        units: The effects to consider.
        offered: The effects as they were offered: numbers that were fitted have their price.
    """
    cost = partial(priced, offered=offered, dispersion=best.dispersion())
    found = [best]
    for name in best.names:
        mine = [unit for unit in best.units if unit.name == name]
        places = {unit.where for unit in mine}
        if 1 < len(mine) == len(places) <= _PLACES:
            smaller = judged_fits(*sets, [best.fit.without(unit).point for unit in mine])
            weaker = _without_weakest(best, smaller)
            found += [] if weaker is None else _others(sets, best, weaker, units)
    first = min(found, key=cost)
    return first if cost(best) - cost(first) > LIKELY else best


def _without_weakest(best: Model, smaller: Sequence[Model]) -> Model | None:
    """Return the model without the place that has least to do, of those without each, if little."""
    total = float(best.deviances().sum())
    lost = {float(model.deviances().sum()) - total: model for model in smaller}
    least, most = min(lost), max(lost)
    return lost[least] if math.isfinite(most) and least < _WEAK * most else None


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
    models = judged_fits(*sets, starts, race=best.fit.cost) if starts else []
    return [m for m in models if m.mean_square < WHITE and shown(weaker, m)]
