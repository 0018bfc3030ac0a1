"""What the law of an effect in the model has beside its strength, fitted with everything else.

Frequency and phase of a periodic force that are read off the missing force (`shapes`) stand on a
grid, and the force is a mean over short segments, which is late. A phase that is a little off, or a
spring that hardens, leaves a force of its own, which the next round would take for another effect.
"""

from __future__ import annotations

__all__ = [
    "softened",
    "with_fitted_forms",
    "with_forms_anew",
    "with_slopes_of_forms",
]

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from .corners import soft_start, with_corners
from .free_numbers import Shift, shifts_of, value_of
from .model import LIKELY, WHITE, Model, judged, judged_fits, price
from .objective import Objective, Point, Unit
from .powers import by_power
from .refit import Fit, outrun, refit, with_prior

Array = NDArray[np.float64]
_STEPS = 12  # of Gauss and Newton, at most
_AFTER = 3  # steps of a fit after each
_WHITER = 4.0  # times the price of a number, where a model leaves noise alone
_SHORTER = (0.25, 0.05)  # of a step that leads nowhere better
_FARTHEST = 10.0  # times the change that shows, in one step: laws are not linear in these numbers


def with_fitted_forms(
    train: Objective,
    validation: Objective,
    model: Model,
    offered: Collection[Unit],
    *,
    race: float = np.inf,
) -> Model:
    """Return the model with what its effects have free beside their strengths fitted, too.

    What is free (`Effect.free`: the frequency of a periodic force, how a spring hardens) moves the
    innovations linearly where it changes little, and is solved for together with parameters and
    strengths. The model itself comes back where nothing is gained that chance would not often give:
    what bends a law is priced like strengths, several where the law leaves noise alone anyway; what
    was read off a grid, or bent before another effect came in, has been paid for.

    Args:
        train: Where models are fitted.
        validation: Where they are judged.
        model: To start from.
        offered: Units with effects as they were offered, of which no number has been fitted.
        race: Cost of a rival: what is far behind it and does not catch up is fitted no further.
    """
    sets = train, validation
    placed = _fitted(sets, model, lambda shift: shift.paid(offered), race=race)
    count = sum(not shift.paid(offered) for shift in shifts_of(train, placed.units))
    if not count:
        return placed
    needed = price(placed) * (_WHITER if placed.mean_square < WHITE else 1.0)
    fitted = _fitted(sets, placed, needed=LIKELY + count * needed, race=race)
    if fitted is placed:
        return fitted
    return _by_power(sets, with_corners(sets, fitted, offered), race=race)


def _by_power(sets: tuple[Objective, Objective], model: Model, *, race: float) -> Model:
    """Return the model with dampings that bend by a power of speed where that explains more."""
    start = by_power(sets[0], model) if model.mean_square > WHITE else None
    if start is None:
        return model
    (other,) = judged_fits(*sets, [start])
    other = _fitted(sets, other, race=race)
    return other if other.fit.cost < model.fit.cost else model


def softened(
    train: Objective,
    validation: Objective,
    models: Sequence[Model],
    offered: Collection[Unit],
    *,
    most: int,
) -> list[Model]:
    """Return models with laws that bend in the place of those that have a corner, fitted.

    What a limit hardly ever cuts has no slope, and a fit ends where it begins: a soft law leads on,
    and has a corner in the end if that explains as much. Models without such laws are left out.

    Args:
        train: Where models are fitted.
        validation: Where they are judged.
        models: To start from.
        offered: Units with effects as they were offered, of which no number has been fitted.
        most: Of how many models, the first that have such laws.
    """
    each = (soft_start(train, model, offered) for model in models)
    starts = list(islice((start for start in each if start is not None), most))
    soft = judged_fits(train, validation, starts) if starts else []
    return [with_fitted_forms(train, validation, model, offered) for model in soft]


def with_forms_anew(
    train: Objective,
    validation: Objective,
    model: Model,
    offered: Collection[Unit],
    *,
    race: float = np.inf,
) -> Model:
    """Return the model with what is free fitted again, once another effect has been taken out.

    What was bent to make up for that effect is straight again where it need not be bent: laws are
    fitted from how they were offered, too, and stay that way unless the bent ones explain more.
    Arguments are those of `with_fitted_forms`.
    """
    sets = train, validation
    bent = with_fitted_forms(*sets, model, offered, race=race)
    shifts = [s for s in shifts_of(train, model.units) if s.paid(offered) and not s.placed]
    if not shifts:
        return bent
    changes = [_nearest_offered(shift, offered) - value_of(shift) for shift in shifts]
    start = _of_offered_kinds(_with(model.fit.point, shifts, changes), offered)
    (straight,) = judged_fits(*sets, [start])
    straight = with_fitted_forms(*sets, straight, offered, race=race)
    return straight if straight.fit.cost < bent.fit.cost + price(model) else bent


