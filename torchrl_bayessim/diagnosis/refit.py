"""Parameters and strengths that explain the segments best: many least-squares fits at once.

All simulations that the fits of a batch ask for in an iteration are one call. Derivatives are
finite differences, which effects such as a delay or a dead band also have.
"""

from __future__ import annotations

__all__ = ["WIDE", "Fit", "outrun", "refit", "with_prior", "with_width"]

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..inference.priors import BoxPrior
from .levenberg_marquardt import LevenbergMarquardt
from .objective import Objective, Point, Unit

Array = NDArray[np.float64]
_BEHIND, _CHANCE = 1.5, 50.0  # times the best cost, and more: no rival of the best
WIDE = 0.25  # of a prior standard deviation, and of an effect's range
_ROUGH = 0.5  # of what a wide step changes: how far off a narrow one may be
_CATCHING_UP = 0.2  # of what is missing: what a step of a fit must gain to go on


@dataclass(frozen=True, eq=False)
class Fit:
    """The best point of one model.

    Attributes:
        point: Parameters and strengths.
        units: The effects that were free, in the order of the Jacobian's last columns.
        innovations: Weighted innovations there, shape ``(S, KC)``.
        jacobian: Their derivative, by standardised parameters then by strengths as fractions of
            their range, shape ``(S·KC, D + U)``.
        slopes: The derivative by what else of the effects was fitted (`form_fit`), ``(S·KC, N)``.
    """

    point: Point
    units: tuple[Unit, ...]
    innovations: Array
    jacobian: Array
    slopes: Array | None = None

    @property
    def misfit(self) -> float:
        """``Σ w_i ‖L_i⁻¹ r_i‖²``."""
        return float((self.innovations**2).sum())

    @property
    def mean_square(self) -> float:
        """The mean squared innovation."""
        return float((self.innovations**2).mean())

    @property
    def cost(self) -> float:
        """The misfit and what the prior adds, ``‖z‖²``."""
        return self.misfit + float((self.point.z**2).sum())

    def spread(self, every: int) -> NDArray[np.int64]:
        """Return every so many segments, from the worst explained one to the best.

        So those that alone show something are among them, and the rest as often as it occurs.
        """
        order = np.argsort(-(self.innovations**2).sum(-1), kind="stable")
        return np.sort(order[::every])

    def take(self, index: NDArray[np.int64]) -> Fit:
        """Return what the fit is on some segments."""
        segments, size = len(self.innovations), self.jacobian.shape[1]
        jacobian = self.jacobian.reshape(segments, -1, size)[index].reshape(-1, size)
        return Fit(self.point, self.units, self.innovations[index], jacobian)

    def beside(self, unit: Unit) -> Fit:
        """Return the fit with one more unit at zero, of which nothing is known yet."""
        point = self.point.beside({unit: 0.0})
        jacobian = np.c_[self.jacobian, np.zeros(len(self.jacobian))]
        return Fit(point, (*self.units, unit), self.innovations, jacobian)

    def change(self, unit: Unit) -> Array:
        """Return what a unit moves the innovations by, by its derivatives, shape ``(S·KC,)``."""
        return self.jacobian[:, self._column(unit)] * self.point.strengths[unit] / unit.high

    def _column(self, unit: Unit) -> int:
        return len(self.point.z) + self.units.index(unit)

    def without(self, unit: Unit) -> Fit:
        """Return the fit with a unit at zero and no longer free, by its derivatives."""
        strengths = {u: s for u, s in self.point.strengths.items() if u != unit}
        left = self.innovations - self.change(unit).reshape(self.innovations.shape)
        jacobian = np.delete(self.jacobian, self._column(unit), axis=1)
        return Fit(Point(self.point.z, strengths), tuple(strengths), left, jacobian)

    def covariance(self, dispersion: float) -> Array:
        """Return the covariance of standardised parameters and relative strengths.

        The larger of what the dispersion φ of the innovations says, ``φ (JᵀJ + φ P)⁻¹`` with the
        prior's precision ``P``, and of the sandwich estimate over segments, which knows that the
        innovations of one segment may err together. What else was fitted is free in both.
        """
        size = self.jacobian.shape[1]
        parameters = size - len(self.units)
        jacobian = self.jacobian if self.slopes is None else np.c_[self.jacobian, self.slopes]
        precision = np.full(jacobian.shape[1], 1e-6)
        precision[:parameters] = 1.0
        bread = np.linalg.inv(jacobian.T @ jacobian / dispersion + np.diag(precision))
        segments = self.innovations.shape[0]
        by_segment = jacobian.reshape(segments, -1, jacobian.shape[1])
        scores = np.einsum("smd,sm->sd", by_segment, self.innovations)
        meat = (scores / dispersion).T @ (scores / dispersion)
        sandwich = bread @ meat @ bread
        larger = np.maximum(np.diag(sandwich) / np.maximum(np.diag(bread), 1e-30), 1.0)
        scale = np.sqrt(larger)
        return np.asarray(bread * scale[:, None] * scale, dtype=np.float64)[:size, :size]


