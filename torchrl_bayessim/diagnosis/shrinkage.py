"""How far the gap shrinks: raw, refit, with effects, floor; on test runs, with intervals.

``G`` is the mean squared innovation, 1 for a perfect simulator on these noisy data. The share
explained is ``(G_refit - G_effects) / (G_refit - 1)``: noise is nobody's credit, and what fitting
the parameters alone gains is the parameters' credit.
"""

from __future__ import annotations

__all__ = ["Shrinkage", "shares", "shrinkage"]

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import factorial

import numpy as np
from numpy.typing import NDArray

from .objective import Objective, Point

Array = NDArray[np.float64]
_DRAWS = 1000


@dataclass(frozen=True)
class Shrinkage:
    """Mean squared innovations on test segments.

    Attributes:
        raw: At the prior's mean.
        refit: With fitted parameters.
        effects: With the effects too.
        explained: Share of the excess that the effects remove.
        explained_ci: Its interval.
        excess_ci: Interval of ``refit - 1``.
        remainder_ci: Interval of ``effects - 1``.
    """

    raw: float
    refit: float
    effects: float
    explained: float
    explained_ci: tuple[float, float]
    excess_ci: tuple[float, float]
    remainder_ci: tuple[float, float]


def shrinkage(
    test: Objective,
    points: Sequence[Point],
    generator: np.random.Generator,
    *,
    floor: float = 1.0,
) -> Shrinkage:
    """Return the figures for three points: prior mean, refit, with effects.

    Args:
        test: Segments of the test runs.
        points: The three.
        generator: Of the bootstrap.
        floor: Mean squared innovation of a perfect simulator, where it is known to be less than 1:
            covariances that must allow for chaos, or for velocities that were not measured, allow
            for more than there is. All figures are in units of it.

    Whole trajectories are resampled where there are four of them or more, else segments.
    """
    innovations = test(points)
    weight = test.whitening.weights**2
    per = (innovations**2).sum(-1)
    size = floor * weight * innovations.shape[2]
    groups = test.segments.log
    if len(np.unique(groups)) < 4:
        groups = np.arange(len(per[0]))
    names, index = np.unique(groups, return_inverse=True)
    sums = np.stack([np.bincount(index, p, len(names)) for p in (*per, size)])
    draws = generator.integers(len(names), size=(_DRAWS, len(names)))
    raw, refit, effects = (float(s.sum() / sums[3].sum()) for s in sums[:3])
    resampled = sums[:, draws].sum(-1)
    refits, after = resampled[1] / resampled[3], resampled[2] / resampled[3]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = (refits - after) / np.where(refits > 1.0, refits - 1.0, np.nan)
    # noise may leave less than its mean; more than all cannot be explained
    explained = min((refit - effects) / (refit - 1.0), 1.0) if refit > 1.0 else 0.0
    return Shrinkage(
        raw, refit, effects, explained,
        _interval(np.minimum(ratios, 1.0)), _interval(refits - 1.0), _interval(after - 1.0),
    )  # fmt: skip


def _interval(values: Array) -> tuple[float, float]:
    values = values[np.isfinite(values)]
    if not len(values):
        return (0.0, 0.0)
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)


def shares(names: Sequence[str], value: Callable[[frozenset[str]], float]) -> dict[str, float]:
    """Return each member's credit, averaged over all orders of joining (Shapley 1953).

    Example:
        >>> credit = shares(["a", "b"], lambda s: {0: 0.0, 1: 0.3, 2: 1.0}[len(s)])
        >>> credit
        {'a': 0.5, 'b': 0.5}
    """
    count = len(names)
    credit = {}
    for name in names:
        others = [n for n in names if n != name]
        total = 0.0
        for size in range(count):
            weight = factorial(size) * factorial(count - size - 1) / factorial(count)
            for some in combinations(others, size):
                with_it = value(frozenset([*some, name]))
                total += weight * (with_it - value(frozenset(some)))
        credit[name] = total
    return credit
