"""Laws that fit better than the best explanation, bent to the data.

They lost because they predict worse: the length of a wave that is not quite the true one fits the
way that a joint went in some runs, and not how far it went in others. What is judged by other runs
loses to whatever errs in both alike.
"""

from __future__ import annotations

__all__ = ["fitted_best"]

from collections.abc import Collection, Sequence

from .form_fit import with_fitted_forms
from .free_numbers import bendable
from .model import LIKELY, WHITE, Model
from .objective import Objective, Unit

_MOST = 2  # models, for time's sake


def fitted_best(
    sets: tuple[Objective, Objective],
    better: Model | None,
    models: Sequence[Model],
    offered: Collection[Unit],
) -> list[Model]:
    """Return what fits better than a model that leaves more than noise, with its laws fitted.

    Args:
        sets: Where models are fitted, and where they are judged.
        better: The model; nothing is returned where there is none.
        models: All that were fitted.
        offered: Units with effects as they were offered, of which no number has been fitted.
    """
    if better is None or better.mean_square < WHITE:
        return []
    most = better.fit.cost - LIKELY * better.fit.mean_square
    near = [m for m in models if m.fit.cost < most and bendable(sets[0], m.units)]
    near = sorted(near, key=lambda model: model.fit.cost)[:_MOST]
    formed = [with_fitted_forms(*sets, model, offered) for model in near]
    return [model for model in formed if model not in near]
