"""Means with their 95 % intervals: of seeds, and of episodes that succeed or fail."""

from __future__ import annotations

import statistics

from scipy.stats import binomtest
from scipy.stats import t as student
from torch import Tensor


def interval(values: list[float]) -> dict[str, float]:
    """Return mean, 95 % Student interval of the mean, and the values."""
    mean = statistics.fmean(values)
    half = student.ppf(0.975, len(values) - 1) * statistics.stdev(values) / len(values) ** 0.5
    return {"mean": mean, "low": mean - half, "high": mean + half, "values": values}


def of_mean(values: Tensor) -> tuple[float, list[float]]:
    """Return the mean and its 95 % Student interval."""
    found = interval(values.tolist())
    return found["mean"], [found["low"], found["high"]]


def wilson(hits: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a proportion (Wilson 1927); all of [0, 1] of no cases."""
    if not n:
        return 0.0, 1.0
    low, high = binomtest(hits, n).proportion_ci(method="wilson")
    return float(low), float(high)


def share(reached: Tensor) -> tuple[float, list[float]]:
    """Return the share of successes and its 95 % interval."""
    return reached.mean().item(), [*wilson(int(reached.sum()), len(reached))]
