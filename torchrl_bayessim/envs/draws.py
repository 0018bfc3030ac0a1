"""Random numbers for resets, a pure function of (seed, environment, episode) and the call.

An environment's n-th episode starts in the same state whatever the other environments do, however
they are grouped, and after a resume. The generator is counter based: SplitMix64's finaliser (Steele
et al. 2014, https://doi.org/10.1145/2660193.2660195), applied once per element of the key.
"""
# ruff: noqa: ANN001, ANN202, PLR0917 - numba infers types and takes no keywords

from __future__ import annotations

__all__ = ["Draws"]

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from ..randomness import seed_from

_ATTEMPTS = 1000


@numba.njit(cache=True)
def _mix(x):
    x += np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@numba.njit(cache=True)
def _fill(seed, rows, episodes, call, attempt, uniforms):
    for k in range(rows.shape[0]):
        key = _mix(np.uint64(seed) ^ np.uint64(rows[k]))
        key = _mix(key ^ np.uint64(episodes[k]))
        key = _mix(_mix(key ^ np.uint64(call)) ^ np.uint64(attempt))
        for j in range(uniforms.shape[1]):
            # 53 bits, shifted by half a step: never 0 and never 1
            uniforms[k, j] = ((_mix(key ^ np.uint64(j)) >> np.uint64(11)) + 0.5) * 2.0**-53


class Draws:
    """Draws for the environments ``rows``, each in its own ``episodes``-th episode.

    Example:
        >>> both = Draws(0, np.array([3, 5]), np.array([0, 2])).uniform(-1.0, 1.0, size=2)
        >>> one = Draws(0, np.array([5]), np.array([2])).uniform(-1.0, 1.0, size=2)
        >>> bool((both[1] == one[0]).all())
        True

    Args:
        seed: The environment's seed.
        rows: Environments, shape ``(B,)``.
        episodes: How many episodes each of them has had before, shape ``(B,)``.
    """

    def __init__(self, seed: int, rows: NDArray[np.int64], episodes: NDArray[np.int64]) -> None:
        self._key = seed_from(seed, "reset"), rows, episodes
        self._calls = 0

    def __len__(self) -> int:
        return len(self._key[1])

    def uniform(
        self,
        low: float | NDArray[np.float64],
        high: float | NDArray[np.float64],
        *,
        size: int,
        accept: Callable[[NDArray[np.float64]], NDArray[np.bool_]] | None = None,
    ) -> NDArray[np.float64]:
        """Draw uniform numbers, shape ``(B, size)``; again where ``accept`` says no."""
        unit = self._unit(size)
        drawn = low + (high - low) * unit
        if accept is None:
            return drawn
        for attempt in range(1, _ATTEMPTS):
            again = ~accept(drawn)
            if not again.any():
                break
            fresh = low + (high - low) * self._unit(size, attempt)
            drawn = np.where(again[:, None], fresh, drawn)
        return drawn

    def normal(self, *, size: int) -> NDArray[np.float64]:
        """Draw standard normal numbers, shape ``(B, size)`` (Box and Muller)."""
        radius, angle = np.split(self._unit(2 * size), 2, axis=1)
        return np.sqrt(-2.0 * np.log(radius)) * np.cos(2.0 * np.pi * angle)

    def _unit(self, size: int, attempt: int = 0) -> NDArray[np.float64]:
        seed, rows, episodes = self._key
        unit = np.empty((len(rows), size))
        self._calls += attempt == 0
        _fill(seed, rows, episodes, self._calls, attempt, unit)
        return unit
