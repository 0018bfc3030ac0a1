"""Baseline: multinomial logistic regression from summary statistics to causes.

It is trained on as many simulated time steps as the diagnosis took, drawn from the prior over
parameters, causes, places and strengths.
"""

from __future__ import annotations

__all__ = ["classifier", "logistic"]

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_softmax, softmax

from torchrl_bayessim.diagnosis.objective import Point, Unit

from .answers import answer, share_explained
from .simulations import Draws, simulations
from .whole_runs import Array, Runs, mean_square

_EACH = 4  # draws of each cause, at least
_NEIGHBOURS = 5
_RIDGE = 1e-2
_SURE = 0.5
_AS_LIKELY = 0.5  # times the probability of the first


def classifier(runs: Runs, *, budget: int, seed: int) -> dict[str, Any]:
    """Return the most probable cause, where it sits in the draws that are most alike."""
    names = ["none", *dict.fromkeys(unit.name for unit in runs.units)]
    rng = np.random.default_rng([seed, 4])
    draws = simulations(runs, names, budget=budget, least=_EACH * len(names), rng=rng)
    rows, observed = _standardised(draws)
    labels = np.array([names.index(unit.name if unit else "none") for unit in draws.units])
    weights = logistic(rows, labels, len(names))
    chances = softmax(np.append(observed, 1.0) @ weights)
    order = np.argsort(-chances)
    first = names[order[0]]
    zeros = np.zeros(runs.sets["train"].size)
    theta = runs.sets["train"].theta(zeros)
    if first == "none":
        return answer(runs, "none", found={}, theta=(theta, theta))
    near = [names[i] for i in order if chances[i] >= _AS_LIKELY * chances[order[0]]]
    point, unit = _like(draws, first, np.abs(rows - observed).mean(1))
    before, after = (mean_square(some) for some in runs.sets["test"]([Point(zeros), point]))
    return answer(
        runs,
        "named" if chances[order[0]] >= _SURE else "ambiguous",
        found={unit: point.strengths[unit]},
        confused=[name for name in near if name != "none"],
        theta=(theta, runs.sets["train"].theta(point.z)),
        explained=share_explained(before, after),
    )


def logistic(rows: Array, labels: NDArray[np.int64], classes: int) -> Array:
    """Return the weights ``(L + 1, classes)`` of the most probable ridge-penalised regression."""
    design = np.c_[rows, np.ones(len(rows))]
    target = np.eye(classes)[labels]

    def loss(flat: Array) -> tuple[float, Array]:
        weights = flat.reshape(design.shape[1], classes)
        logs = log_softmax(design @ weights, axis=1)
        gradient = design.T @ (np.exp(logs) - target) / len(rows) + _RIDGE * weights
        value = -(target * logs).sum() / len(rows) + 0.5 * _RIDGE * (weights**2).sum()
        return float(value), gradient.ravel()

    start = np.zeros(design.shape[1] * classes)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 200})
    return found.x.reshape(design.shape[1], classes)


def _standardised(draws: Draws) -> tuple[Array, Array]:
    """Return the summaries that vary, in units of their quartiles and cut off at ten of them."""
    rows = draws.summaries.double().numpy()
    low, middle, high = np.quantile(rows, [0.25, 0.5, 0.75], axis=0)
    spread = high - low
    varies = spread > 1e-9 * (np.abs(middle) + 1e-9)

    def scaled(values: Array) -> Array:
        return np.clip((values - middle) / np.where(varies, spread, 1.0), -10, 10)[..., varies]

    return scaled(rows), scaled(draws.observed.double().numpy())


def _like(draws: Draws, name: str, distance: Array) -> tuple[Point, Unit]:
    """Return the mean of the nearest draws of a cause, at the place that most of them have."""
    mine = [i for i in np.argsort(distance) if (u := draws.units[i]) and u.name == name]
    near = mine[:_NEIGHBOURS]
    places = [draws.units[i] for i in near]
    unit = max(dict.fromkeys(places), key=places.count)
    there = [draws.points[i] for i in near if draws.units[i] == unit]
    z = np.mean([point.z for point in there], 0)
    return Point(z, {unit: float(np.median([p.strengths[unit] for p in there]))}), unit
