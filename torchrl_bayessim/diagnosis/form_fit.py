"""What the law of an effect in the model has beside its strength, fitted with everything else.

Frequency and phase of a periodic force that are read off the missing force (`shapes`) stand on a
grid, and the force is a mean over short segments, which is late. A phase that is a little off, or a
spring that hardens, leaves a force of its own, which the next round would take for another effect.
"""

from __future__ import annotations

__all__ = [
    "bendable",
    "fitted_numbers",
    "priced",
    "softened",
    "with_fitted_forms",
    "with_forms_anew",
    "with_slopes_of_forms",
]

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import Reach
from ..effects.units import slides
from .model import LIKELY, WHITE, Model, criterion, judged, judged_fits, numbers, price
from .objective import Objective, Point, Unit
from .refit import Fit, outrun, refit, with_prior

Array = NDArray[np.float64]
_STEPS = 12  # of Gauss and Newton, at most
_AFTER = 3  # steps of a fit after each
_WHITER = 4.0  # times the price of a number, where a model leaves noise alone
_SHORTER = (0.25, 0.05)  # of a step that leads nowhere better
_LITTLE = 0.05  # of a law's range, to begin with
_FARTHEST = 10.0  # times the change that shows, in one step: laws are not linear in these numbers


@dataclass(frozen=True)
class _Shift:
    """One number of one unit that can be moved: how far to see what that does, and at most."""

    unit: Unit
    number: str
    width: float
    least: float
    most: float

    @property
    def placed(self) -> bool:
        """Whether it was read off the data before the effect was offered, and is priced with it."""
        return self.number in self.unit.effect.placed

    def paid(self, offered: Collection[Unit]) -> bool:
        """Return whether it is fitted anyway, or has been: of a wave, or none that was offered."""
        if self.placed or self.number in self.unit.effect.nuisances:
            return True
        return _value(self) not in self.offered(offered)

    def offered(self, units: Collection[Unit]) -> set[float]:
        """Return the values that it was offered with, of the same law."""
        alike = (u.effect for u in units if type(u.effect) is type(self.unit.effect))
        return {float(effect.form[self.number]) for effect in alike}


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
    count = sum(not shift.paid(offered) for shift in _shifts(train, placed.units))
    if not count:
        return placed
    needed = price(placed) * (_WHITER if placed.mean_square < WHITE else 1.0)
    fitted = _fitted(sets, placed, needed=LIKELY + count * needed, race=race)
    return fitted if fitted is placed else _with_corners(sets, fitted, offered)


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
    each = (_soft(train, model, offered) for model in models)
    starts = list(islice((start for start in each if start is not None), most))
    soft = judged_fits(train, validation, starts) if starts else []
    return [with_fitted_forms(train, validation, model, offered) for model in soft]


def _soft(train: Objective, model: Model, offered: Collection[Unit]) -> Point | None:
    """Return a model's point with soft laws, of little strength, for those with a corner, if any.

    Nothing where it has none.
    """
    bends = [shift for shift in _shifts(train, offered) if shift.least > 0.0]
    instead = {
        unit: next((shift.unit for shift in bends if _is_corner(unit, shift)), None)
        for unit in model.units
    }
    if not any(instead.values()):
        return None
    strengths: dict[Unit, float] = {}
    for unit, strength in model.fit.point.strengths.items():
        soft = instead[unit]
        side = np.sign(strength) or 1.0
        strengths[soft or unit] = soft.inside(_LITTLE * side * soft.high) if soft else strength
    return Point(model.fit.point.z, strengths)


def _with_corners(
    sets: tuple[Objective, Objective], model: Model, offered: Collection[Unit]
) -> Model:
    """Return the model with laws that have a corner in the place of those as sharp as can be.

    From afar only a soft law leads anywhere: what saturates hardly ever has no slope.
    """
    for shift in _shifts(sets[0], model.units):
        if not 0.0 < _value(shift) <= shift.least:
            continue
        corner = next((unit for unit in offered if _is_corner(unit, shift)), None)
        if corner is not None:
            strengths = model.fit.point.strengths
            other = {corner if u == shift.unit else u: s for u, s in strengths.items()}
            start = Point(model.fit.point.z, {u: u.inside(s) for u, s in other.items()})
            (sharp,) = judged_fits(*sets, [start])
            # a number less, too
            model = sharp if sharp.fit.cost < model.fit.cost + price(model) else model
    return model


def _is_corner(unit: Unit, shift: _Shift) -> bool:
    """Return whether a unit is what the other becomes where its bend has no width.

    The same effect at the same place, the same but for that number, which is 0 or which it has not.
    """
    soft = shift.unit
    if (unit.name, unit.where, unit.direction) != (soft.name, soft.where, soft.direction):
        return False
    mine, others = dict(unit.effect.form), dict(soft.effect.form)
    del others[shift.number]
    return not mine.pop(shift.number, 0.0) and mine == others


