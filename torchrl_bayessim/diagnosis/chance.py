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

__all__ = [
    "CALM",
    "Chance",
    "calm",
    "chances",
    "detectable",
    "drawn",
    "of_chance",
    "unseen",
]

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import SensorEffect
from .model import LIKELY
from .moved_innovations import Judged, Moved, Told, deviances_without, everywhere, tell
from .objective import Objective, Point, Unit, strengths_of
from .screening import crossing
from .selection import Selection

Array = NDArray[np.float64]
_DRAWS, _FEW = 12, 4  # simulations of each candidate, and of what is only to be ruled out
_MANY = 60  # of what is named: a scatter that fewer do not span would count as left
_LEVELS = (0.08, 0.2, 0.45, 1.0)  # of an effect's range
_FINER = np.geomspace(_LEVELS[0], _LEVELS[-1], 10)
_LATE = "timing"  # the group of effects that are late
_AROUND = (0.65, 0.8, 1.25, 1.55)  # times the best of these
_WHITE = 1.15  # mean squared innovation of a model that leaves nothing to chance
CALM = 1.3  # φ beyond which an effect of chance has not explained the scatter
_SEGMENTS = 8  # of each split
_APART = 4  # targets of one effect that are looked at singly
_ELSEWHERE = 0.5  # of what a loss at one place explains, by that at another
_LEAST = 0.3  # relative error of a strength: so few draws do not span what chance may do
_NEEDED, _NEEDED_BESIDE = 20.0, 40.0  # deviance, to be found


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
        alone: Mean of ``left`` without the effects that it acts beside, where that was looked at.
    """

    unit: Unit
    strength: float
    error: float
    gain: float
    left: Array
    before: float | None = None
    beside: bool = False
    deviance: float = np.inf
    alone: float | None = None


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
    z = selection.nominal.fit.point.z
    data = Judged.of(train, Point(z), _SEGMENTS)
    threshold, result = _WHITE - 1.0, {}
    for unit in units:  # one after the other, for memory's sake
        levels, added = np.array(_LEVELS) * unit.high, np.zeros(0)
        for some in (levels[:2], *levels[2:, None]):  # as far as it takes
            points = [Point(z, {unit: float(level)}) for level in some]
            added = np.r_[added, (_draws(data, points, _FEW) ** 2).mean((1, 2, 3))]
            if added[-1] >= threshold:
                break
        result[unit] = crossing(levels[: len(added)], added, threshold)
    return result


def chances(
    sets: Mapping[str, Objective],
    selection: Selection,
    units: Sequence[Unit],
    *,
    beside: bool = False,
) -> list[Chance]:
    """Return the random effects that explain what the best model leaves, the likeliest first.

    Looked for where it leaves more than noise, or is itself an effect of timing.

    Args:
        sets: Training, validation and test segments.
        selection: What the search without chance found.
        units: Random effects at their targets.
        beside: Whether they act beside the effects that were found, not in their place. A law that
            is not quite the true one leaves errors that scatter, too, so that takes more.
    """
    if not units or calm(selection) or (beside and not selection.best.units):
        return []
    needed = _NEEDED_BESIDE if beside else _NEEDED
    point = (selection.best if beside else selection.nominal).fit.point
    judged = [Judged.of(sets[name], point, _SEGMENTS) for name in ("train", "validation")]
    base = deviances_without(judged, selection.best.fit.point)
    best = _likeliest(judged, point, [(u, level * u.high) for u in units for level in _LEVELS])
    if beside:
        best = _of_one_place(best, float(base.sum()))
    least = min((cost for cost, _ in best.values()), default=np.inf)
    if base.sum() - least < needed:
        return []
    found = [
        _refined(judged, sets["test"], unit, strength, point=point, base=base)
        for unit, (cost, strength) in best.items()
        if cost < least + 4 * LIKELY
    ]
    found = [chance for chance in found if chance is not None]
    most = max((chance.gain for chance in found), default=0.0)
    found = [c for c in found if c.gain > max(needed, most - LIKELY)]
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
    judged = [Judged.of(sets[name], point, _SEGMENTS) for name in ("train", "validation")]
    most = float(deviances_without(judged, selection.best.fit.point).sum()) + LIKELY
    best = _likeliest(judged, point, [(u, level * u.high) for u in alike for level in _FINER])
    return list(dict.fromkeys(unit.name for unit, (cost, _) in best.items() if cost < most))


def _likeliest(
    judged: Sequence[Judged], point: Point, rows: Sequence[tuple[Unit, float]]
) -> dict[Unit, tuple[float, float]]:
    """Return the least deviance of each unit over strengths, and the strength that has it."""
    told = _told(judged, [point.beside({unit: strength}) for unit, strength in rows])
    best: dict[Unit, tuple[float, float]] = {}
    for (unit, strength), one in zip(rows, told, strict=True):
        best[unit] = min(best.get(unit, (np.inf, 0.0)), (one.cost, strength))
    return best


def calm(selection: Selection) -> bool:
    """Return whether what was found leaves noise alone, and is not late itself."""
    best = selection.best
    if any(unit.effect.group == _LATE for unit in best.units):
        return False  # what varies is late on average
    return max(best.fit.mean_square, best.dispersion()) < _WHITE


def _told(judged: Sequence[Judged], points: Sequence[Point]) -> list[Told]:
    made = [_draws(data, points) for data in judged]
    return [tell(judged, [Moved.by(draws[p]) for draws in made]) for p in range(len(points))]


def _draws(data: Judged, points: Sequence[Point], count: int = _DRAWS) -> Array:
    """Return what chance changes, shape ``(P, R, S, M)``."""
    return drawn(data.objective, points, count) - data.left


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


def _refined(
    judged: Sequence[Judged],
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
    points = [point.beside({unit: float(s)}) for s in strengths]
    told = _told(judged, points)
    costs = np.array([one.cost for one in told])
    best = int(np.argmin(costs))
    gains = base - told[best].costs
    if told[best].loudest > CALM or not everywhere(gains):
        return None
    unseen = Judged.of(test, point, _SEGMENTS)
    moved = Moved.by(_draws(unseen, [points[best]], _MANY)[0])
    after = moved.deviances(unseen, told[best].change)[1]
    return Chance(
        unit=unit,
        strength=float(strengths[best]),
        error=_error(np.log(strengths), costs) * float(strengths[best]),
        gain=float(gains.sum()),
        left=after,
        before=float((unseen.left**2).mean()) if point.strengths else None,
        beside=bool(point.strengths),
    )


def _of_one_place(
    best: Mapping[Unit, tuple[float, float]], base: float
) -> dict[Unit, tuple[float, float]]:
    """Return deviances of units without effects that several places explain, each alone.

    What is a little wrong everywhere looks as if commands of any drive were lost now and then.
    """
    kept = dict(best)
    for name in {unit.name for unit in best}:
        single = [u for u in best if u.name == name and len(u.targets) == 1]
        gains = sorted(base - best[unit][0] for unit in single)
        if len(gains) > 1 and gains[-2] > _ELSEWHERE * gains[-1]:
            kept = {unit: told for unit, told in kept.items() if unit.name != name}
    return kept


def _error(logs: Array, costs: Array) -> float:
    """Return the relative standard deviation of a strength, by a parabola through the costs."""
    if len(logs) < 3:
        return 0.5
    curve = float(np.polyfit(logs, costs, 2)[0])
    return float(np.clip(1 / np.sqrt(max(curve, 1e-9)), _LEAST, 0.5))
