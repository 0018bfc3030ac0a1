"""What may explain the data beside what is in the model already: compared, then fitted, in rungs.

Simulations are spent where they tell: all units are compared on some of the segments and what
stands out on all; all explanations are fitted there for a few steps, the best on all segments, and
the best of those to the end (successive halving, Jamieson & Talwalkar 2016).
"""

from __future__ import annotations

__all__ = ["Round", "bent", "compare", "explanations"]

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import Effect
from ..effects.robot import Robot
from .additions import groups, one_for_all, pairs, singles
from .objective import Objective, Point, Unit, units_of
from .refit import Fit, outrun, refit
from .screening import Screen, screen

_PROMISING = 24  # explanations that are fitted on some segments
_SURVIVORS, _FINALISTS = 7, 4  # that are fitted on all segments, and to the end
_MANY, _APART, _MATTER = 500, 4, 8  # units, targets of one effect, effects to look at singly
_FEW, _EVERY = 8, 4  # segments on which a round begins at least, and which share at least
_BENT = 5.0  # mean squared innovation of a nominal fit that may have gone astray
_PLAIN = 300.0  # misfit beyond noise with which a few segments tell explanations apart
_TYPICAL = (0.05, 0.2)  # of an effect's range, to start from
_NEAR = 0.3  # prior standard deviations within which derivatives may hold


@dataclass(frozen=True, eq=False)
class Round:
    """A fit compared with what may be added to it.

    Attributes:
        base: The fit, with all its segments.
        seen: All units, those that matter on all segments.
        thin: Some of the segments.
        coarse: All units on those.
        index: Which.
    """

    base: Fit
    seen: Screen
    thin: Objective
    coarse: Screen
    index: NDArray[np.int64]


def compare(train: Objective, base: Fit, units: Sequence[Unit]) -> Round:
    """Screen units on some segments, then what may matter on all.

    Args:
        train: The segments.
        base: What is in the model already.
        units: What may be missing.
    """
    every = int(np.clip(round(len(train.segments) / _FEW), 1, _EVERY))
    index = base.spread(every)
    thin, fit = train.take(index), base.take(index)
    if len(units) > _MANY:  # single ones only of the effects that matter
        counts = Counter(unit.name for unit in units)
        whole = [u for u in units if u.where == "all" or counts[u.name] <= _APART]
        half = fit.spread(2)
        best = screen(thin.take(half), fit.take(half), whole).best(1.0)
        names = list(dict.fromkeys(unit.name for unit in best))[:_MATTER]
        units = [u for u in units if u in whole or u.name in names]
    coarse = screen(thin, fit, units)
    if every == 1 or _plain(fit):
        return Round(base, coarse.grown(every), thin, coarse, index)
    first = list(coarse.best(1.0))[:_MATTER]
    together = [unit for on in [*pairs(coarse), *groups(coarse)] for unit in on]
    picks = list(dict.fromkeys([*first, *together]))
    fine = screen(train, base, picks)
    return Round(base, fine.joined(coarse, every), thin, coarse, index)


