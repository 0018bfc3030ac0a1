"""How the robots are moved: sums of sines, steps and holds, chirps, and a policy in closed loop."""

from __future__ import annotations

__all__ = ["KINDS", "open_loop", "proportional"]

import numpy as np
from numpy.typing import NDArray

from .plant import Policy

Array = NDArray[np.float64]
KINDS = ("multisine", "steps", "chirp")


def open_loop(kind: str, *, steps: int, dt: float, limit: Array, rng: np.random.Generator) -> Array:
    """Return commands within ``limit``, shape ``(steps, nu)``.

    Raises:
        ValueError: There is no such kind.
    """
    t = np.arange(steps) * dt
    columns = []
    for _ in limit:
        if kind == "multisine":
            hertz, phase = rng.uniform(0.2, 3.0, 5), rng.uniform(0, 2 * np.pi, 5)
            wave = np.sin(2 * np.pi * hertz * t[:, None] + phase).sum(1) / 2.5
        elif kind == "steps":
            wave, k = np.zeros(steps), 0
            while k < steps:
                hold = int(rng.uniform(0.15, 0.7) / dt) + 1
                wave[k : k + hold] = rng.uniform(-1, 1) if rng.random() < 0.8 else 0.0
                k += hold
        elif kind == "chirp":
            first, last = rng.uniform(0.1, 0.4), rng.uniform(2.0, 4.0)
            wave = np.sin(2 * np.pi * (first * t + (last - first) * t**2 / (2 * t[-1])))
        else:
            raise ValueError(f"expected one of {KINDS}, got {kind!r}")
        columns.append(np.clip(wave, -1, 1) * rng.uniform(0.5, 1.0))
    return np.stack(columns, 1) * limit


def proportional(reference: Array, dofs: Array, *, limit: Array, reach: float) -> Policy:
    """Return a policy that follows a reference with what it measures.

    Args:
        reference: Positions, ``(steps, nu)``.
        dofs: Index of the position that each actuator moves.
        limit: Of commands.
        reach: Error at which a command is at its limit.
    """
    stiffness = limit / reach

    def policy(k: int, y: Array) -> Array:
        error = reference[k] - y[dofs]
        u = stiffness * (error - 0.1 * y[len(y) // 2 + dofs])
        return np.clip(u, -limit, limit)

    return policy