def refit(
    objective: Objective,
    starts: Sequence[Point] | Sequence[Fit],
    *,
    origins: Sequence[Fit | None] | None = None,
    iterations: int = 8,
    renew: bool = True,
    race: float | None = None,
) -> list[Fit]:
    """Fit parameters, and the strengths that each start has, from each start.

    Args:
        objective: What to make small.
        starts: One per fit; the units in its strengths are the ones to fit. Earlier fits of the
            objective go on as they are, with their derivatives.
        origins: For each start a point near it, with the same units, whose derivatives are known.
        iterations: Steps at most.
        renew: Whether derivatives are made anew where a step fails that they had promised, and
            before a fit stops.
        race: Stop fits that are far behind the best of them, or behind this cost, and do not
            catch up; infinite where no cost is known yet.
    """
    known = [start if isinstance(start, Fit) else None for start in starts]
    first = [start.point if isinstance(start, Fit) else start for start in starts]
    models = [tuple(point.strengths) for point in first]
    descents = [
        LevenbergMarquardt(
            _vector(point, units),
            _bounds(objective, units),
            size=objective.size,
            origin=None if origin is None else _origin(origin, units),
            begun=earlier is not None,
            renew=renew,
            width=objective.width,
        )
        for point, units, earlier, origin in zip(
            first, models, known, origins or known, strict=True
        )
    ]
    for _ in range(1 + iterations):
        asked = [descent.ask() for descent in descents]
        points = [
            _point(vector, units, objective.size)
            for units, vectors in zip(models, asked, strict=True)
            for vector in vectors
        ]
        if all(descent.done for descent in descents):
            break
        residuals = iter(objective(points) if points else ())
        for descent, vectors in zip(descents, asked, strict=True):
            if vectors:
                descent.tell([next(residuals) for _ in vectors])
        if race is not None:
            ahead = min(race, *(descent.cost for descent in descents))
            for descent in descents:
                descent.done = descent.done or outrun(descent.cost, descent.gain, ahead)
    return [
        Fit(_point(d.vector, units, objective.size), units, d.residual, d.jacobian)
        for d, units in zip(descents, models, strict=True)
    ]


def with_prior(jacobian: Array, size: int) -> Array:
    """Return derivatives with those of ``z``, the first ``size`` coordinates, below them."""
    prior = np.zeros((size, jacobian.shape[1]))
    prior[:, :size] = np.eye(size)
    return np.concatenate([jacobian, prior])


def with_width(objective: Objective, point: Point) -> Objective:
    """Return the objective with wide derivatives where it is rough: narrow ones promise nonsense.

    Where contacts chatter, a hundredth of a prior standard deviation decides when they open, and
    what it changes says nothing of what ten times as much does.

    Args:
        objective: What to make small.
        point: Where derivatives of the parameters are compared.
    """
    rows = np.eye(objective.size)[:-1]
    if not len(rows):
        return objective
    moved = np.concatenate([objective.width * rows, WIDE * rows])
    ends = [Point(point.z + step) for step in moved]
    changes = objective([point, *ends])
    changes = (changes[1:] - changes[0]).reshape(2, len(rows), -1)
    wrong = changes[0] * (WIDE / objective.width) - changes[1]
    rough = np.linalg.norm(wrong) > _ROUGH * np.linalg.norm(changes[1])
    return objective.differing(WIDE) if rough else objective


def outrun(cost: float, gain: float, ahead: float) -> bool:
    """Return whether steps like the last would not bring a fit near a cost that is ahead of it."""
    behind = cost - (_BEHIND * ahead + _CHANCE)
    return behind > 0 and gain < _CATCHING_UP * behind


def _origin(fit: Fit, units: tuple[Unit, ...]) -> tuple[Array, Array, Array]:
    return _vector(fit.point, units), fit.innovations, fit.jacobian


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