def explanations(train: Objective, now: Round) -> list[Fit]:
    """Fit what may be added to the base: first many for a few steps, then the best on.

    Where the gap is large the screen's linear view from a bent nominal fit can mislead: a damping
    that has absorbed dry friction leaves nothing for friction to explain. So every effect gets a
    try: from there, from the prior's mean, and with the parameters moved to make room for it.
    """
    base = now.base
    starts, origins = _starts(now)
    if not starts:
        return []
    tried = refit(now.thin, starts, origins=origins, iterations=0, renew=False)
    tried = _promising(tried) if bent(base) else sorted(tried, key=_promise)[:_PROMISING]
    tried = refit(now.thin, tried, iterations=3, renew=False)
    everywhere = [
        point
        for fit in _fittest(tried, _SURVIVORS, there=base.units)
        for point in _spread(fit, train.predictor.system.robot)
    ]
    tried += refit(now.thin, everywhere, iterations=3, renew=False)
    if _plain(base.take(now.index)):
        best = _fittest(tried, _FINALISTS, there=base.units, alike=1)
        best += _at_other_places(best, tried)
        return refit(train, [fit.point for fit in best], race=np.inf)
    starts = [fit.point for fit in _fittest(tried, _SURVIVORS, there=base.units)]
    known: list[Fit | None] = []
    for point in starts:
        on = [unit for unit in point.strengths if unit not in base.units]
        near = np.abs(point.z - base.point.z).max() < _NEAR
        near &= set(base.units) <= set(point.strengths)  # unless spread over their targets
        known.append(now.seen.origin(base, on) if near else None)
    tried = refit(train, starts, origins=known, iterations=2, renew=False)
    best = _fittest(tried, _FINALISTS, there=base.units, alike=1)
    return refit(train, best, race=np.inf)


def _starts(now: Round) -> tuple[list[Point], list[Fit | None]]:
    """Return where to begin, and points near there whose derivatives are known."""
    base, seen = now.base, now.seen
    additions = [*singles(seen), *pairs(seen), *groups(seen)]
    thin = base.take(now.index)
    starts = [base.point.beside(on) for on in additions]
    origins = [now.coarse.origin(thin, list(on)) for on in additions]
    if base.units or len(base.point.z) == 1 or not bent(base):
        return starts, origins
    middle = refit(now.thin, [Point(np.zeros_like(base.point.z))], iterations=0)[0]
    for unit, sign in _everything(seen).items():
        starts.append(Point(middle.point.z, {unit: sign * _TYPICAL[-1] * unit.high}))
        origins.append(middle.beside(unit))
        known = now.coarse.origin(thin, [unit])
        if known is not None:
            starts += [_exchanged(known, unit, sign * typical * unit.high) for typical in _TYPICAL]
            origins += [known] * len(_TYPICAL)
    return starts, origins


def _exchanged(known: Fit, unit: Unit, strength: float) -> Point:
    """Return the unit at a strength, and the parameters without what they did in its place."""
    size = len(known.point.z)
    derivative = np.r_[known.jacobian[:, :size], np.eye(size)]
    effect = np.r_[known.jacobian[:, -1] * strength / unit.high, np.zeros(size)]
    instead = np.linalg.lstsq(derivative, effect, rcond=None)[0]
    edge = np.sqrt(3.0)  # of a uniform prior; a fit starts within its bounds anyway
    return Point(np.clip(known.point.z - instead, -edge, edge), {unit: strength})


def _spread(fit: Fit, robot: Robot) -> list[Point]:
    """Return the point where what acts at all targets alike may act at each as it will."""
    strengths: dict[Unit, float] = {}
    for unit, strength in fit.point.strengths.items():
        parts = [unit]
        if sum(part != 0 for part in unit.direction) > 1 and not one_for_all(unit):
            parts = [one for one in units_of([unit.effect], robot) if one.where != "all"]
        for part in parts:
            share = float(np.dot(part.direction, unit.direction)) if part != unit else 1.0
            strengths[part] = strengths.get(part, 0.0) + share * strength
    return [] if set(strengths) == set(fit.units) else [Point(fit.point.z, strengths)]


def _everything(seen: Screen) -> dict[Unit, float]:
    """Return each effect at its best place and at all of its targets, and the better sign."""
    best = seen.best(1.0)
    chosen: dict[tuple[Effect, bool], Unit] = {}
    for unit in best:
        chosen.setdefault((unit.effect, unit.where == "all"), unit)
    return {unit: float(np.sign(best[unit][1])) or 1.0 for unit in chosen.values()}


def bent(fit: Fit) -> bool:
    """Return whether so much is left that derivatives may mislead."""
    return fit.mean_square > _BENT


def _plain(fit: Fit) -> bool:
    """Return whether so much is left that the segments of the fit say enough."""
    return bool(fit.misfit - fit.innovations.size > _PLAIN)


