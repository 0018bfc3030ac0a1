"""What an explanation does not need: effects taken out again, one at a time.

A forward search takes in what makes up for what it has not found yet. Afterwards every effect has
to show that the model needs it.
"""

from __future__ import annotations

__all__ = ["eliminated", "parts", "without_idle", "without_stopgaps"]

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from .form_fit import with_forms_anew
from .free_numbers import bendable, priced
from .model import (
    LIKELY,
    WHITE,
    Model,
    as_good,
    criterion,
    gain,
    judged,
    judged_fits,
    shown,
)
from .objective import Objective, Point, Unit
from .refit import refit

_IDLE = 1e-3  # of the deviance that an effect explains at another place
# deviance without an effect per that with it, that of a segment, and that with it, where judged
_TIMES, _PLAIN, _WORSE = 10.0, 40.0, 1.5
_EVENT = 1000.0  # deviance that a segment has of what happens once
_NOISY = 1.5  # times what noise leaves of a segment
_APART = 3  # effects without each of which a model is fitted with derivatives of its own


def eliminated(train: Objective, validation: Objective, model: Model) -> tuple[Model, list[Model]]:
    """Take out, one at a time, units without which the data are explained as well."""
    tried: list[Model] = []
    while model.units:
        smaller = _without_each(train, validation, model)
        tried += smaller
        criteria = [criterion(m, model.dispersion()) for m in smaller]
        best = int(np.argmin(criteria))
        worse = criteria[best] > criterion(model, model.dispersion())
        needs = any(speaks(smaller[best], model) for speaks in (shown, _without_doubt, _one_event))
        if worse and needs:
            idle = _idle_place(model, smaller)
            if idle is None:
                break
            best = idle
        model = smaller[best]
    there = refit(train, [model.fit.point], iterations=0)[0]
    return replace(model, fit=there), tried


def _without_doubt(smaller: Model, model: Model) -> bool:
    """Return whether the runs of the fit need what the runs that judge may never have excited.

    A speed limit shows where the robot is fast, which may have been in other runs. What only makes
    up for another cause does not bring what is left down to noise.
    """
    mine, others = model.deviances(), smaller.deviances()
    several = len(np.unique(model.logs[others - mine > _PLAIN])) > 1
    held_out = float((model.validation**2).sum()) < _WORSE * float((smaller.validation**2).sum())
    return several and held_out and float(others.sum()) > _TIMES * float(mine.sum())


def _one_event(smaller: Model, model: Model) -> bool:
    """Return whether a unit brings down to noise a segment that is far from it without.

    A speed limit may be met once in all runs. A law that is not the true one would not follow what
    that does there from step to step, where it is ever so much more than noise.
    """
    mine, others = ((m.fit.innovations**2).sum(-1) for m in (model, smaller))
    once = int((others - mine).argmax())
    far = others[once] - mine[once] > _EVENT and others[once] > _TIMES * mine[once]
    noise = mine[once] < _NOISY * model.fit.innovations.shape[1] and model.mean_square < WHITE
    return bool(far and noise and gain(smaller, model) > -LIKELY)


def _without_each(train: Objective, validation: Objective, model: Model) -> list[Model]:
    """Return the model without each of its units, fitted."""
    without = [model.fit.without(unit) for unit in model.units]
    few = len(without) <= _APART
    fits = refit(train, [fit.point for fit in without], origins=without, renew=few)
    return judged(train, validation, fits)


def without_idle(train: Objective, validation: Objective, model: Model) -> Model:
    """Return a model without the places of an effect that next to nothing is due to."""
    while len(model.names) < len(model.units):
        smaller = _without_each(train, validation, model)
        idle = _idle_place(model, smaller)
        if idle is None:
            break
        model = smaller[idle]
    return model


def _idle_place(model: Model, smaller: Sequence[Model]) -> int | None:
    """Return the unit of an effect at several places which next to nothing is due to, if any.

    Where a model is a little off everywhere, any strength mends some of it, surely and for nothing.

    Args:
        model: With all units.
        smaller: Without each of them.
    """
    names = [unit.name for unit in model.units]
    total = model.deviances().sum()
    lost = [float(m.deviances().sum() - total) for m in smaller]
    least = int(np.argmin(lost))
    alike = [loss for loss, name in zip(lost, names, strict=True) if name == names[least]]
    return least if len(alike) > 1 and lost[least] < _IDLE * max(alike) else None


def parts(
    train: Objective,
    validation: Objective,
    model: Model,
    *,
    of: Callable[[Collection[Unit]], bool] = lambda _: True,
) -> list[Model]:
    """Return the model without each of its effects, fitted.

    Args:
        train: Where models are fitted.
        validation: Where they are judged.
        model: With all effects.
        of: Told what is left: whether that is asked for.
    """
    strengths = model.fit.point.strengths
    without = [
        {u: s for u, s in strengths.items() if u.name != out}
        for out in dict.fromkeys(unit.name for unit in strengths)
    ]
    starts = [Point(model.fit.point.z, left) for left in without if of(left)]
    return judged_fits(train, validation, starts)


def without_stopgaps(
    train: Objective, validation: Objective, model: Model, offered: Collection[Unit]
) -> Model:
    """Return the model without effects that others replace, or nearly, with laws fitted anew.

    A magnet's pull over a short way makes up for how a spring hardens, and beside it the spring
    need not harden.

    Args:
        train: Where models are fitted.
        validation: Where they are judged.
        model: To start from.
        offered: Units with effects as they were offered, of which no number has been fitted.
    """
    anew = partial(with_forms_anew, train, validation, offered=offered)
    while len(model.names) > 1:
        smaller = [
            fitted
            for part in parts(train, validation, model, of=lambda left: bendable(train, left))
            if (fitted := anew(part, race=model.fit.cost)) is not part
        ]
        dispersion = model.dispersion()
        cost = partial(priced, offered=offered, dispersion=dispersion)
        instead = [m for m in smaller if cost(m) < cost(model) or as_good(model, m)]
        if not instead:
            break
        model = min(instead, key=cost)
    return model
