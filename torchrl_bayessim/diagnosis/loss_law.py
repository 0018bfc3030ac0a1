"""How losses come about in short segments, and what a segment says of its own.

With ``ε_b`` the ``M`` innovations of a segment if the pattern ``b`` of its ``H`` values was lost,
``s`` the probability of a loss, ``φ`` the scatter, the segment has the density::

    p(ε) = (1 - η) Σ_b s^|b| (1 - s)^(H - |b|) N(ε_b; 0, φ I) + η N(ε; 0, κ φ I).

The second part is of segments that something else has spoiled, such as a contact that was missed.
"""

from __future__ import annotations

__all__ = ["LossLaw", "Told", "Tried"]

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax, xlog1py, xlogy

Array = NDArray[np.float64]
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
        return -2.0 * sum(float(np.sum(logsumexp(self._logs(p), axis=0))) for p in parts)

    def told(self, tried: Tried) -> Told:
        """Return what segments say of their losses."""
        likely = softmax(self._logs(tried), axis=0)
        every = np.concatenate([tried.squares, tried.squares[:1]])
        return Told(
            lost=likely[1:-1].sum(0),
            count=tried.lost @ likely[:-1],
            spoiled=likely[-1],
            before=tried.squares[0],
            after=(likely * every).sum(0),
        )

    def _logs(self, tried: Tried) -> Array:
        """Return log densities of every pattern and of spoiled segments, shape ``(B + 1, S)``."""
        prior = np.add(
            xlogy(tried.lost, self.share), xlog1py(tried.values - tried.lost, -self.share)
        )
        own = self._normal(tried.squares, self.scatter)
        own += (np.log1p(-self.spoiled) + prior)[:, None]
        wide = self._normal(tried.squares[:1], self.scatter * _WIDER[:, None])
        mean = logsumexp(wide, axis=0, keepdims=True) - np.log(len(_WIDER))
        return np.concatenate([own, np.log(self.spoiled) + mean])

    def _normal(self, squares: Array, variance: float | Array) -> Array:
        return -0.5 * self.size * (squares / variance + np.log(variance))
