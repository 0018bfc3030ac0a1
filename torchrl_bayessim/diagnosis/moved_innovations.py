"""Innovations that chance moves: normal, with a mean and a covariance of their own in each segment.

What a random effect did is not recorded. With :math:`μ_i` what it does on average in segment ``i``,
and :math:`R_i R_i^T` the covariance of what it does, those of the robot are likely as (a synthetic
likelihood, Wood 2010)::

    r_i + J_i δ ~ N(-μ_i, φ I + R_i R_iᵀ),    δ ~ N(0, I) the change of the fit.
"""

from __future__ import annotations

__all__ = [
    "SCATTER",
    "Judged",
    "Moved",
    "Told",
    "deviances_without",
    "everywhere",
    "scattered",
    "tell",
]

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .objective import Objective, Point
from .refit import refit

Array = NDArray[np.float64]
SCATTER = np.geomspace(0.6, 4.0, 20)  # φ
_SURE = 1.5  # standard errors of segments by which the mean gain exceeds zero


@dataclass(frozen=True, eq=False)
class Judged:
    """Some segments: innovations of a fit, ``(S, M)``, and derivatives ``(S, M, D)``."""

    objective: Objective
    point: Point
    left: Array
    derivatives: Array

    @classmethod
    def of(cls, objective: Objective, point: Point, most: int) -> Judged:
        """Return so many segments of a split at least, evenly taken, without robust weights."""
        every = max(1, len(objective.segments) // most)
        some = objective.take(np.arange(0, len(objective.segments), every))
        some = some.whitened(replace(some.whitening, weights=np.ones(len(some.segments))))
        fit = refit(some, [point], iterations=0)[0]
        return cls(some, point, fit.innovations, fit.jacobian.reshape(*fit.innovations.shape, -1))


@dataclass(frozen=True, eq=False)
class Moved:
    """How chance moves innovations.

    Attributes:
        mean: ``μ``, shape ``(S, M)``.
        values: Eigenvalues of the covariance, shape ``(S, R)``.
        vectors: Its eigenvectors, shape ``(S, M, R)``.
    """

    mean: Array
    values: Array
    vectors: Array

    @classmethod
    def of(cls, mean: Array, roots: Array) -> Moved:
        """Return it by a root of the covariance, ``(S, M, R)``."""
        vectors, sizes, _ = np.linalg.svd(roots, full_matrices=False)
        return cls(mean, sizes**2, vectors)

    @classmethod
    def by(cls, draws: Array) -> Moved:
        """Return it by some draws of what chance does, ``(R, S, M)``."""
        return cls.of(draws.mean(0), scattered(draws).transpose(0, 2, 1))

    def change(self, judged: Judged) -> Array:
        """Return ``δ``, how the fit changes beside it."""
        derivatives = self._weighed(judged.derivatives)
        derivatives = derivatives.reshape(-1, derivatives.shape[-1])
        target = self._weighed((judged.left + self.mean)[..., None]).reshape(-1)
        normal = derivatives.T @ derivatives + np.eye(derivatives.shape[1])
        return np.asarray(-np.linalg.solve(normal, derivatives.T @ target), dtype=np.float64)

    def deviances(self, judged: Judged, change: Array) -> tuple[Array, Array]:
        """Return deviances for every ``φ``, ``(F, S)``, and mean squares for ``φ = 1``, ``(S,)``.

        Args:
            judged: Segments.
            change: ``δ``.
        """
        error = judged.left + self.mean + judged.derivatives @ change
        inside = np.einsum("smr,sm->sr", self.vectors, error) ** 2
        beside = np.maximum((error**2).sum(-1) - inside.sum(-1), 0.0)
        free = error.shape[1] - self.values.shape[1]
        wider = SCATTER[:, None, None] + self.values
        costs = (inside / wider + np.log(wider)).sum(-1)
        costs += beside / SCATTER[:, None] + free * np.log(SCATTER)[:, None]
        standard = ((inside / (1 + self.values)).sum(-1) + beside) / error.shape[1]
        return costs, standard.astype(np.float64)

    def _weighed(self, columns: Array) -> Array:
        inside = np.einsum("smr,smd->srd", self.vectors, columns)
        shrunk = (1 - 1 / np.sqrt(1 + self.values))[..., None] * inside
        return np.asarray(columns - np.einsum("smr,srd->smd", self.vectors, shrunk))


def scattered(draws: Array) -> Array:
    """Return a root of the covariance of draws ``(R, S, M)`` in each segment, ``(S, R, M)``."""
    return np.asarray((draws - draws.mean(0)).transpose(1, 0, 2) / np.sqrt(len(draws) - 1))


@dataclass(frozen=True, eq=False)
class Told:
    """What the judged segments say of chance.

    Attributes:
        change: ``δ``.
        costs: Their deviances.
        scatter: The likeliest ``φ`` of all.
        loudest: The largest of those of each split.
    """

    change: Array
    costs: Array
    scatter: float
    loudest: float

    @property
    def cost(self) -> float:
        """The deviance of all."""
        return float(self.costs.sum())


def tell(judged: Sequence[Judged], moved: Sequence[Moved]) -> Told:
    """Return what segments say of what chance does in them, the change of the fit by the first."""
    change = moved[0].change(judged[0])
    found = [one.deviances(data, change)[0] for data, one in zip(judged, moved, strict=True)]
    costs = np.concatenate(found, 1)
    best = int(costs.sum(1).argmin())
    loudest = max(float(SCATTER[cost.sum(1).argmin()]) for cost in found)
    return Told(change, costs[best], float(SCATTER[best]), loudest)


def deviances_without(judged: Sequence[Judged], point: Point) -> Array:
    """Return deviances of an explanation without chance, of evenly spread scatter, by segment."""
    squares = np.concatenate([(data.objective([point])[0] ** 2).sum(-1) for data in judged])
    size = np.concatenate([np.full(len(data.left), data.left.shape[1]) for data in judged])
    costs = squares / SCATTER[:, None] + size * np.log(SCATTER)[:, None]
    return np.asarray(costs[costs.sum(1).argmin()])


def everywhere(gains: Array) -> bool:
    """Return whether more than a few segments gain: what chance does, it does everywhere."""
    return bool(gains.mean() > _SURE * gains.std(ddof=1) / np.sqrt(len(gains)))
