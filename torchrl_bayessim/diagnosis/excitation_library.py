"""Commands that a robot may be moved by in an experiment: a library, within given limits."""

from __future__ import annotations

__all__ = ["excitations"]

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_TONES = 6  # of a multisine
_FASTEST = 0.1  # cycles per control step
_SWITCH = 3  # control steps between switches, at least


def excitations(
    low: Array, high: Array, *, steps: int, dt: float, generator: np.random.Generator
) -> dict[str, Array]:
    """Return sequences of commands by name, shape ``(steps, A)``, between ``low`` and ``high``.

    Slow triangles show what depends on the direction of motion, chirps and multisines lags and
    resonances, steps with holds biases and stiction, switching delays, a push with a coast
    afterwards what slows the robot down.

    Args:
        low: Lowest command of each actuator, shape ``(A,)``.
        high: Highest.
        steps: Control steps.
        dt: Seconds per control step.
        generator: Of random levels, times and phases.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> some = excitations(-np.ones(2), np.ones(2), steps=100, dt=0.02, generator=rng)
        >>> list(some)[:3], some["chirp"].shape
        (['slow triangle', 'chirp', 'multisine'], (100, 2))
    """
    size = len(low)
    time = np.arange(steps)[:, None]
    lag = np.arange(size) / max(size, 1)  # so that actuators do not move as one
    waves = {
        "slow triangle": 4 * np.abs((2 * time / steps + lag + 0.25) % 1 - 0.5) - 1,
        "chirp": np.sin(2 * np.pi * (_phase(steps)[:, None] + lag)),
        "multisine": _multisine(steps, size, generator),
        "steps and holds": _levels(steps, size, hold=max(_SWITCH, round(0.5 / dt)), rng=generator),
        "fast switching": np.sign(_levels(steps, size, hold=_SWITCH, rng=generator)),
        "push and coast": np.where((time + lag * steps / 4) % (steps / 2) < steps / 8, 1.0, 0.0)
        * np.where(time < steps / 2, 1.0, -1.0),
    }
    return {name: (low + high) / 2 + wave * (high - low) / 2 for name, wave in waves.items()}


def _phase(steps: int) -> Array:
    """Return cycles so far, of a frequency that grows geometrically."""
    frequency = np.geomspace(min(1.0 / steps, _FASTEST), _FASTEST, steps)
    return np.cumsum(frequency)


def _multisine(steps: int, size: int, rng: np.random.Generator) -> Array:
    tones = np.geomspace(2.0 / steps, _FASTEST, _TONES)
    phases = rng.uniform(0, 2 * np.pi, (_TONES, size))
    angle = 2 * np.pi * tones[:, None, None] * np.arange(steps)[:, None] + phases[:, None]
    wave = np.sin(angle).sum(0)
    return wave / np.abs(wave).max(0)


def _levels(steps: int, size: int, *, hold: int, rng: np.random.Generator) -> Array:
    """Return random levels, each held for one to three times ``hold`` control steps."""
    wave = np.empty((steps, size))
    for actuator in range(size):
        at = 0
        while at < steps:
            stop = at + int(rng.integers(hold, 3 * hold + 1))
            wave[at:stop, actuator] = rng.uniform(-1, 1)
            at = stop
    return wave
