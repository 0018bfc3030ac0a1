"""Effects of chance, such as lost packets: seen by the scatter that they leave, not by their mean.

What a random effect did in a run is not recorded, so no single simulation imitates it. Of ``R``
simulations with draws of their own, the innovations have mean ``μ_i`` and covariance ``Σ_i`` in
segment ``i``, and those of the robot are likely as (a synthetic likelihood, Wood 2010)::

    r_i + J_i δ ~ N(-μ_i, φ I + Σ_i),    δ ~ N(0, I) the parameters' change from the nominal fit.

On average a lost packet is a lag: ``E u_k = (1 - s) u_k + s E u_{k-1}``; a lag itself leaves noise
alone. So the likelihood is compared with that of the best explanation without chance, whose
scatter ``φ`` is free, which excuses any error that is spread evenly. What a catalogue does not know
leaves errors too, so an effect of chance must leave noise alone by its own standard.
"""

from __future__ import annotations

__all__ = ["Chance", "chances", "detectable", "drawn", "of_chance", "scattered", "unseen"]

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import SensorEffect
from .objective import Objective, Point, Unit, strengths_of
from .refit import refit
from .screening import crossing
from .selection import Selection

Array = NDArray[np.float64]
_DRAWS, _FEW = 12, 4  # simulations of each candidate, and of what is only to be ruled out
_MANY = 60  # of what is named: a scatter that fewer do not span would count as left
_LEVELS = (0.08, 0.2, 0.45, 1.0)  # of an effect's range
_FINER = np.geomspace(_LEVELS[0], _LEVELS[-1], 10)
_LATE = "timing"  # the group of effects that are late
_AROUND = (0.65, 0.8, 1.25, 1.55)  # times the best of these
_SCATTER = np.geomspace(0.6, 4.0, 20)  # φ
_WHITE = 1.15  # mean squared innovation of a model that leaves nothing to chance
_CALM = 1.3  # φ beyond which an effect of chance has not explained the scatter
_SEGMENTS = 8  # of each split
_APART = 4  # targets of one effect that are looked at singly
_SURE = 1.5  # standard errors of segments by which the mean gain exceeds zero
_LEAST = 0.3  # relative error of a strength: so few draws do not span what chance may do
_NEEDED, _LIKELY = 20.0, 6.0  # deviances: to be found, and that chance often makes


@dataclass(frozen=True, eq=False)
class Chance:
    """A random effect that explains the scatter.

    Attributes:
        unit: The effect and where.
        strength: Its most likely strength.
        error: Standard deviation of that.
        gain: Deviance gained over the best explanation without chance.
        left: Mean squares of its standardised innovations in test segments, shape ``(S,)``.
        before: Mean square of the innovations of these segments without it, where they are others
            than those of the other figures.
        beside: Whether it acts beside the best explanation without chance, not in its place.
        deviance: Of the segments that say what is lost, with it; infinite where others do.
    """

    unit: Unit
    strength: float
    error: float
    gain: float
    left: Array
    before: float | None = None
    beside: bool = False
    deviance: float = np.inf


