"""Runs that depart from the simulator while the others do not: something happened in them alone."""

from __future__ import annotations

__all__ = ["odd_run_alarms", "odd_runs"]

from collections.abc import Mapping, Sequence

import numpy as np

from ..logs.log import Log
from .objective import Objective, Point
from .shrinkage import squares, summed

_ODD = 4.0  # times the error of a usual run, and times the noise
_USUAL = 2.0  # noise floors of a usual run: of more, all runs depart


def odd_runs(
    sets: Mapping[str, Objective], logs: Mapping[str, Sequence[Log]], point: Point
) -> dict[str, float]:
    """Return the mean squared innovation of each odd run, by name.

    A run is odd where it exceeds the noise floor, and the median of all runs, fourfold, and that
    median is not far above the floor. Of fewer than three runs none is.

    Args:
        sets: Objectives by name of the split.
        logs: The logs of each split.
        point: What explains the data best.
    """
    means = {}
    for name, objective in sets.items():
        groups = objective.segments.log
        sums, sizes = summed(squares(objective, [point]), groups)
        for i, each, size in zip(np.unique(groups), sums, sizes, strict=True):
            means[logs[name][i].name] = float(each / size)
    if len(means) < 3:
        return {}
    usual = max(float(np.median([*means.values()])), 1.0)
    if usual > _USUAL:
        return {}
    return {name: mean for name, mean in means.items() if mean > _ODD * usual}


def odd_run_alarms(odd: Mapping[str, float]) -> list[str]:
    """Return an alarm for each of them.

    Example:
        >>> odd_run_alarms({"run3.csv": 111.7})
        ['run3.csv is 112 noise floors off and other runs are not: did something happen in it?']
    """
    return [
        f"{name} is {mean:.3g} noise floors off and other runs are not: did something happen in it?"
        for name, mean in odd.items()
    ]
