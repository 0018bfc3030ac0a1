"""Parameters and strengths that explain the segments best: Levenberg-Marquardt, many fits at once.

Every fit of a batch gets the same number of iterations, and all simulations of an iteration (one
per derivative and fit, then three trial steps per fit) are one call. Derivatives are finite
differences, which effects such as a delay or a dead band also have.
"""

from __future__ import annotations

__all__ = ["Fit", "fit_on", "refit"]

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..inference.priors import BoxPrior
from .objective import Objective, Point, Unit

Array = NDArray[np.float64]
_STEP = 0.01  # of a prior standard deviation, and of an effect's range
_TRIALS = (1.0, 30.0, 1000.0)  # dampings tried at once, times the present one


@dataclass(frozen=True, eq=False)
class Fit:
    """The best point of one model.

    Attributes:
        point: Parameters and strengths.
        units: The effects that were free, in the order of the Jacobian's last columns.
        innovations: Weighted innovations there, shape ``(S, KC)``.
        jacobian: Their derivative, by standardised parameters then by strengths as fractions of
            their range, shape ``(S·KC, D + U)``.
    """

    point: Point
    units: tuple[Unit, ...]
    innovations: Array
    jacobian: Array

    @property
    def misfit(self) -> float:
        """``Σ w_i ‖L_i⁻¹ r_i‖²``."""
        return float((self.innovations**2).sum())

    def covariance(self, dispersion: float) -> Array:
        """Return the covariance of standardised parameters and relative strengths.

        The larger of what the dispersion φ of the innovations says, ``φ (JᵀJ + φ P)⁻¹`` with the
        prior's precision ``P``, and of the sandwich estimate over segments, which knows that the
        innovations of one segment may err together.
        """
        size = self.jacobian.shape[1]
        parameters = size - len(self.units)
        precision = np.diag(np.r_[np.ones(parameters), np.full(len(self.units), 1e-6)])
        bread = np.linalg.inv(self.jacobian.T @ self.jacobian / dispersion + precision)
        segments = self.innovations.shape[0]
        scores = np.einsum(
            "smd,sm->sd", self.jacobian.reshape(segments, -1, size), self.innovations
        )
        meat = (scores / dispersion).T @ (scores / dispersion)
        sandwich = bread @ meat @ bread
        larger = np.maximum(np.diag(sandwich) / np.maximum(np.diag(bread), 1e-30), 1.0)
        scale = np.sqrt(larger)
        return np.asarray(bread * scale[:, None] * scale, dtype=np.float64)


def refit(
    objective: Objective,
    starts: Sequence[Point],
    *,
    iterations: int = 5,
    quick: bool = False,
) -> list[Fit]:
    """Fit parameters, and the strengths that each start has, from each start.

    Args:
        objective: What to make small.
        starts: One per fit; the units in its strengths are the ones to fit.
        iterations: Steps at most.
        quick: Spare the derivatives at the end point; the fit's are of the step before.
    """
    models = [tuple(start.strengths) for start in starts]
    boxes = [_bounds(objective, units) for units in models]
    vectors = [
        np.clip(_vector(start, units), *box)
        for start, units, box in zip(starts, models, boxes, strict=True)
    ]
    damping = np.full(len(starts), 1e-3)
    bases, jacobians = _linearised(objective, models, vectors, boxes)
    costs = _costs(bases, vectors, objective.size)
    active = np.ones(len(starts), dtype=bool)
    for iteration in range(iterations):
        indices = np.flatnonzero(active)
        if not len(indices):
            break
        trials = [
            _trial(
                jacobians[i],
                bases[i],
                vectors[i],
                boxes[i],
                damping=damping[i] * factor,
                size=objective.size,
            )
            for i in indices
            for factor in _TRIALS
        ]
        owners = [i for i in indices for _ in _TRIALS]
        residuals = objective(
            [_point(v, models[i], objective.size) for v, i in zip(trials, owners, strict=True)]
        )
        moved = []
        for n, i in enumerate(indices):
            part = slice(n * len(_TRIALS), (n + 1) * len(_TRIALS))
            found = _costs(residuals[part], trials[part], objective.size)
            best = int(np.argmin(found))
            if found[best] < costs[i]:
                gain = costs[i] - found[best]
                vectors[i], costs[i] = trials[part][best], found[best]
                bases[i] = residuals[part][best]
                damping[i] *= (0.1, 3.0, 100.0)[best]
                moved.append(i)
                active[i] = gain > 1e-3 + 1e-4 * costs[i]
            else:
                damping[i] *= 1e4
                active[i] = damping[i] < 1e4
        if moved and not (quick and iteration == iterations - 1):
            some = [vectors[i] for i in moved]
            new = _linearised(
                objective, [models[i] for i in moved], some, [boxes[i] for i in moved]
            )
            for i, base, jacobian in zip(moved, *new, strict=True):
                bases[i], jacobians[i] = base, jacobian
    return [
        Fit(_point(v, units, objective.size), units, base, jacobian)
        for v, units, base, jacobian in zip(vectors, models, bases, jacobians, strict=True)
    ]