@dataclass(frozen=True, eq=False)
class _Data:
    """Some segments: innovations of the nominal fit, ``(S, M)``, and derivatives."""

    objective: Objective
    left: Array
    derivatives: Array

    @classmethod
    def of(cls, objective: Objective, point: Point) -> _Data:
        """Return the data of a split, on some segments."""
        every = max(1, len(objective.segments) // _SEGMENTS)
        some = objective.take(np.arange(0, len(objective.segments), every))
        fit = refit(some, [Point(point.z)], iterations=0)[0]
        weights = some.whitening.weights[:, None]
        derivatives = fit.jacobian.reshape(*fit.innovations.shape, -1) / weights[..., None]
        return cls(some, fit.innovations / weights, derivatives)

    def draws(self, points: Sequence[Point], count: int = _DRAWS) -> Array:
        """Return what chance changes, shape ``(P, R, S, M)``."""
        return drawn(self.objective, points, count) - self.left


@dataclass(frozen=True, eq=False)
class _Told:
    """What the judged segments say of a point: ``δ``, their deviances, the largest ``φ``."""

    change: Array
    costs: Array
    scatter: float

    @property
    def cost(self) -> float:
        """The deviance of all."""
        return float(self.costs.sum())


def of_chance(units: Sequence[Unit]) -> list[Unit]:
    """Return the units whose draws matter: not those that are noise of a sensor, and no more.

    The noise floor is estimated from the data, and has the latter. Where one effect has many
    targets, it is looked for at all of them together.
    """
    random = [u for u in units if u.effect.random]
    random = [u for u in random if not (u.effect.memoryless and isinstance(u.effect, SensorEffect))]
    counts = Counter(unit.name for unit in random)
    return [u for u in random if u.where == "all" or counts[u.name] <= _APART]


def detectable(train: Objective, selection: Selection, units: Sequence[Unit]) -> dict[Unit, float]:
    """Return the least strength of each unit whose scatter would be seen, infinite if none is.

    The mean squared innovation that it adds must reach what calls for an effect of chance.
    """
    data, z = _Data.of(train, selection.nominal.fit.point), selection.nominal.fit.point.z
    threshold, result = _WHITE - 1.0, {}
    for unit in units:  # one after the other, for memory's sake
        levels, added = np.array(_LEVELS) * unit.high, np.zeros(0)
        for some in (levels[:2], *levels[2:, None]):  # as far as it takes
            points = [Point(z, {unit: float(level)}) for level in some]
            added = np.r_[added, (data.draws(points, _FEW) ** 2).mean((1, 2, 3))]
            if added[-1] >= threshold:
                break
        result[unit] = crossing(levels[: len(added)], added, threshold)
    return result


def chances(
    sets: Mapping[str, Objective], selection: Selection, units: Sequence[Unit]
) -> list[Chance]:
    """Return the random effects that explain what the best model leaves, the likeliest first.

    Looked for where it leaves more than noise, or is itself an effect of timing.

    Args:
        sets: Training, validation and test segments.
        selection: What the search without chance found.
        units: Random effects at their targets.
    """
    if not units or _calm(selection):
        return []
    point = selection.nominal.fit.point
    judged = [_Data.of(sets[name], point) for name in ("train", "validation")]
    base = _without(judged, selection.best.fit.point)
    best = _likeliest(judged, point, [(u, level * u.high) for u in units for level in _LEVELS])
    least = min(cost for cost, _ in best.values())
    if base.sum() - least < _NEEDED:
        return []
    found = [
        _refined(judged, sets["test"], unit, strength, point=point, base=base)
        for unit, (cost, strength) in best.items()
        if cost < least + 4 * _LIKELY
    ]
    found = [chance for chance in found if chance is not None]
    most = max((chance.gain for chance in found), default=0.0)
    found = [c for c in found if c.gain > max(_NEEDED, most - _LIKELY)]
    return sorted(found, key=lambda c: -c.gain)


def unseen(sets: Mapping[str, Objective], selection: Selection, units: Sequence[Unit]) -> list[str]:
    """Return the names of random effects that what was found to be late may be in truth.

    What is late by another time at each step is late on average, and where noise hides its scatter
    as likely as a delay.

    Args:
        sets: Training, validation and test segments.
        selection: What the search without chance found, and nothing of chance did better.
        units: Random effects at their targets.
    """
    found = selection.best.units
    alike = [unit for unit in units if unit.effect.group == _LATE]
    if not found or not alike or any(unit.effect.group != _LATE for unit in found):
        return []
    point = selection.nominal.fit.point
    judged = [_Data.of(sets[name], point) for name in ("train", "validation")]
    most = float(_without(judged, selection.best.fit.point).sum()) + _LIKELY
    best = _likeliest(judged, point, [(u, level * u.high) for u in alike for level in _FINER])
    return list(dict.fromkeys(unit.name for unit, (cost, _) in best.items() if cost < most))


def _likeliest(
    judged: Sequence[_Data], point: Point, rows: Sequence[tuple[Unit, float]]
) -> dict[Unit, tuple[float, float]]:
    """Return the least deviance of each unit over strengths, and the strength that has it."""
    told = _told(judged, [Point(point.z, {unit: strength}) for unit, strength in rows])
    best: dict[Unit, tuple[float, float]] = {}
    for (unit, strength), one in zip(rows, told, strict=True):
        best[unit] = min(best.get(unit, (np.inf, 0.0)), (one.cost, strength))
    return best


def _calm(selection: Selection) -> bool:
    best = selection.best
    if any(unit.effect.group == _LATE for unit in best.units):
        return False  # what varies is late on average
    return max(best.fit.mean_square, best.dispersion()) < _WHITE


def _without(judged: Sequence[_Data], point: Point) -> Array:
    """Return deviances of an explanation without chance, of evenly spread scatter, by segment."""
    left = [(data.objective.unweighted([point])[0] ** 2) for data in judged]
    squares = np.concatenate([r.sum(-1) for r in left])
    size = np.concatenate([np.full(len(r), r.shape[1]) for r in left])
    costs = squares / _SCATTER[:, None] + size * np.log(_SCATTER)[:, None]
    return np.asarray(costs[costs.sum(1).argmin()])


def _told(judged: Sequence[_Data], points: Sequence[Point]) -> list[_Told]:
    made = [data.draws(points) for data in judged]
    told = []
    for p in range(len(points)):
        change = _change(judged[0], made[0][p])
        found = [_deviance(data, d[p], change) for data, d in zip(judged, made, strict=True)]
        costs = np.concatenate([cost for cost, _, _ in found])
        told.append(_Told(change, costs, max(phi for _, phi, _ in found)))
    return told


def _change(data: _Data, drawn: Array) -> Array:
    """Return ``δ``, how the parameters move beside an effect of chance, by draws ``(R, S, M)``."""
    values, vectors = _spectrum(drawn)
    error = data.left + drawn.mean(0)

    def weighed(columns: Array) -> Array:
        inside = np.einsum("srm,smd->srd", vectors, columns)
        shrunk = (1 - 1 / np.sqrt(1 + values))[..., None] * inside
        return columns - np.einsum("srm,srd->smd", vectors, shrunk)

    derivatives = weighed(data.derivatives).reshape(-1, data.derivatives.shape[-1])
    target = weighed(error[..., None]).reshape(-1)
    normal = derivatives.T @ derivatives + np.eye(derivatives.shape[1])
    change = -np.linalg.solve(normal, derivatives.T @ target)
    return np.asarray(change, dtype=np.float64)


def drawn(objective: Objective, points: Sequence[Point], count: int) -> Array:
    """Return innovations without the robust weights as chance draws them, ``(P, R, S, M)``."""
    predictor, found = objective.predictor, []
    strengths = strengths_of(points, predictor.system.robot)
    try:
        for draw in range(count):
            predictor.realisation = seed = 1 + draw
            offsets = predictor.sensing.scattered(objective.segments, strengths, seed=seed)
            found.append(objective.unweighted(points, offsets))
    finally:
        predictor.realisation = 0
    return np.stack(found, 1)


def scattered(draws: Array) -> Array:
    """Return a root of the covariance of draws ``(R, S, M)`` in each segment, ``(S, R, M)``."""
    return np.asarray((draws - draws.mean(0)).transpose(1, 0, 2) / np.sqrt(len(draws) - 1))


def _spectrum(drawn: Array) -> tuple[Array, Array]:
    """Return eigenvalues ``(S, R)`` and eigenvectors ``(S, R, M)`` of what chance scatters."""
    _, roots, vectors = np.linalg.svd(scattered(drawn), full_matrices=False)
    return roots**2, vectors


def _deviance(data: _Data, drawn: Array, change: Array) -> tuple[Array, float, Array]:
    """Return least deviances over ``φ``, that ``φ``, and mean squares for ``φ = 1``, ``(S,)``."""
    values, vectors = _spectrum(drawn)
    error = data.left + drawn.mean(0) + data.derivatives @ change
    inside = np.einsum("srm,sm->sr", vectors, error) ** 2
    beside = np.maximum((error**2).sum(-1) - inside.sum(-1), 0.0)
    free = error.shape[1] - values.shape[1]
    costs = [
        (inside / (phi + values) + np.log(phi + values)).sum(-1)
        + (beside / phi + free * np.log(phi))
        for phi in _SCATTER
    ]
    standard = ((inside / (1 + values)).sum(-1) + beside) / error.shape[1]
    best = int(np.argmin([cost.sum() for cost in costs]))
    return costs[best], float(_SCATTER[best]), standard.astype(np.float64)


def _refined(
    judged: Sequence[_Data],
    test: Objective,
    unit: Unit,
    strength: float,
    *,
    point: Point,
    base: Array,
) -> Chance | None:
    """Return the effect at its likeliest strength, nothing if it leaves more than noise.

    Nor if it explains a few segments only: what chance does, it does everywhere.
    """
    strengths = np.array([1.0, *_AROUND]) * strength
    strengths = np.unique(np.minimum(strengths, unit.high))
    points = [Point(point.z, {unit: float(s)}) for s in strengths]
    told = _told(judged, points)
    costs = np.array([one.cost for one in told])
    best = int(np.argmin(costs))
    gains = base - told[best].costs
    everywhere = gains.mean() > _SURE * gains.std(ddof=1) / np.sqrt(len(gains))
    if told[best].scatter > _CALM or not everywhere:
        return None
    unseen = _Data.of(test, point)
    drawn = unseen.draws([points[best]], _MANY)[0]
    after = _deviance(unseen, drawn, told[best].change)[2]
    return Chance(
        unit=unit,
        strength=float(strengths[best]),
        error=_error(np.log(strengths), costs) * float(strengths[best]),
        gain=float(gains.sum()),
        left=after,
    )


def _error(logs: Array, costs: Array) -> float:
    """Return the relative standard deviation of a strength, by a parabola through the costs."""
    if len(logs) < 3:
        return 0.5
    curve = float(np.polyfit(logs, costs, 2)[0])
    return float(np.clip(1 / np.sqrt(max(curve, 1e-9)), _LEAST, 0.5))
