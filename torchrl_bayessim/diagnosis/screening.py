"""Every effect at once: does what it would change look like what the simulator gets wrong?

A matched filter whose templates the simulator makes. With innovations ``r̃`` at the nominal fit and
``r̃(e, ℓ)`` with unit ``e`` at strength ``ℓ``, the signature is their difference, with everything
that the parameters can explain projected out::

    g = M (r̃ - r̃(e, ℓ)),   M = I - QQᵀ,   Q = orth [J_θ; I],   LR = max(0, gᵀr̃ / ‖g‖)² / φ,

a score test with finite strengths in place of derivatives, which also works for delays and dead
bands (Rao 1948; nuisance rejection as in Basseville & Nikiforov 1993, ch. 7). The null of the
largest LR is drawn from the signatures' own correlations, and so accounts for the search.

Where there are many segments, all units are first compared on some of them, and what stands out, or
could in a pair, on all.
"""

from __future__ import annotations

__all__ = ["Screen", "crossing", "screen"]

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .objective import Objective, Unit
from .refit import Fit, with_prior

Array = NDArray[np.float64]
LEVELS = (0.05, 0.4)  # of an effect's range
_BETWEEN = (0.08, 0.13, 0.2)  # where one period, or one limit, does not look like another
_ALIKE = 0.02  # of a signature: what mixtures of others leave of one that is theirs
_WILD = 500.0  # standard deviations
_POWER = 0.84  # of the normal distribution at 0.8, to state what would have been seen
_HELD_OUT = 2.0  # times that, for other runs to show it too


