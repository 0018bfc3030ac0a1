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


def share(reached: Tensor) -> tuple[float, list[float]]:
    """Return the share of successes and its 95 % interval (Wilson 1927)."""
    low, high = binomtest(int(reached.sum()), len(reached)).proportion_ci(method="wilson")
    return reached.mean().item(), [low, high]
