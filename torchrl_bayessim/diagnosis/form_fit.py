"""What the law of an effect in the model has beside its strength, fitted with everything else.

Frequency and phase of a periodic force that are read off the missing force (`shapes`) stand on a
grid, and the force is a mean over short segments, which is late. A phase that is a little off, or a
spring that hardens, leaves a force of its own, which the next round would take for another effect.
"""

from __future__ import annotations

__all__ = ["with_fitted_forms"]

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..effects.effect import Reach
from ..effects.units import slides
from .model import LIKELY, WHITE, Model, judged, price
from .objective import Objective, Point, Unit
from .refit import refit, with_prior

_STEPS = 4  # of Gauss and Newton
_WHITER = 4.0  # times the price of a number, where a model leaves noise alone
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
    def bends(self) -> bool:
        """Whether it bends a law, rather than places a wave."""
        return bool(np.isfinite(self.least))


def with_fitted_forms(train: Objective, validation: Objective, model: Model) -> Model:
    """Return the model with what its effects have free beside their strengths fitted, too.

    What is free (`Effect.free`: the frequency of a periodic force, how a spring hardens) moves the
    innovations linearly where it changes little, and is solved for together with parameters and
    strengths. The model itself comes back where nothing is gained that chance would not often give:
    what bends a law is priced like strengths, several where the law leaves noise alone anyway; what
    was read off a grid has been paid for.
    """
    placed = _fitted((train, validation), model, bends=False)
    count = sum(shift.bends for shift in _shifts(train, placed))
    if not count:
        return placed
    needed = price(placed) * (_WHITER if placed.mean_square < WHITE else 1.0)
    return _fitted((train, validation), placed, bends=True, needed=LIKELY + count * needed)


def _fitted(
    sets: tuple[Objective, Objective], model: Model, *, bends: bool, needed: float = LIKELY
) -> Model:
    """Return the model with what is free fitted, or itself where that gains too little.

    Args:
        sets: Where models are fitted, and judged.
        model: To start from.
        bends: Whether what bends a law is fitted too.
        needed: Deviance to gain.
    """
    train, best = sets[0], model
    for _ in range(_STEPS):
        shifts = [shift for shift in _shifts(train, best) if bends or not shift.bends]
        if not shifts:
            return model
        fitted = refit(train, [_moved(train, best, shifts)], iterations=2)[0]
        gained = best.fit.cost - fitted.cost
        if gained <= 0:
            break
        (best,) = judged(*sets, [fitted])
        if gained < LIKELY:
            break
    return best if model.fit.cost - best.fit.cost > needed else model


def _shifts(train: Objective, model: Model) -> list[_Shift]:
    """Return what can be moved."""
    return [
        _Shift(unit, number, *bounds)
        for unit in model.units
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
    return Reach(position, velocity, time, slides(robot, joint))


def _moved(train: Objective, model: Model, shifts: Sequence[_Shift]) -> Point:
    """Return where one step of Gauss and Newton leads."""
    fit, size = model.fit, len(model.fit.point.z)
    widths = [_inwards(shift) for shift in shifts]
    tries = [_with(fit.point, [s], [w]) for s, w in zip(shifts, widths, strict=True)]
    changes = (train(tries) - fit.innovations).reshape(len(shifts), -1)
    columns = np.concatenate([fit.jacobian, changes.T], axis=1)
    left = np.r_[fit.innovations.ravel(), fit.point.z]
    step = -np.linalg.lstsq(with_prior(columns, size), left, rcond=None)[0]
    strengths = {
        unit: unit.inside(fit.point.strengths[unit] + unit.high * step[size + i])
        for i, unit in enumerate(fit.units)
    }
    times = np.clip(step[size + len(fit.units) :], -_FARTHEST, _FARTHEST).tolist()
    steps = [width * time for width, time in zip(widths, times, strict=True)]
    return _with(Point(fit.point.z + step[:size], strengths), shifts, steps)


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
