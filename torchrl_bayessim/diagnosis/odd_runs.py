"""Runs that depart from the simulator while the others do not: something happened in them alone."""

from __future__ import annotations

__all__ = ["odd_run_alarms", "odd_runs", "run_errors", "unexplained_run_alarms"]

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ..logs.log import Log
from .objective import Objective, Point
from .shrinkage import squares, summed

_ODD = 4.0  # times the error of a usual run, and times the noise
_FAR = 50.0  # times the error of a usual run, where all depart
_USUAL = 2.0  # noise floors of a usual run: of more, all runs depart


def run_errors(
    sets: Mapping[str, Objective], logs: Mapping[str, Sequence[Log]], point: Point
) -> dict[str, float]:
    """Return the mean squared innovation of each run, by name.

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
    return means


def odd_runs(errors: Mapping[str, float]) -> dict[str, float]:
    """Return the errors of odd runs, of those of all runs.

    A run is odd where it exceeds the noise floor, and the median of all runs, fourfold, and that
    median is not far above the floor. Of fewer than three runs none is.

    Example:
        >>> odd_runs({"a": 1.1, "b": 0.9, "c": 30.0}), odd_runs({"a": 9.0, "b": 8.0, "c": 40.0})
        ({'c': 30.0}, {})
    """
    usual = _usual(errors)
    if len(errors) < 3 or usual > _USUAL:
        return {}
    return {name: error for name, error in errors.items() if error > _ODD * usual}


def odd_run_alarms(errors: Mapping[str, float]) -> list[str]:
    """Return an alarm for each odd run, and for each that is far worse than the others are.

    Such a one may have drawn the fit away from all the others.

    Example:
        >>> odd_run_alarms({"a.csv": 1.0, "b.csv": 1.1, "c.csv": 111.7})
        ['c.csv is 112 noise floors off and other runs are not: did something happen in it?']
        >>> odd_run_alarms({"a.csv": 15.0, "b.csv": 18.0, "c.csv": 4120.0})
        ['c.csv is 4.12e+03 noise floors off, 229 times a usual run: did something happen in it?']
    """
    if odd := odd_runs(errors):
        return [
            f"{name} is {error:.3g} noise floors off and other runs are not: did something happen "
            "in it?"
            for name, error in odd.items()
        ]
    usual = _usual(errors)
    return [
        f"{name} is {error:.3g} noise floors off, {error / usual:.3g} times a usual run: did "
        "something happen in it?"
        for name, error in errors.items()
        if len(errors) >= 3 and error > _FAR * usual
    ]


def unexplained_run_alarms(errors: Mapping[str, float]) -> list[str]:
    """Return an alarm for each run that exceeds the noise fourfold, though no gap was found.

    Example:
        >>> unexplained_run_alarms({"a.csv": 44.3, "b.csv": 7.0, "c.csv": 1.2, "d.csv": 1.1})
        ['a.csv and b.csv are 44.3 and 7 noise floors off, and nothing explains both them and the \
other runs: did something happen in them?']
    """
    far = {name: error for name, error in errors.items() if error > _ODD}
    if not far:
        return []
    names, floors = (_listed(part) for part in (far, (f"{error:.3g}" for error in far.values())))
    are, them = ("are", "them") if len(far) > 1 else ("is", "it")
    both = "both them" if len(far) > 1 else "both it"
    return [
        f"{names} {are} {floors} noise floors off, and nothing explains {both} and the other runs: "
        f"did something happen in {them}?"
    ]


def _listed(parts: Iterable[str]) -> str:
    *most, last = parts
    return f"{', '.join(most)} and {last}" if most else last


def _usual(errors: Mapping[str, float]) -> float:
    """Return the error of a usual run, at least the noise floor."""
    return max(float(np.median([*errors.values()])), 1.0) if errors else 1.0
