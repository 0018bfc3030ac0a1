r"""What varies by chance beside effects that were found: it counts as noise, and hides less then.

A strength that wavers from segment to segment, or a delay that is another at each command or
sample, leaves errors that no simulation imitates, and they hide what else is missing. So they widen
the covariance: with :math:`r_i` the innovations that the effects leave in segment :math:`i`,
:math:`c_{ui}` what unit :math:`u` changes there altogether, :math:`d_{ir}` what draw :math:`r` of
an effect of chance changes, and :math:`e_{ik}` what a second of delay changes in row :math:`k`
alone, they are taken as

.. math::
    r_i \sim N(0, I + \Sigma_i), \quad \Sigma_i = \sigma_u^2 c_{ui} c_{ui}^T,
    \quad \tfrac{1}{R - 1} \sum_r (d_{ir} - \bar d_i)(d_{ir} - \bar d_i)^T
    \quad \text{or} \quad \tau^2 \sum_k e_{ik} e_{ik}^T,

with the likeliest unit and size (random coefficients, Swamy 1970; a synthetic likelihood, Wood
2010). What is the same in all segments stands out of that more clearly than out of white noise.
"""

from __future__ import annotations

__all__ = ["Varying", "varying", "widened", "with_variation"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..effects.action import ActionDelay
from ..effects.sensors import SensorDelay
from .cells import plain
from .chance import drawn
from .model import WHITE, Model
from .modes import Mode
from .moved_innovations import scattered
from .objective import Objective, Point, Unit, strengths_of
from .preparation import Prepared
from .refit import refit

Array = NDArray[np.float64]
_PARTS = np.geomspace(0.02, 0.5, 12)  # of a strength that wavers: standard deviations
_LEVELS = (0.05, 0.12, 0.25, 0.5, 1.0)  # of the range of an effect of chance
_TIMES = np.geomspace(0.02, 0.6, 12)  # of a control step: standard deviations
_STEP = 0.1  # of a strength, to see what it changes
_DRAWS = 32
_LATE = ActionDelay.group
_NEEDED = 20.0  # deviance
_AGAIN = 4  # steps of fits
_WIDENED = "train", "validation"
_NOTE = "{}: that counts as noise here, beside which more was found"


@dataclass(frozen=True, eq=False)
class Varying:
    """What varies, and the directions in which innovations vary with it.

    Attributes:
        what: In words, with its size.
        group: Of the effect that varies.
        roots: By name of the split, shape ``(S, M, R)``: ``Σ_i = roots_i roots_iᵀ``.
    """

    what: str
    group: str
    roots: Mapping[str, Array]


def varying(
    prepared: Prepared, best: Model, offered: Sequence[Unit], random: Sequence[Unit]
) -> Varying | None:
    """Return what makes the innovations likeliest that a model leaves, if it is surely something.

    Args:
        prepared: The segments.
        best: With the effects that were found.
        offered: Effects that last, at their targets.
        random: Effects of chance, of which those that are late may vary what is late.
    """
    if not best.units or best.mean_square < WHITE or type(prepared.mode) is not Mode:
        return None
    sets = {name: prepared.sets[name] for name in _WIDENED}
    point = best.fit.point
    found = [one for unit in best.units for one in _wavering(sets, point, unit)]
    if any(unit.effect.group == _LATE for unit in best.units):
        found += _sampled(sets, point, offered)
        found += [o for u in random if u.effect.group == _LATE for o in _drawn(sets, point, u)]
    left = {name: one.unweighted([point])[0] for name, one in sets.items()}
    costs = [sum(_cost(left[name], root) for name, root in one.roots.items()) for one in found]
    least = int(np.argmin(costs))
    nothing = sum(float((one**2).sum()) for one in left.values())
    return found[least] if nothing - costs[least] > _NEEDED else None


def with_variation(prepared: Prepared, found: Varying) -> Prepared:
    """Return the same with a covariance of training and validation segments so much wider.

    Test segments keep theirs: what varies is a part of the gap.

    Args:
        prepared: With noise alone.
        found: What varies.
    """
    return widened(prepared.alarmed(_NOTE.format(found.what)), found.roots)


def widened(prepared: Prepared, roots: Mapping[str, Array]) -> Prepared:
    """Return the same with a covariance of some splits that is wider, by roots ``(S, M, R)``."""
    sets = dict(prepared.sets)
    for name, root in roots.items():
        sets[name] = _widened(sets[name], root)
    nominal = refit(sets["train"], [prepared.nominal.point], iterations=_AGAIN)[0]
    return replace(prepared, sets=sets, nominal=nominal, varied=True)


def _wavering(sets: Mapping[str, Objective], point: Point, unit: Unit) -> list[Varying]:
    """Return a strength that is another in each segment, by several parts of itself."""
    change = {name: _change(one, point, unit)[..., None] for name, one in sets.items()}
    what = f"{plain(unit.name)} at {unit.where} varies by {{:.0f}} % of itself"
    return [
        Varying(
            what.format(100 * part),
            unit.effect.group,
            {name: part * each for name, each in change.items()},
        )
        for part in _PARTS
    ]


def _change(objective: Objective, point: Point, unit: Unit) -> Array:
    """Return what a unit changes altogether, as far as a small part of it tells, ``(S, M)``."""
    less = point.beside({unit: (1 - _STEP) * point.strengths[unit]})
    now, before = objective.unweighted([point, less])
    return np.asarray((now - before) / _STEP, dtype=np.float64)


def _sampled(sets: Mapping[str, Objective], point: Point, offered: Sequence[Unit]) -> list[Varying]:
    """Return samples each of which is late by another time."""
    late = [unit for unit in offered if isinstance(unit.effect, SensorDelay)]
    unit = next((unit for unit in late if unit.where == "all" or len(late) == 1), None)
    if unit is None:
        return []
    dt = next(iter(sets.values())).predictor.system.control_dt
    rows = {name: _by_rows(one, point, unit, _STEP * dt) for name, one in sets.items()}
    return [
        Varying(
            f"samples are late by times that vary by {part * dt:.2g} s",
            _LATE,
            {name: part * dt * each for name, each in rows.items()},
        )
        for part in _TIMES
    ]


def _by_rows(objective: Objective, point: Point, unit: Unit, step: float) -> Array:
    """Return what a second of delay changes at each row, and at the start, ``(S, M, K + 1)``."""
    predictor, segments = objective.predictor, objective.segments
    late = strengths_of([Point(point.z, {unit: step})], predictor.system.robot)
    ahead = predictor.sensing.restored(segments, late, 1)
    begin = np.zeros((3, len(segments), 2 * predictor.tangent.size))
    if ahead is not None:
        begin[2][:, predictor.sensing.channels] = ahead[0, :, segments.history]
    points = [point, point.more(unit, step), point]
    before, after, begun = objective.raw(points, segments.freed(begin))
    start = (begun - before) / step
    change = (after - before) / step - start
    size, rows, channels = change.shape
    alone = np.zeros((size, rows, channels, rows + 1))
    for k in range(rows):
        alone[:, k, :, k] = change[:, k]
    alone[..., rows] = start
    columns = alone.reshape(size, rows * channels, rows + 1)
    return np.asarray(objective.whitening.inverse @ columns, dtype=np.float64)


def _drawn(sets: Mapping[str, Objective], point: Point, unit: Unit) -> list[Varying]:
    """Return an effect of chance at several strengths."""
    strengths, found = [level * unit.high for level in _LEVELS], []
    points = [point.beside({unit: strength}) for strength in strengths]
    draws = {name: drawn(one, points, _DRAWS) for name, one in sets.items()}
    for i, strength in enumerate(strengths):
        what = f"commands come late by up to {strength:.2g} {unit.effect.unit} more at {unit.where}"
        if unit.effect.unit != "s":
            what = f"commands come late at {unit.where}, one of {1 / strength:.0f}"
        roots = {name: scattered(each[i]).transpose(0, 2, 1) for name, each in draws.items()}
        found.append(Varying(what, _LATE, roots))
    return found


def _cost(left: Array, roots: Array) -> float:
    """Return the deviance of innovations ``(S, M)`` with covariance ``I + roots rootsᵀ``."""
    vectors, values, _ = np.linalg.svd(roots, full_matrices=False)
    inside = np.einsum("smr,sm->sr", vectors, left) ** 2
    wider = 1.0 + values**2
    total = (left**2).sum() - (inside * (1.0 - 1.0 / wider)).sum() + np.log(wider).sum()
    return float(total)


def _widened(objective: Objective, roots: Array) -> Objective:
    """Return the objective with that covariance beside its own."""
    white = objective.whitening
    size = roots.shape[1]
    lower = np.linalg.cholesky(np.eye(size) + roots @ roots.transpose(0, 2, 1))
    narrower = np.linalg.inv(lower)
    drift = np.matmul(narrower, white.drift[..., None])[..., 0]
    return objective.whitened(replace(white, inverse=narrower @ white.inverse, drift=drift))
