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
_SAME = 0.02  # of a rate: a fit goes there by itself


def with_waves_anew(
    sets: tuple[Objective, Objective],
    model: Model,
    shapes: Callable[[Point], Sequence[Unit]],
    offered: Collection[Unit],
) -> Model:
    """Return the model with other waves in the place of its own, where those explain more.

    Of several each in turn. Where noise alone is left, or nothing else is in the model, the model
    itself.

    Args:
        sets: Where models are fitted, and where they are judged.
        model: With the effects that were found.
        shapes: Returns effects with a frequency or a step, as they are seen beside a model.
        offered: Units with effects as they were offered, of which no number has been fitted.
    """
    for place in [unit.place for unit in model.units if unit.effect.placed]:
        if len(model.units) < 2 or model.mean_square < WHITE:
            break
        # a fit of the one before has moved this one's numbers, too
        wave = next(unit for unit in model.units if unit.place == place)
        other = _anew(sets, model, wave, shapes, offered=offered)
        if other is not None:
            model = other
    return model


def _anew(
    sets: tuple[Objective, Objective],
    model: Model,
    wave: Unit,
    shapes: Callable[[Point], Sequence[Unit]],
    *,
    offered: Collection[Unit],
) -> Model | None:
    """Return the model with a wave of another rate that explains more, if there is one."""
    base = refit(sets[0], [model.fit.without(wave).point], iterations=_STEPS)[0].point
    seen = [u for u in shapes(base) if u.place == wave.place and not _same_rate(u, wave)]
    starts = [base.beside({u: u.inside(model.fit.point.strengths[wave])}) for u in seen]
    found = judged_fits(*sets, starts) if starts else []
    formed = [with_fitted_forms(*sets, m, offered, race=model.fit.cost) for m in found]
    best = min(formed, key=lambda m: m.fit.cost, default=model)
    gained = model.fit.cost - best.fit.cost
    return best if gained > LIKELY * max(1.0, best.mean_square) else None


def _same_rate(one: Unit, other: Unit) -> bool:
    """Return whether two waves have the same frequency, or number, but for 2 %."""
    rate = one.effect.placed[0]
    mine, others = one.effect.form[rate], other.effect.form[rate]
    return abs(mine - others) < _SAME * others