def _promising(tried: Sequence[Fit]) -> list[Fit]:
    """Return each effect's most promising fit, of each of its forms, and the most promising of all.

    Far from the truth one step promises little, to the right effect too.
    """
    order = sorted(tried, key=_promise)
    first: dict[frozenset[Effect], Fit] = {}
    fewest = min(len(_names(fit)) for fit in order)
    for fit in order:
        if len(_names(fit)) == fewest:
            first.setdefault(frozenset(unit.effect for unit in fit.units), fit)
    return [*first.values(), *(f for f in order[:_PROMISING] if f not in first.values())]


def _promise(fit: Fit) -> float:
    """Return the misfit that one more step would leave if the derivatives held."""
    size = len(fit.point.z)
    target = np.r_[fit.innovations.ravel(), fit.point.z]
    prior = np.eye(size, fit.jacobian.shape[1])
    step = np.linalg.lstsq(np.r_[fit.jacobian, prior], -target, rcond=None)[0]
    left = fit.innovations.ravel() + fit.jacobian @ step
    return _priced(fit, min(float(left @ left), fit.misfit))


def _priced(fit: Fit, misfit: float) -> float:
    """Return a misfit that is larger the more strengths it took, by what chance would gain."""
    return misfit * (1 + 4.0 * len(fit.units) / fit.innovations.size) + 4.0 * len(fit.units)


def _fittest(
    fits: Sequence[Fit], most: int, *, there: Collection[Unit] = (), alike: int = 2
) -> list[Fit]:
    """Return the best fits, so many of every set of effects at most; half of them add the fewest.

    Beside them the plainest of the same sets, with the fewest strengths: the best beside the same
    effects at further places could not say that those are not needed.

    Args:
        fits: To choose from.
        most: How many, but for the plainest.
        there: What is in the model already; the same effect elsewhere is added like any other.
        alike: How many of a set.
    """
    order = sorted(fits, key=lambda f: _priced(f, f.misfit))
    added = [len({u.name for u in fit.units if u not in there}) for fit in order]
    fewest = min(added)
    few = [fit for fit, count in zip(order, added, strict=True) if count == fewest]
    half = _apart(few, most // 2, alike)
    chosen = _apart([*half, *(fit for fit in order if fit not in half)], most, alike)
    for names in {_names(fit): None for fit in chosen}:
        plainest = min((f for f in order if _names(f) == names), key=lambda f: len(f.units))
        if plainest not in chosen:
            chosen.append(plainest)
    return sorted(chosen, key=order.index)


def _apart(fits: Sequence[Fit], most: int, alike: int) -> list[Fit]:
    """Return the first fits, of every set of units one and of every set of effects so many."""
    kept: list[Fit] = []
    for fit in fits:
        same = sum(_names(fit) == _names(other) for other in kept)
        if len(kept) < most and same < alike and all(set(fit.units) != set(f.units) for f in kept):
            kept.append(fit)
    return kept


def _at_other_places(best: Sequence[Fit], tried: Sequence[Fit]) -> list[Fit]:
    """Return the best fit of the first one's effects at other places, if segments hardly tell.

    After a few steps on some segments all drives at once may be as good as the one that it is.

    Args:
        best: Those that go on, the best first.
        tried: All.
    """
    known = [_places(fit) for fit in best]
    others = [fit for fit in tried if _names(fit) == _names(best[0])]
    others = [fit for fit in others if _places(fit) not in known]
    if not others:
        return []
    first = min(others, key=lambda fit: _priced(fit, fit.misfit))
    return [] if outrun(first.cost, 0.0, best[0].cost) else [first]


def _places(fit: Fit) -> frozenset[tuple[str, str]]:
    return frozenset((unit.name, unit.where) for unit in fit.units)


def _names(fit: Fit) -> frozenset[str]:
    return frozenset(unit.name for unit in fit.units)
