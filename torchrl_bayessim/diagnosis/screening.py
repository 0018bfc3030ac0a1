"""Every effect at once: does what it would change look like what the simulator gets wrong?

A matched filter whose templates the simulator makes. With innovations ``r̃`` at the nominal fit and
``r̃(e, ℓ)`` with unit ``e`` at strength ``ℓ``, the signature is their difference, with everything
that the parameters can explain projected out::

    g = M (r̃ - r̃(e, ℓ)),   M = I - QQᵀ,   Q = orth [J_θ; I],   LR = max(0, gᵀr̃ / ‖g‖)² / φ,

a score test with finite strengths in place of derivatives, which also works for delays and dead
bands (Rao 1948; nuisance rejection as in Basseville & Nikiforov 1993, ch. 7). The null of the
largest LR is drawn from the signatures' own correlations, and so accounts for the search.
"""

from __future__ import annotations

__all__ = ["Screen", "screen"]

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .objective import Objective, Point, Unit
from .refit import Fit

Array = NDArray[np.float64]
LEVELS = (0.05, 0.4)  # of an effect's range
_POWER = 0.84  # of the normal distribution at 0.8, to state what would have been seen


@dataclass(frozen=True, eq=False)
class Screen:
    """The signatures of units at several strengths, and how well each matches.

    Attributes:
        units: The unit of each signature, length ``G``.
        strengths: Its strength, shape ``(G,)``.
        norms: ``‖g‖``: how many standard deviations the unit would move the data, ``(G,)``.
        scores: ``gᵀr̃ / ‖g‖``, shape ``(G,)``.
        correlation: Cosines between signatures, shape ``(G, G)``.
        swallowed: Share of each signature that parameters would explain, shape ``(G,)``.
        residual: ``‖r̃_⊥‖²``, what the parameters leave.
        effective: Number of innovations.
        directions: Unit signatures, shape ``(G, n)``, for the report.
    """

    units: tuple[Unit, ...]
    strengths: Array
    norms: Array
    scores: Array
    correlation: Array
    swallowed: Array
    residual: float
    effective: int
    directions: Array

    def ratios(self, dispersion: float) -> Array:
        """Return the likelihood ratio of each signature, shape ``(G,)``."""
        return np.maximum(self.scores, 0.0) ** 2 / dispersion

    def best(self, dispersion: float) -> dict[Unit, tuple[float, float]]:
        """Return each unit's largest likelihood ratio and the strength that gives it."""
        result: dict[Unit, tuple[float, float]] = {}
        for unit, strength, ratio, score, norm in zip(
            self.units,
            self.strengths,
            self.ratios(dispersion),
            self.scores,
            self.norms,
            strict=True,
        ):
            if unit not in result or ratio > result[unit][0]:
                amplitude = max(score, 0.0) / norm if norm > 0 else 0.0
                scaled = float(np.clip(amplitude, 0.1, 10.0) * strength)
                result[unit] = float(ratio), unit.inside(scaled)
        return result

    def null(self, draws: int, generator: np.random.Generator) -> Array:
        """Return largest likelihood ratios under noise alone, shape ``(draws,)``."""
        size = len(self.correlation)
        root = np.linalg.cholesky(self.correlation + 1e-5 * np.eye(size))
        noise = generator.standard_normal((draws, size)) @ root.T
        return np.maximum(noise, 0.0).max(1) ** 2

    def detectable(self, alpha: float) -> dict[Unit, float]:
        """Return the least strength of each unit that would be seen with probability 0.8.

        ``‖g(s)‖`` reaches the threshold of a search over all units at level ``alpha``; strengths
        between levels by power laws, ``inf`` where even the highest level is not seen.
        """
        threshold = np.sqrt(2 * np.log(max(len(set(self.units)), 2) / alpha)) + _POWER
        result: dict[Unit, float] = {}
        for unit in dict.fromkeys(self.units):
            rows = [i for i, u in enumerate(self.units) if u == unit and self.strengths[i] > 0]
            rows.sort(key=lambda i: self.strengths[i])
            result[unit] = _crossing(self.strengths[rows], self.norms[rows], threshold)
        return result