@dataclass(frozen=True, eq=False)
class Screen:
    """The signatures of units at several strengths, and how well each matches.

    Attributes:
        units: The unit of each signature, length ``G``.
        strengths: Its strength, shape ``(G,)``.
        norms: ``‖g‖``: how many standard deviations the unit would move the data, ``(G,)``.
        sizes: The same, also of what moves them too far to be compared.
        scores: ``gᵀr̃ / ‖g‖``, shape ``(G,)``.
        correlation: Cosines between signatures, shape ``(G, G)``.
        swallowed: Share of each signature that parameters would explain, shape ``(G,)``.
        residual: ``‖r̃_⊥‖²``, what the parameters leave.
        effective: Number of innovations.
        changes: What each simulation changed of the innovations, shape ``(S, KC)`` each.
        growth: How much larger the norm of each would be on all segments, shape ``(G,)``: 1 for
            those that were compared there.
    """

    units: tuple[Unit, ...]
    strengths: Array
    norms: Array
    sizes: Array
    scores: Array
    correlation: Array
    swallowed: Array
    residual: float
    effective: int
    changes: tuple[NDArray[np.float32], ...]
    growth: Array

    def ratios(self, dispersion: float) -> Array:
        """Return the likelihood ratio of each signature, shape ``(G,)``."""
        return np.maximum(self.scores, 0.0) ** 2 / dispersion

    def best(self, dispersion: float) -> dict[Unit, tuple[float, float]]:
        """Return each unit's largest likelihood ratio and its strength, the largest first."""
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
                share = np.clip(amplitude, 0.1, 10.0) if unit.effect.graded else 1.0
                scaled = float(share * strength)
                result[unit] = float(ratio), unit.inside(scaled)
        return dict(sorted(result.items(), key=lambda item: -item[1][0]))

    def beside(self, near: Collection[Unit], dispersion: float) -> dict[Unit, float]:
        r"""Return what each other unit explains that no mixture of some could.

        A likelihood ratio, at the unit's best strength. With the signatures :math:`N` of those that
        are near, of correlations :math:`C`, and the scores :math:`z` of all::

            z'_i = (z_i - C_{iN} C_{NN}^+ z_N) / \sqrt{1 - C_{iN} C_{NN}^+ C_{Ni}}.

        Args:
            near: Units whose signatures, at any strengths, are projected out.
            dispersion: Variance of what is left.
        """
        whole = self.growth == self.growth.min(initial=np.inf)
        seen = np.flatnonzero((self.norms > 0) & whole).tolist()
        rows = np.array([i for i in seen if self.units[i] in near], dtype=int)
        values, vectors = np.linalg.eigh(self.correlation[np.ix_(rows, rows)])
        known = values > _ALIKE * values.max(initial=0.0)
        basis = vectors[:, known] / np.sqrt(values[known])
        part = self.correlation[:, rows] @ basis
        scores = self.scores - part @ (basis.T @ self.scores[rows])
        own = 1.0 - (part**2).sum(1)
        result: dict[Unit, float] = {}
        for i in seen:
            if self.units[i] not in near and own[i] > _ALIKE:
                ratio = float(max(scores[i], 0.0) ** 2 / own[i] / dispersion)
                result[self.units[i]] = max(result.get(self.units[i], 0.0), ratio)
        return result

    def null(self, draws: int, generator: np.random.Generator) -> Array:
        """Return largest likelihood ratios under noise alone, shape ``(draws,)``."""
        size = len(self.correlation)
        root = np.linalg.cholesky(self.correlation + 1e-5 * np.eye(size))
        noise = generator.standard_normal((draws, size)) @ root.T
        return np.maximum(noise, 0.0).max(1) ** 2

    def detectable(self, alpha: float) -> dict[Unit, float]:
        """Return the least strength of each unit that a diagnosis would not call nothing.

        ``‖g(s)‖`` reaches twice what a search over all units at level ``alpha`` sees with
        probability 0.8, since runs that it was not fitted on must show the effect too. Strengths
        between levels by power laws, ``inf`` where even the highest level is not seen.
        """
        seen = np.sqrt(2 * np.log(max(len(set(self.units)), 2) / alpha)) + _POWER
        threshold = _HELD_OUT * seen
        norms = self.sizes * self.growth
        result: dict[Unit, float] = {}
        for unit in dict.fromkeys(self.units):
            rows = [i for i, u in enumerate(self.units) if u == unit and self.strengths[i] > 0]
            rows.sort(key=lambda i: self.strengths[i])
            result[unit] = crossing(self.strengths[rows], norms[rows], threshold)
        return result

    def origin(self, fit: Fit, added: Sequence[Unit]) -> Fit | None:
        """Return the fit with units added at strength zero, derivatives by the screen's changes.

        Nothing where a unit was not compared on the segments of the fit.
        """
        columns = [fit.jacobian]
        for unit in added:
            rows = [
                i
                for i, u in enumerate(self.units)
                if u == unit and self.changes[i].shape == fit.innovations.shape
            ]
            if not rows:
                return None
            row = max(rows, key=lambda i: self.scores[i])
            relative = self.strengths[row] / unit.high
            columns.append(self.changes[row].reshape(-1, 1) / relative)
        point = fit.point.beside(dict.fromkeys(added, 0.0))
        return Fit(point, tuple(point.strengths), fit.innovations, np.concatenate(columns, 1))

    def grown(self, every: int) -> Screen:
        """Return this screen of every so many segments as one of all."""
        return replace(
            self,
            residual=self.residual * every,
            effective=self.effective * every,
            growth=self.growth * np.sqrt(every),
        )

    def joined(self, coarse: Screen, every: int) -> Screen:
        """Return this screen with the units that only a screen of every so many segments has."""
        mine = set(self.units)
        rows = np.array([i for i, unit in enumerate(coarse.units) if unit not in mine], dtype=int)
        size = len(self.units)
        correlation = np.eye(size + len(rows))
        correlation[:size, :size] = self.correlation
        correlation[size:, size:] = coarse.correlation[np.ix_(rows, rows)]
        return replace(
            self,
            units=self.units + tuple(coarse.units[i] for i in rows),
            strengths=np.r_[self.strengths, coarse.strengths[rows]],
            norms=np.r_[self.norms, coarse.norms[rows]],
            sizes=np.r_[self.sizes, coarse.sizes[rows]],
            scores=np.r_[self.scores, coarse.scores[rows]],
            correlation=correlation,
            swallowed=np.r_[self.swallowed, coarse.swallowed[rows]],
            changes=self.changes + tuple(coarse.changes[i] for i in rows),
            growth=np.r_[self.growth, np.full(len(rows), np.sqrt(every))],
        )


