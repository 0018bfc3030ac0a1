"""Logs side by side, through which a simulator goes from row to row."""

from __future__ import annotations

__all__ = ["Record"]

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..logs.log import Log
from .segments import Segments

Array = NDArray[np.float64]


class Record:
    """Logs side by side; the shorter ones stand still at their ends.

    Args:
        logs: ``N`` logs.
        length: Rows ``T``.

    Attributes:
        time: Seconds, shape ``(N, T)``.
        ctrl: Commands, shape ``(N, T, A)``.
        qpos: Positions, shape ``(N, T, nq)``.
        qvel: Velocities, shape ``(N, T, nv)``.
        alive: Which rows the logs have, shape ``(N, T)``.
    """

    def __init__(self, logs: Sequence[Log], length: int) -> None:
        def padded(name: str) -> Array:
            parts = [getattr(log, name).numpy() for log in logs]
            return np.stack([p[np.minimum(np.arange(length), len(p) - 1)] for p in parts])

        self.time, self.ctrl = padded("time"), padded("ctrl")
        self.qpos, self.qvel = padded("qpos"), padded("qvel")
        self.alive = np.arange(length) < np.array([len(log) for log in logs])[:, None]

    def step(self, qpos: Array, qvel: Array, t: int) -> Segments:
        """Return segments of one control step from states ``(N, nq + nv)`` at row ``t``."""

        def twice(values: Array) -> Array:
            return np.repeat(values[:, None], 2, axis=1)

        none = np.zeros(len(self.time), dtype=np.int64)
        return Segments(
            horizon=1,
            history=0,
            checked=np.ones(1, dtype=np.int64),
            log=none,
            start=none,
            time=twice(self.time[:, t]),
            qpos=twice(qpos),
            qvel=twice(qvel),
            ctrl=twice(self.ctrl[:, t]),
            velocity_gain=np.zeros(qvel.shape[1]),
            velocity_error=np.zeros(qvel.shape[1]),
        )
