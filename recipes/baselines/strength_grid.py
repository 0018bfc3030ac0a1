"""Baseline: every effect on a grid of strengths, in the simulator as it is.

No parameter is refitted: what a wrong mass does is then put down to whatever resembles it.
"""

from __future__ import annotations

__all__ = ["LEVELS", "best_of_grid", "best_strengths", "on_grid", "scan", "strength_grid"]

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from torchrl_bayessim.diagnosis.objective import Objective, Point, Unit

from .answers import answer, graded, share_explained
from .whole_runs import Array, Runs, mean_square

LEVELS = (0.01, 0.03, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Shares of an effect's range."""
_AS_GOOD = 1.05  # times the error of the best


def strength_grid(runs: Runs) -> dict[str, Any]:
    """Return what explains the validation runs best, with strengths chosen on the training runs."""
    z = np.zeros(runs.sets["train"].size)
    strengths = scan(runs.sets["train"], z, runs.units)
    points = {unit: Point(z, {unit: strength}) for unit, strength in strengths.items()}
    return best_of_grid(runs, Point(z), points)


def scan(objective: Objective, z: Array, units: tuple[Unit, ...]) -> dict[Unit, float]:
    """Return the strength of each unit, on the grid, that leaves least error."""
    best = best_strengths(objective, z, on_grid(units, LEVELS))
    return {unit: strength for unit, (_, strength) in best.items()}


def on_grid(units: Sequence[Unit], levels: Iterable[float]) -> list[tuple[Unit, float]]:
    """Return each unit at each share of its range, and at the opposite where it has one."""
    return [
        (unit, sign * float(level) * unit.high)
        for unit in units
        for level in levels
        for sign in ((1.0, -1.0) if unit.low < 0 else (1.0,))
    ]


def best_strengths(
    objective: Objective, z: Array, tried: Sequence[tuple[Unit, float]]
) -> dict[Unit, tuple[float, float]]:
    """Return the least mean square of each unit, and the strength that leaves it."""
    innovations = objective([Point(z, {unit: strength}) for unit, strength in tried])
    errors = (innovations**2).mean((1, 2))
    best: dict[Unit, tuple[float, float]] = {}
    for (unit, strength), error in zip(tried, errors.tolist(), strict=True):
        best[unit] = min(best.get(unit, (np.inf, 0.0)), (error, strength))
    return best


def best_of_grid(runs: Runs, nominal: Point, points: Mapping[Unit, Point]) -> dict[str, Any]:
    """Return the answer that names the unit with the least validation error."""
    validation, test = runs.sets["validation"], runs.sets["test"]
    bare, *others = (mean_square(some) for some in validation([nominal, *points.values()]))
    errors = dict(sorted(zip(points, others, strict=True), key=lambda pair: pair[1]))
    first = next(iter(errors))
    before, after = (mean_square(some) for some in test([nominal, points[first]]))
    near = [unit.name for unit, error in errors.items() if error <= _AS_GOOD * errors[first]]
    names = list(dict.fromkeys(near))
    return answer(
        runs,
        graded(bare, errors[first], alike=len(names)),
        found={first: points[first].strengths[first]},
        confused=names,
        theta=(runs.sets["train"].theta(nominal.z), runs.sets["train"].theta(points[first].z)),
        explained=share_explained(before, after),
    )