def screen(
    objective: Objective,
    fit: Fit,
    units: Sequence[Unit],
    *,
    levels: Sequence[float] | None = None,
) -> Screen:
    """Compare every unit at several strengths with what the fit leaves unexplained.

    Args:
        objective: What to explain.
        fit: What is in the model already; its units are projected out like parameters.
        units: The effects to try.
        levels: Strengths to try, as positive shares of a unit's range; default those that suit it.
    """
    shares = {unit: _levels(unit) if levels is None else levels for unit in units}
    rows = [(unit, level * unit.high) for unit in units for level in shares[unit]]
    rows += [(unit, LEVELS[-1] * unit.low) for unit in units if unit.low < 0]
    changes, wild = [], []
    chunk = max(1, 40_000_000 // max(fit.innovations.size, 1))
    for begin in range(0, len(rows), chunk):
        points = [fit.point.more(unit, level) for unit, level in rows[begin : begin + chunk]]
        for innovations in objective(points):
            change = (innovations - fit.innovations).astype(np.float32)
            # what is so far off, or diverged, explains nothing: but it would have been seen
            wild.append(float(np.linalg.norm(change)) if _is_wild(innovations) else 0.0)
            changes.append(np.zeros_like(change) if wild[-1] else change)
    # little of an effect does the opposite of as little of its opposite
    small = [i for i, (unit, level) in enumerate(rows) if unit.low < 0 < level < unit.high / 10]
    rows += [(unit, level / unit.high * unit.low) for unit, level in [rows[i] for i in small]]
    changes += [changes[i] * np.float32(rows[i][0].low / rows[i][0].high) for i in small]
    wild += [wild[i] for i in small]
    return _compared(rows, changes, fit, objective.size, wild=np.array(wild))


def _levels(unit: Unit) -> tuple[float, ...]:
    """Return the strengths to try, as shares of the unit's range.

    A limit that is never reached is no limit, and one that is always reached hides what it does:
    between them is little.
    """
    steady = unit.effect.search_power == 1 and not unit.effect.limit
    return LEVELS if steady else tuple(sorted(LEVELS + _BETWEEN))


def _is_wild(innovations: Array) -> bool:
    return bool((np.abs(innovations) > _WILD).any())


def _compared(
    rows: Sequence[tuple[Unit, float]],
    changes: Sequence[NDArray[np.float32]],
    fit: Fit,
    size: int,
    *,
    wild: Array,
) -> Screen:
    """Return the screen of what simulations changed, ``wild`` by the size of those left out."""
    basis = _basis(fit, size)
    left = np.r_[fit.innovations.ravel(), -fit.point.z[:size]]
    left = left - basis @ (basis.T @ left)
    flat = -np.stack([np.r_[c.ravel(), np.zeros(size)] for c in changes]) if changes else None
    if flat is None:
        flat = np.zeros((0, len(left)))
    before = np.linalg.norm(flat, axis=1)
    flat -= (flat @ basis) @ basis.T
    norms = np.linalg.norm(flat, axis=1)
    seen = (norms > 1e-6 * np.maximum(before, 1.0)) & (norms > 1e-6)
    norms = np.where(seen, norms, 0.0)
    directions = np.where(seen, 1 / np.where(seen, norms, 1.0), 0.0)[:, None] * flat
    return Screen(
        units=tuple(unit for unit, _ in rows),
        strengths=np.array([level for _, level in rows]),
        norms=norms,
        sizes=norms + wild,
        scores=directions @ left,
        correlation=directions @ directions.T,
        swallowed=np.where(seen, 1 - (norms / np.where(seen, before, 1.0)) ** 2, 0.0),
        residual=float(left @ left),
        effective=fit.innovations.size,
        changes=tuple(changes),
        growth=np.ones(len(rows)),
    )


def _basis(fit: Fit, size: int) -> Array:
    """Return an orthonormal basis of what the fit's own parameters can explain."""
    stacked = with_prior(fit.jacobian, size)
    if not stacked.shape[1]:
        return np.zeros((len(stacked), 0))
    left, values, _ = np.linalg.svd(stacked, full_matrices=False)
    return left[:, values > 1e-9 * max(values.max(), 1e-30)]


def crossing(strengths: Array, norms: Array, threshold: float) -> float:
    """Return where ``norms`` reach ``threshold``, between two levels by a power law.

    Below the lowest level in proportion, or by the power between the first two if they rise faster.
    """
    above = np.flatnonzero(norms >= threshold)
    if not len(above):
        return float("inf")
    i = int(above[0])
    if i == 0:
        rising = len(norms) > 1 and norms[1] > norms[0]
        power = max(1.0, _power(strengths, norms, 1)) if rising else 1.0
        return float(strengths[0] * (threshold / norms[0]) ** (1 / power))
    if norms[i - 1] <= 0:
        return float(strengths[i])
    power = _power(strengths, norms, i)
    return float(strengths[i - 1] * (threshold / norms[i - 1]) ** (1 / max(power, 0.1)))


def _power(strengths: Array, norms: Array, i: int) -> float:
    """Return with which power of the strength norms rise up to level ``i``."""
    return float(np.log(norms[i] / norms[i - 1]) / np.log(strengths[i] / strengths[i - 1]))