def _of_offered_kinds(point: Point, offered: Collection[Unit]) -> Point:
    """Return the point with offered laws in the place of those of a kind that was not offered."""
    kinds = {type(unit.effect) for unit in offered}
    plain = {unit.place: unit for unit in reversed(list(offered))}
    strengths = {}
    for unit, strength in point.strengths.items():
        other = unit if type(unit.effect) in kinds else plain.get(unit.place, unit)
        strengths[other] = other.inside(strength)
    return Point(point.z, strengths)


def _nearest_offered(shift: Shift, offered: Collection[Unit]) -> float:
    """Return the number as it was offered, the nearest where it was with several."""
    values = [v for v in shift.offered(offered) if shift.least <= v <= shift.most]
    return min(values, key=lambda value: abs(value - value_of(shift)), default=value_of(shift))


def with_slopes_of_forms(train: Objective, model: Model, offered: Collection[Unit]) -> Model:
    """Return the model with the derivatives of its fit by the numbers that were fitted.

    A strength is known less well beside them: a spring that is softer and hardens more is much the
    same spring.
    """
    shifts = [shift for shift in shifts_of(train, model.units) if shift.paid(offered)]
    if not shifts:
        return model
    return replace(model, fit=replace(model.fit, slopes=_slopes(train, model.fit, shifts)[0]))


def _fitted(
    sets: tuple[Objective, Objective],
    model: Model,
    moves: Callable[[Shift], bool] = lambda _: True,
    *,
    needed: float = LIKELY,
    race: float = np.inf,
) -> Model:
    """Return the model with what is free fitted, or itself where that gains too little.

    Args:
        sets: Where models are fitted, and judged.
        model: To start from.
        moves: Which numbers are fitted.
        needed: Deviance to gain.
        race: Cost of a rival.
    """
    train, best = sets[0], model
    for _ in range(_STEPS):
        shifts = [shift for shift in shifts_of(train, best.units) if moves(shift)]
        if not shifts:
            break
        whole, *shorter = _moved(train, best, shifts)
        fitted = _refitted(train, best.fit, [whole])
        if fitted.cost >= best.fit.cost:
            fitted = _refitted(train, best.fit, shorter)
        gained = best.fit.cost - fitted.cost
        if gained <= 0:
            break
        (best,) = judged(*sets, [fitted])
        if gained < LIKELY * max(1.0, best.mean_square) or outrun(best.fit.cost, gained, race):
            break
    if model.fit.cost - best.fit.cost <= needed:
        return model
    return replace(best, fit=refit(train, [best.fit.point], iterations=0)[0])


def _refitted(train: Objective, known: Fit, starts: Sequence[Point]) -> Fit:
    """Return the best of fits from starts near a known one, whose derivatives they begin with."""
    origins = []
    for start in starts:  # the known one in units of the laws that there are now
        strengths = dict(zip(start.strengths, known.point.strengths.values(), strict=True))
        before = Point(known.point.z, strengths)
        origins.append(replace(known, point=before, units=tuple(strengths)))
    return min(refit(train, starts, origins=origins, iterations=_AFTER), key=lambda f: f.cost)


def _moved(train: Objective, model: Model, shifts: Sequence[Shift]) -> list[Point]:
    """Return where one step of Gauss and Newton leads, and shorter ones."""
    fit, size = model.fit, len(model.fit.point.z)
    slopes, widths = _slopes(train, fit, shifts)
    columns = np.concatenate([fit.jacobian, slopes], axis=1)
    left = np.r_[fit.innovations.ravel(), fit.point.z]
    step = -np.linalg.lstsq(with_prior(columns, size), left, rcond=None)[0]
    moves = np.clip(step[size + len(fit.units) :], -_FARTHEST, _FARTHEST) * widths
    points = []
    for part in (1.0, *_SHORTER):
        strengths = {
            unit: unit.inside(fit.point.strengths[unit] + part * unit.high * step[size + i])
            for i, unit in enumerate(fit.units)
        }
        there = Point(fit.point.z + part * step[:size], strengths)
        points.append(_with(there, shifts, (part * moves).tolist()))
    return points


def _slopes(train: Objective, fit: Fit, shifts: Sequence[Shift]) -> tuple[Array, list[float]]:
    """Return what a change of each number does, ``(S·KC, N)``, and the changes."""
    widths = [_inwards(shift) for shift in shifts]
    tries = [_with(fit.point, [s], [w]) for s, w in zip(shifts, widths, strict=True)]
    return (train(tries) - fit.innovations).reshape(len(shifts), -1).T, widths


def _inwards(shift: Shift) -> float:
    """Return the change that shows, away from the end that the number may be at."""
    return -shift.width if value_of(shift) + shift.width > shift.most else shift.width


def _with(point: Point, shifts: Sequence[Shift], widths: Sequence[float]) -> Point:
    """Return the point with effects whose numbers are moved."""
    forms = {shift.unit: dict(shift.unit.effect.form) for shift in shifts}
    for shift, width in zip(shifts, widths, strict=True):
        moved = float(np.clip(value_of(shift) + width, shift.least, shift.most))
        forms[shift.unit][shift.number] = moved
    others = {u: replace(u, effect=type(u.effect)(**form)) for u, form in forms.items()}
    return Point(point.z, {others.get(u, u): s for u, s in point.strengths.items()})
