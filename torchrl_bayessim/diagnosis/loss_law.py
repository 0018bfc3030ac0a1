"""How losses come about in short segments, and what a segment says of its own.

With ``ε_b`` the ``M`` innovations of a segment if the pattern ``b`` of its ``H`` values was lost,
``s`` the probability of a loss, ``φ`` the scatter, the segment has the density::

    p(ε) = (1 - η) Σ_b s^|b| (1 - s)^(H - |b|) / P(|b| ≤ B) N(ε_b; 0, φ I) + η N(ε; 0, κ φ I).

Patterns of more than ``B`` losses are too many to be tried. The second part is of segments that
something else has spoiled, such as a contact that was missed.
"""

from __future__ import annotations

__all__ = ["LossLaw", "Told", "Tried", "likeliest"]

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax, xlog1py, xlogy
from scipy.stats import binom, chi2

Array = NDArray[np.float64]
_FINER = np.geomspace(0.25, 4.0, 120)  # times the share of a coarse grid
_MOST = 0.95  # of a share
_SURE, _LEFT = 3.0, 0.05  # standard deviations of noise, or part of an excess, that may be left
_WIDER = np.array([4.0, 16.0, 64.0, 256.0])  # κ, each as likely


@dataclass(frozen=True, eq=False)
class Tried:
    """Segments under every pattern of losses.

    Attributes:
        squares: ``‖ε_b‖² / M``, shape ``(B, S)``; the first pattern has no loss.
        lost: ``|b|``, shape ``(B,)``.
        values: ``H``.
    """

    squares: Array
    lost: NDArray[np.int64]
    values: int

    @property
    def without(self) -> Tried:
        """The same without losses."""
        return Tried(self.squares[:1], self.lost[:1], self.values)


@dataclass(frozen=True, eq=False)
class Told:
    """What segments say of their losses.

    Attributes:
        lost: Probability of a loss, shape ``(S,)``.
        count: Expected number of losses, shape ``(S,)``.
        spoiled: Probability that something else has spoiled the segment, shape ``(S,)``.
        before: Mean squared innovations without losses, shape ``(S,)``.
        after: With the likely ones, shape ``(S,)``.
    """

    lost: Array
    count: Array
    spoiled: Array
    before: Array
    after: Array

    @classmethod
    def joined(cls, parts: Sequence[Told]) -> Told:
        """Return what the segments of several say."""
        names = "lost", "count", "spoiled", "before", "after"
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True)
class LossLaw:
    """How losses come about.

    Attributes:
        share: ``s``.
        scatter: ``φ``.
        spoiled: ``η``.
        size: ``M``.

    Example:
        >>> law = LossLaw(share=0.1, scatter=1.0, spoiled=0.01, size=20)
        >>> squares = np.array([[1.0, 9.0], [9.0, 1.0]])  # the second segment has a loss
        >>> law.told(Tried(squares, np.array([0, 1]), values=5)).lost.round(2)
        array([0., 1.])
    """

    share: float
    scatter: float
    spoiled: float
    size: int

    def deviance(self, parts: Sequence[Tried]) -> float:
        """Return ``-2 Σ log p`` over all segments."""
        grid = [self.share], [self.scatter], [self.spoiled]
        return float(_deviances(parts, *grid, size=self.size).item())

    def share_within(self, parts: Sequence[Tried]) -> tuple[float, float, float]:
        """Return the likeliest share, and the ends of its 95 % interval by the likelihood ratio.

        Example:
            >>> law = LossLaw(share=0.15, scatter=1.0, spoiled=0.01, size=20)
            >>> squares = np.full((6, 40), 9.0)
            >>> squares[0, :20] = squares[3, 20:] = 1.0  # every other segment has a loss
            >>> tried = Tried(squares, np.array([0, 1, 1, 1, 1, 1]), values=5)
            >>> np.round(law.share_within([tried]), 2)
            array([0.17, 0.1 , 0.27])
        """
        shares = np.minimum(_FINER * self.share, _MOST)
        grid = shares.tolist(), [self.scatter], [self.spoiled]
        values = _deviances(parts, *grid, size=self.size).ravel()
        likely = shares[values < values.min() + chi2.ppf(0.95, 1)]
        return float(shares[values.argmin()]), float(likely[0]), float(likely[-1])

    def told(self, tried: Tried) -> Told:
        """Return what segments say of their losses."""
        likely = self.likely(tried)
        every = np.concatenate([tried.squares, tried.squares[:1]])
        return Told(
            lost=likely[1:-1].sum(0),
            count=tried.lost @ likely[:-1],
            spoiled=likely[-1],
            before=tried.squares[0],
            after=(likely * every).sum(0),
        )

    def leaves_noise(self, before: Array, after: Array) -> bool:
        """Return whether losses leave noise alone of the segments that say most of them.

        With ``w`` the shares of segments in what losses explain, ``φ`` no less than noise, 1, since
        its grid is coarse, and ``σ² = 2 φ² Σ w² / M``::

            Σ w (after - φ) < max(3 σ, 0.05 Σ w (before - φ))

        Args:
            before: Mean squared innovations of segments that have losses without them, ``(S,)``.
            after: The same with them.

        Example:
            >>> law = LossLaw(share=0.1, scatter=1.0, spoiled=0.01, size=100)
            >>> before = np.array([4.0, 4.0, 1.1])
            >>> law.leaves_noise(before, np.array([1.1, 0.9, 1.0]))
            True
            >>> law.leaves_noise(before, np.array([1.6, 1.3, 1.0]))
            False
        """
        weights = np.maximum(before - after, 0.0)
        weights = weights / max(weights.sum(), 1e-300)
        noise = max(self.scatter, 1.0)
        chance = noise * np.sqrt(2.0 / self.size) * np.linalg.norm(weights)
        most = max(_SURE * chance, _LEFT * weights @ (before - noise))
        return bool(weights @ (after - noise) < most)

    def likely(self, tried: Tried) -> Array:
        """Return how likely each pattern is, and last that a segment is spoiled, ``(B + 1, S)``."""
        return np.asarray(softmax(self._logs(tried), axis=0))

    def _logs(self, tried: Tried) -> Array:
        """Return log densities of every pattern and of spoiled segments, shape ``(B + 1, S)``."""
        prior = _prior(tried.lost, np.array(self.share), tried)
        own = _normal(tried.squares, np.array(self.scatter), self.size)
        own += (np.log1p(-self.spoiled) + prior)[:, None]
        wide = _wide(tried, np.array(self.scatter), self.size)
        return np.concatenate([own, np.log(self.spoiled) + wide[None]])


