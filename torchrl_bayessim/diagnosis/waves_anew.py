"""Waves that are read off anew beside the effects that were found after them.

Frequency and phase of a wave are read off the force that is missing (`shapes`) in the round that
finds it. What was missing then had the other effects in it, too: friction that turns round with the
motion makes a wave of its own, and a fit of the frequency goes to the nearest maximum only.
"""

from __future__ import annotations

__all__ = ["with_waves_anew"]

from collections.abc import Callable, Collection, Sequence

from .form_fit import with_fitted_forms
from .model import LIKELY, WHITE, Model, judged_fits
from .objective import Objective, Point, Unit
from .refit import refit

_STEPS = 4  # of fits without the wave


def with_waves_anew(
    sets: tuple[Objective, Objective],
    model: Model,
    shapes: Callable[[Point], Sequence[Unit]],
    offered: Collection[Unit],
) -> Model:
    """Return the model with other waves in the place of its own, where those explain more.

    Where noise alone is left, or there is nothing else in the model, the model itself.

    Args:
        sets: Where models are fitted, and where they are judged.
        model: With the effects that were found.
        shapes: Returns effects with a frequency or a step, as they are seen beside a model.
        offered: Units with effects as they were offered, of which no number has been fitted.
    """
    if len(model.units) < 2 or model.mean_square < WHITE:
        return model
    for unit in (unit for unit in model.units if unit.effect.placed):
        point = model.fit.point
        others = {u: s for u, s in point.strengths.items() if u != unit}
        base = refit(sets[0], [Point(point.z, others)], iterations=_STEPS)[0].point
        seen = [u for u in shapes(base) if u.place == unit.place and u not in others]
        starts = [
            Point(base.z, {**base.strengths, wave: wave.inside(point.strengths[unit])})
            for wave in seen
        ]
        found = judged_fits(*sets, starts) if starts else []
        race = model.fit.cost
        formed = [with_fitted_forms(*sets, other, offered, race=race) for other in found]
        best = min(formed, key=lambda other: other.fit.cost, default=model)
        if best.fit.cost < model.fit.cost - LIKELY * max(1.0, best.mean_square):
            model = best
    return model
