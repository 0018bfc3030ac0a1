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
from numpy.typing import NDArray

from ..effects.disturbance import Cogging, PeriodicDisturbance
from ..effects.joints import ParallelSpring
from ..effects.units import slides
from .model import LIKELY, Model, judged
from .objective import Objective, Point, Unit
from .refit import refit, with_prior

Array = NDArray[np.float64]
_STEPS = 4  # of Gauss and Newton
_MOVED = 0.05  # rad by which a force is moved to see what that does, at its farthest row
_FARTHEST = 0.5  # rad in one step: sines are not linear
_HARDER = 0.05  # by which a spring's stiffness grows, to see what that does, at its farthest row


@dataclass(frozen=True)
class _Shift:
    """One number of one unit that can be moved, and by how much to see what it does."""

    unit: Unit
    number: str
    width: float
    least: float = -np.inf


def with_fitted_forms(train: Objective, validation: Objective, model: Model) -> Model:
    """Return the model with its periodic forces' frequencies and phases, and its springs, fitted.

    A force ``s sin(a + φ)`` of angle ``a = 2πft`` or ``a = kq`` is linear in small changes of ``φ``
    and of ``f`` or ``k``, and that of a spring, ``−s q (1 + h q²)``, in ``h``; these are solved for
    together with parameters and strengths. On a hinge ``k`` counts whole periods per turn and stays
    as it is. The model itself comes back where nothing is gained that chance would not often give.
    """
    best = model
    for _ in range(_STEPS):
        shifts = _shifts(train, best)
        if not shifts:
            return model
        fitted = refit(train, [_moved(train, best, shifts)], iterations=2)[0]
        gained = best.fit.cost - fitted.cost
        if gained <= 0:
            break
        best = judged(train, validation, [fitted])[0]
        if gained < LIKELY:
            break
    return best if model.fit.cost - best.fit.cost > LIKELY else model


def _shifts(train: Objective, model: Model) -> list[_Shift]:
    """Return what can be moved."""
    robot, segments = train.predictor.system.robot, train.segments
    shifts = []
    for unit in model.units:
        if isinstance(unit.effect, PeriodicDisturbance):
            latest = float(np.abs(segments.time).max())
            shifts.append(_Shift(unit, "frequency", _MOVED / (2 * np.pi * max(latest, 1e-9))))
        elif isinstance(unit.effect, ParallelSpring):
            where = segments.qpos[..., list(robot.qpos_index)][..., np.array(unit.direction) != 0]
            farthest = float(np.abs(where).max())
            shifts.append(_Shift(unit, "hardening", _HARDER / max(farthest, 1e-9) ** 2, 0.0))
            continue
        elif isinstance(unit.effect, Cogging):
            joint = unit.joint(robot)
            if slides(robot, joint):
                where = segments.qpos[..., robot.qpos_index[joint]]
                farthest = float(np.abs(where).max())
                shifts.append(_Shift(unit, "number", _MOVED / max(farthest, 1e-9)))
        else:
            continue
        shifts.append(_Shift(unit, "phase", _MOVED))
    return shifts


def _moved(train: Objective, model: Model, shifts: Sequence[_Shift]) -> Point:
    """Return where one step of Gauss and Newton leads."""
    fit, size = model.fit, len(model.fit.point.z)
    tries = [_with(fit.point, [shift], [shift.width]) for shift in shifts]
    changes = (train(tries) - fit.innovations).reshape(len(shifts), -1)
    columns = np.concatenate([fit.jacobian, changes.T], axis=1)
    left = np.r_[fit.innovations.ravel(), fit.point.z]
    step = -np.linalg.lstsq(with_prior(columns, size), left, rcond=None)[0]
    strengths = {
        unit: unit.inside(fit.point.strengths[unit] + unit.high * step[size + i])
        for i, unit in enumerate(fit.units)
    }
    reach = _FARTHEST / _MOVED
    times = np.clip(step[size + len(fit.units) :], -reach, reach)
    widths = [shift.width * float(t) for shift, t in zip(shifts, times, strict=True)]
    return _with(Point(fit.point.z + step[:size], strengths), shifts, widths)


def _with(point: Point, shifts: Sequence[_Shift], widths: Sequence[float]) -> Point:
    """Return the point with effects whose numbers are moved."""
    forms = {shift.unit: dict(shift.unit.effect.form) for shift in shifts}
    for shift, width in zip(shifts, widths, strict=True):
        moved = forms[shift.unit][shift.number] + width
        forms[shift.unit][shift.number] = max(moved, shift.least)
    others = {u: replace(u, effect=type(u.effect)(**form)) for u, form in forms.items()}
    return Point(point.z, {others.get(u, u): s for u, s in point.strengths.items()})