def likeliest(
    parts: Sequence[Tried],
    shares: Sequence[float],
    scatters: Sequence[float],
    spoiled: Sequence[float],
    *,
    size: int,
) -> LossLaw:
    """Return the law of a grid under which segments are likeliest.

    Args:
        parts: Segments under every pattern of losses.
        shares: Values of ``s``.
        scatters: Values of ``φ``.
        spoiled: Values of ``η``.
        size: ``M``.

    Example:
        >>> tried = Tried(np.array([[1.0, 9.0], [9.0, 1.0]]), np.array([0, 1]), values=5)
        >>> likeliest([tried], [0.0, 0.1, 0.6], [1.0, 4.0], [0.01], size=20).share
        0.1
    """
    laws = [LossLaw(*some, size) for some in product(shares, scatters, spoiled)]
    return laws[int(_deviances(parts, shares, scatters, spoiled, size=size).argmin())]


def _deviances(
    parts: Sequence[Tried],
    shares: Sequence[float],
    scatters: Sequence[float],
    spoiled: Sequence[float],
    *,
    size: int,
) -> Array:
    """Return ``-2 Σ log p`` of every law of a grid, one axis per parameter.

    Patterns of as many losses share their prior: their densities are added up once for all ``s``.
    """
    share, scatter, eta = (np.asarray(values)[:, None] for values in (shares, scatters, spoiled))
    total = np.zeros((len(shares), len(scatters), len(spoiled)))
    for tried in parts:
        normal = _normal(tried.squares, scatter[..., None], size)
        counts = np.unique(tried.lost)
        each = [_total(normal[:, tried.lost == count], axis=1) for count in counts]
        prior = _prior(counts, share, tried)
        own = _total(np.stack(each, 1) + prior[:, None, :, None], axis=2)[:, :, None]
        wide = _wide(tried, scatter, size)[:, None]
        total += np.logaddexp(np.log1p(-eta) + own, np.log(eta) + wide).sum(-1)
    return -2.0 * total


def _prior(lost: NDArray[np.int64], share: Array, tried: Tried) -> Array:
    """Return the log probability of a pattern of so many losses, among those that were tried."""
    each = xlogy(lost, share) + xlog1py(tried.values - lost, -share)
    return np.asarray(each - binom.logcdf(tried.lost.max(), tried.values, share))


def _wide(tried: Tried, scatter: Array, size: int) -> Array:
    """Return the log density of spoiled segments, for scatters of shape ``(*, 1)`` or ``()``."""
    wide = _normal(tried.squares[0], scatter[..., None] * _WIDER[:, None], size)
    return _total(wide, axis=-2) - np.log(len(_WIDER))


def _total(logs: Array, *, axis: int) -> Array:
    return np.asarray(logsumexp(logs, axis=axis))


def _normal(squares: Array, variance: Array, size: int) -> Array:
    return -0.5 * size * (squares / variance + np.log(variance))