def fit_on(objective: Objective, fit: Fit) -> Fit:
    """Return the innovations and derivatives of a fit on another objective's segments."""
    vector = _vector(fit.point, fit.units)
    box = _bounds(objective, fit.units)
    bases, jacobians = _linearised(objective, [fit.units], [vector], [box])
    return Fit(fit.point, fit.units, bases[0], jacobians[0])


def _bounds(objective: Objective, units: tuple[Unit, ...]) -> tuple[Array, Array]:
    """Return bounds of standardised parameters and relative strengths."""
    edge = np.sqrt(3.0) if isinstance(objective.prior, BoxPrior) else 4.0
    low = [-edge] * objective.size + [u.inside(-np.inf) / u.high for u in units]
    high = [edge] * objective.size + [u.inside(np.inf) / u.high for u in units]
    return np.array(low), np.array(high)


def _vector(point: Point, units: tuple[Unit, ...]) -> Array:
    relative = [point.strengths[unit] / unit.high for unit in units]
    return np.concatenate([point.z, np.array(relative)])


def _point(vector: Array, units: tuple[Unit, ...], size: int) -> Point:
    relative = vector[size:].tolist()
    return Point(vector[:size], {u: r * u.high for u, r in zip(units, relative, strict=True)})


def _costs(
    innovations: Sequence[Array] | Array, vectors: Sequence[Array], size: int
) -> list[float]:
    return [
        float((r**2).sum() + (v[:size] ** 2).sum())
        for r, v in zip(innovations, vectors, strict=True)
    ]


def _linearised(
    objective: Objective,
    models: Sequence[tuple[Unit, ...]],
    vectors: Sequence[Array],
    boxes: Sequence[tuple[Array, Array]],
) -> tuple[list[Array], list[Array]]:
    """Return innovations and their derivatives at each vector, simulated together."""
    points, steps = [], []
    for units, vector, (_, high) in zip(models, vectors, boxes, strict=True):
        points.append(_point(vector, units, objective.size))
        for d in range(len(vector)):
            step = -_STEP if vector[d] + _STEP > high[d] else _STEP
            moved = vector.copy()
            moved[d] += step
            points.append(_point(moved, units, objective.size))
            steps.append(step)
    residuals = objective(points)
    bases, jacobians, at, number = [], [], 0, 0
    for vector in vectors:
        base = residuals[at]
        columns = [
            (residuals[at + 1 + d] - base).ravel() / steps[number + d] for d in range(len(vector))
        ]
        bases.append(base)
        jacobians.append(np.stack(columns, 1) if columns else np.zeros((base.size, 0)))
        at, number = at + 1 + len(vector), number + len(vector)
    return bases, jacobians


def _trial(
    jacobian: Array,
    innovations: Array,
    vector: Array,
    box: tuple[Array, Array],
    *,
    damping: float,
    size: int,
) -> Array:
    """Return the damped Gauss-Newton step's end, inside the bounds."""
    if not len(vector):
        return vector
    prior = np.zeros(len(vector))
    prior[:size] = 1.0
    normal = jacobian.T @ jacobian + np.diag(prior)
    gradient = jacobian.T @ innovations.ravel() + prior * vector
    # coordinates at a bound that the gradient pushes against stay there
    pinned = ((vector <= box[0]) & (gradient > 0)) | ((vector >= box[1]) & (gradient < 0))
    free = ~pinned
    step = np.zeros(len(vector))
    if free.any():
        part = normal[np.ix_(free, free)]
        part = part + damping * np.diag(np.diag(part) + 1e-9)
        step[free] = -np.linalg.solve(part, gradient[free])
    return np.clip(vector + step, *box)