def screen(objective: Objective, fit: Fit, units: Sequence[Unit]) -> Screen:
    """Compare every unit at several strengths with what the fit leaves unexplained.

    Args:
        objective: What to explain.
        fit: What is in the model already; its units are projected out like parameters.
        units: The effects to try.
    """
    rows = [(unit, level) for unit in units for level in _levels(unit)]
    rest = fit.innovations.ravel()
    basis = _basis(fit, objective.size)
    left = np.r_[rest, -_prior_part(fit, objective.size)]
    left = left - basis @ (basis.T @ left)
    norms, scores, swallowed = [], [], []
    directions = np.zeros((len(rows), len(left)), dtype=np.float32)
    chunk = max(1, 40_000_000 // max(len(rest), 1))
    for begin in range(0, len(rows), chunk):
        part = rows[begin : begin + chunk]
        points = [
            Point(fit.point.z, {**fit.point.strengths, unit: _added(fit, unit, level)})
            for unit, level in part
        ]
        simulated = objective(points)
        for i, innovations in enumerate(simulated):
            change = np.r_[rest - innovations.ravel(), np.zeros(objective.size)]
            before = float(np.linalg.norm(change))
            if not np.isfinite(before) or (np.abs(innovations).max(-1) > 500).any():
                change = np.zeros_like(change)  # a diverged simulation explains nothing
            change -= basis @ (basis.T @ change)
            norm = float(np.linalg.norm(change))
            seen = norm > 1e-6 * max(before, 1.0) and norm > 1e-6
            directions[begin + i] = change / norm if seen else 0.0
            norms.append(norm if seen else 0.0)
            scores.append(float(change @ left) / norm if seen else 0.0)
            swallowed.append(1 - (norm / before) ** 2 if before > 0 and seen else 0.0)
    correlation = (directions @ directions.T).astype(np.float64)
    return Screen(
        tuple(unit for unit, _ in rows),
        np.array([level for _, level in rows]),
        np.array(norms),
        np.array(scores),
        correlation,
        np.array(swallowed),
        float(left @ left),
        len(rest),
        directions[:, : len(rest)].astype(np.float64),
    )


def _levels(unit: Unit) -> list[float]:
    levels = [level * unit.high for level in LEVELS]
    if unit.low < 0:
        levels += [level * unit.low for level in LEVELS]
    return levels


def _added(fit: Fit, unit: Unit, level: float) -> float:
    return fit.point.strengths.get(unit, 0.0) + level


def _prior_part(fit: Fit, size: int) -> Array:
    return fit.point.z[:size]


def _basis(fit: Fit, size: int) -> Array:
    """Return an orthonormal basis of what the fit's own parameters can explain."""
    columns = fit.jacobian
    prior = np.zeros((size, columns.shape[1]))
    prior[:, :size] = np.eye(size)
    stacked = np.concatenate([columns, prior])
    if not stacked.shape[1]:
        return np.zeros((len(stacked), 0))
    left, values, _ = np.linalg.svd(stacked, full_matrices=False)
    return left[:, values > 1e-9 * max(values.max(), 1e-30)]


def _crossing(strengths: Array, norms: Array, threshold: float) -> float:
    """Return where ``norms`` reach ``threshold``, between two levels by a power law."""
    above = np.flatnonzero(norms >= threshold)
    if not len(above):
        return float("inf")
    i = int(above[0])
    if i == 0:
        return float(strengths[0] * threshold / norms[0])
    if norms[i - 1] <= 0:
        return float(strengths[i])
    power = np.log(norms[i] / norms[i - 1]) / np.log(strengths[i] / strengths[i - 1])
    return float(strengths[i - 1] * (threshold / norms[i - 1]) ** (1 / max(power, 0.1)))