def bendable(train: Objective, units: Iterable[Unit]) -> bool:
    """Return whether the law of any of the units has a number that bends it."""
    return any(
        set(unit.effect.free(_reach(train, unit))) - set(unit.effect.placed) for unit in units
    )


def priced(model: Model, offered: Collection[Unit], *, dispersion: float = 1.0) -> float:
    """Return the criterion, and a price for each number of a law that was fitted."""
    return criterion(model, dispersion) + sum(_bent(u, offered) for u in model.units) * price(model)


def fitted_numbers(model: Model, offered: Collection[Unit]) -> int:
    """Return how many numbers its effects have that were fitted: strengths, and those of laws."""
    return numbers(model) + sum(_bent(unit, offered) for unit in model.units)


def _bent(unit: Unit, offered: Collection[Unit]) -> int:
    """Return how many numbers of a law are none that it was offered with, but for placed ones."""
    alike = [u.effect.form for u in offered if type(u.effect) is type(unit.effect)]
    if not alike:
        return 0
    return sum(
        number in unit.effect.nuisances or value not in [form[number] for form in alike]
        for number, value in unit.effect.form.items()
        if number not in unit.effect.placed
    )


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
    shifts = [s for s in _shifts(train, model.units) if s.paid(offered) and not s.placed]
    if not shifts:
        return bent
    changes = [_nearest_offered(shift, offered) - _value(shift) for shift in shifts]
    (straight,) = judged_fits(*sets, [_with(model.fit.point, shifts, changes)])
    straight = with_fitted_forms(*sets, straight, offered, race=race)
    return straight if straight.fit.cost < bent.fit.cost + price(model) else bent


def _nearest_offered(shift: _Shift, offered: Collection[Unit]) -> float:
    """Return the number as it was offered, the nearest where it was with several."""
    values = [v for v in shift.offered(offered) if shift.least <= v <= shift.most]
    return min(values, key=lambda value: abs(value - _value(shift)), default=_value(shift))


def with_slopes_of_forms(train: Objective, model: Model, offered: Collection[Unit]) -> Model:
    """Return the model with the derivatives of its fit by the numbers that were fitted.

    A strength is known less well beside them: a spring that is softer and hardens more is much the
    same spring.
    """
    shifts = [shift for shift in _shifts(train, model.units) if shift.paid(offered)]
    if not shifts:
        return model
    return replace(model, fit=replace(model.fit, slopes=_slopes(train, model.fit, shifts)[0]))


def _fitted(
    sets: tuple[Objective, Objective],
    model: Model,
    moves: Callable[[_Shift], bool] = lambda _: True,
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
        shifts = [shift for shift in _shifts(train, best.units) if moves(shift)]
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


def _shifts(train: Objective, units: Iterable[Unit]) -> list[_Shift]:
    """Return what can be moved."""
    return [
        _Shift(unit, number, *bounds)
        for unit in units
        for number, bounds in unit.effect.free(_reach(train, unit)).items()
    ]


def _reach(train: Objective, unit: Unit) -> Reach:
    """Return how far the robot went where a unit acts, at any of the joints if at several."""
    robot, segments = train.predictor.system.robot, train.segments
    joint = unit.joint(robot)
    joints = [joint] if joint >= 0 else list(range(len(robot.joints)))
    places = [robot.qpos_index[j] for j in joints], [robot.dof_index[j] for j in joints]
    position, velocity = (
        float(np.abs(states[..., list(columns)]).max(initial=0.0))
        for states, columns in zip((segments.qpos, segments.qvel), places, strict=True)
    )
    time = float(np.abs(segments.time).max())
    return Reach(position, velocity, time, all(slides(robot, j) for j in joints))


def _moved(train: Objective, model: Model, shifts: Sequence[_Shift]) -> list[Point]:
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


def _slopes(train: Objective, fit: Fit, shifts: Sequence[_Shift]) -> tuple[Array, list[float]]:
    """Return what a change of each number does, ``(S·KC, N)``, and the changes."""
    widths = [_inwards(shift) for shift in shifts]
    tries = [_with(fit.point, [s], [w]) for s, w in zip(shifts, widths, strict=True)]
    return (train(tries) - fit.innovations).reshape(len(shifts), -1).T, widths


def _inwards(shift: _Shift) -> float:
    """Return the change that shows, away from the end that the number may be at."""
    return -shift.width if _value(shift) + shift.width > shift.most else shift.width


def _value(shift: _Shift) -> float:
    return float(shift.unit.effect.form[shift.number])


def _with(point: Point, shifts: Sequence[_Shift], widths: Sequence[float]) -> Point:
    """Return the point with effects whose numbers are moved."""
    forms = {shift.unit: dict(shift.unit.effect.form) for shift in shifts}
    for shift, width in zip(shifts, widths, strict=True):
        moved = float(np.clip(_value(shift) + width, shift.least, shift.most))
        forms[shift.unit][shift.number] = moved
    others = {u: replace(u, effect=type(u.effect)(**form)) for u, form in forms.items()}
    return Point(point.z, {others.get(u, u): s for u, s in point.strengths.items()})
