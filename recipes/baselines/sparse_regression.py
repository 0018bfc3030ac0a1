"""Baseline: sparse regression of the force that is missing from one row to the next.

Sequentially thresholded least squares (Brunton, Proctor & Kutz 2016, SINDy) on a library of forces
that go by their causes' names. Columns of the uncertain parameters are always in. The threshold is
the one with the least Bayesian information criterion on the validation runs.
"""

from __future__ import annotations

__all__ = ["sparse", "sparse_regression"]

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from withheld.robots import entry_value

from torchrl_bayessim.diagnosis.objective import Point, Unit
from torchrl_bayessim.diagnosis.refit import refit

from .answers import answer, graded, share_explained
from .forces import Forces, columns, forces
from .strength_grid import LEVELS, best_strengths, on_grid
from .whole_runs import Array, Runs, mean_square

_THRESHOLDS = (0.05, 0.1, 0.2, 0.4, 0.8)  # standard deviations of the residual's noise
_APART = 0.2  # of a column, which parameters cannot account for
_RIDGE = 1e-3
_EDGE = np.sqrt(3.0)  # of a uniform prior, in its standard deviations
_MOST = 2  # causes that are named


def sparse_regression(runs: Runs) -> dict[str, Any]:
    """Return the force with the largest part in what is missing, if any is left."""
    train, validation = (forces(runs.system, runs.logs[n]) for n in ("train", "validation"))
    places, fit, held = _library(runs, train, validation)
    noise = _noise(train.missing)
    target, checked = ((s.missing / noise).ravel() for s in (train, validation))
    fit, held = ((x / noise).reshape(len(places), -1).T for x in (fit, held))
    count = 0 if runs.system.prior is None else len(runs.system.prior.names)
    alone = np.linalg.lstsq(fit[:, :count], target, rcond=None)[0]
    left = checked - held[:, :count] @ alone
    kept, weights = sparse(fit, target, (held, checked), always=count)
    parts = np.abs(weights[count:]) * fit[:, kept].std(0)
    order = [places[kept[i]] for i in np.argsort(-parts)]
    nominal = Point(_standardised(runs, alone))
    return _answered(runs, _simulated(runs, nominal, order), nominal, left=mean_square(left))


def sparse(
    rows: Array, target: Array, held: tuple[Array, Array], *, always: int
) -> tuple[list[int], Array]:
    """Return the columns that stay, and the weights of those and of the first.

    Args:
        rows: Columns on the training steps, ``(T, K)``.
        target: What they should explain, in units of its noise, ``(T,)``.
        held: The same of the validation steps.
        always: So many first columns are never dropped; what they cannot be told from is.
    """
    basis, _ = np.linalg.qr(rows[:, :always])
    apart = rows - basis @ (basis.T @ rows)
    size = apart.std(0)
    able = [k for k in range(always, rows.shape[1]) if size[k] > _APART * np.std(rows[:, k])]
    best: tuple[float, list[int], Array] = np.inf, [], np.zeros(always)
    for threshold in _THRESHOLDS:
        kept = able
        while kept:
            weights = _ridge(apart[:, kept] / size[kept], target - basis @ (basis.T @ target))
            large = [
                k for k, w in zip(kept, np.abs(weights).tolist(), strict=True) if w >= threshold
            ]
            if large == kept:
                break
            kept = large
        chosen = [*range(always), *kept]
        found = np.linalg.lstsq(rows[:, chosen], target, rcond=None)[0]
        error = held[1] - held[0][:, chosen] @ found
        price = len(error) * np.log(np.mean(error**2)) + len(kept) * np.log(len(error))
        if price < best[0]:
            best = float(price), kept, found
    return best[1:]


def _ridge(rows: Array, target: Array) -> Array:
    gram = rows.T @ rows
    return np.linalg.solve(gram + _RIDGE * len(rows) * np.eye(len(gram)), rows.T @ target)


def _library(
    runs: Runs, train: Forces, validation: Forces
) -> tuple[list[tuple[str, int]], Array, Array]:
    """Return the columns that may be named, ``(K, T, J)`` on both splits; parameters first."""
    names = () if runs.system.prior is None else runs.system.prior.names
    on = [columns(runs.system, steps) for steps in (train, validation)]
    allowed = {*names, *(unit.name for unit in runs.units)}
    places = [p for p in on[0] if p in on[1] and p[0] in allowed]
    return places, *(np.stack([some[p] for p in places]) for some in on)


def _noise(missing: Array) -> NDArray[np.float64]:
    """Return the noise of each joint's residual: differences drop what is smooth."""
    return np.median(np.abs(np.diff(missing, axis=0)), 0) / (0.6745 * np.sqrt(2.0)) + 1e-12


def _standardised(runs: Runs, changes: Array) -> Array:
    """Return the standardised parameters at some change from the nominal ones."""
    size = runs.sets["train"].size
    if runs.system.prior is None:
        return np.zeros(1)
    names = runs.system.prior.names
    values = np.array([entry_value(runs.system.task.model, name) for name in names]) + changes
    low, high = (runs.sets["train"].theta(np.r_[np.full(size - 1, e), 0]) for e in (-_EDGE, _EDGE))
    return np.r_[np.clip((2 * (values - low) / (high - low) - 1) * _EDGE, -_EDGE, _EDGE), 0.0]


def _simulated(runs: Runs, nominal: Point, places: Sequence[tuple[str, int]]) -> Point:
    """Return the first causes, with strengths and parameters fitted by simulation."""
    strengths: dict[Unit, float] = {}
    for name, dof in places[:_MOST]:
        units = [u for u in runs.units if u.name == name and _at(runs, u, dof)]
        best = best_strengths(runs.sets["train"], nominal.z, on_grid(units, LEVELS))
        if best:
            unit = min(best, key=lambda unit: best[unit][0])
            strengths[unit] = best[unit][1]
    if not strengths:
        return nominal
    point = refit(runs.sets["train"], [Point(nominal.z, strengths)])[0].point
    return Point(point.z, {unit: s for unit, s in point.strengths.items() if s})


def _at(runs: Runs, unit: Unit, dof: int) -> bool:
    robot, joint = runs.system.robot, unit.joint(runs.system.robot)
    whole = dof < 0 or len(unit.effect.targets(robot)) == 1
    return whole or (joint >= 0 and robot.dof_index[joint] == dof)


def _answered(runs: Runs, point: Point, nominal: Point, *, left: float) -> dict[str, Any]:
    theta, pair = runs.sets["train"].theta, [nominal, point]
    before, after = (mean_square(some) for some in runs.sets["validation"](pair))
    tested = [mean_square(some) for some in runs.sets["test"](pair)]
    found = point.strengths
    return answer(
        runs,
        graded(before, after) if found else graded(left, left),
        found=found,
        confused=[unit.name for unit in found],
        theta=(theta(nominal.z), theta(point.z)),
        explained=share_explained(*tested),
    )
