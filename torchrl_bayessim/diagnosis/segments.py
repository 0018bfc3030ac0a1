"""Stretches of logs, each to be simulated from its measured start with its recorded actions.

Multiple shooting: over a whole rollout a small error grows until it says nothing (chaos, contact),
over a single step it drowns in the noise of the start state (Bock & Plitt 1984; Ribeiro et al.
2020). So logs are cut into segments of ``horizon`` control steps. Each carries the rows before it,
from which delay lines and filters know what came in.
"""

from __future__ import annotations

__all__ = ["Segments", "cut", "cut_for_fits", "of_velocities"]

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..errors import message
from ..logs.log import Log
from ..logs.touching import Touching

Array = NDArray[np.float64]
_CHECKS = 10  # compared rows per segment
_SKIP = 5  # control steps: the longest delay


@dataclass(frozen=True, eq=False)
class Segments:
    """``S`` segments of ``horizon`` control steps.

    Windows hold ``history`` rows before the start, the start, ``horizon`` rows after it and
    ``history`` more; beyond a log's ends its first and last row stand again.

    Attributes:
        horizon: Control steps.
        history: Rows before the start, and after the end.
        checked: After which of the ``horizon`` steps the simulation is compared, ``(K,)``, from 1.
        log: Which log each is from, shape ``(S,)``.
        start: The row at which each starts, shape ``(S,)``.
        time: Seconds, windows, shape ``(S, W)``.
        qpos: Positions, windows, shape ``(S, W, nq)``.
        qvel: Velocities, windows, shape ``(S, W, nv)``.
        ctrl: Commands, windows, shape ``(S, W, A)``.
        velocity_gain: Noise of an estimated velocity per noise of the position, ``(nv,)``.
        velocity_error: Of an estimated velocity, where motion is too fast for it, ``(nv,)``.
        uncertainty: Covariance of what was estimated of each start state, ``(S, 2 nv, 2 nv)``;
            nothing where all that matters was measured.
        smoothed: Whether that estimate knows of the rows that are to be predicted from it.
        touching: What contacts say of each measured start; nothing where nothing touches.
    """

    horizon: int
    history: int
    checked: NDArray[np.int64]
    log: NDArray[np.int64]
    start: NDArray[np.int64]
    time: Array
    qpos: Array
    qvel: Array
    ctrl: Array
    velocity_gain: Array
    velocity_error: Array
    uncertainty: Array | None = None
    smoothed: bool = False
    touching: Touching | None = None

    def __len__(self) -> int:
        return len(self.start)

    @property
    def rows(self) -> NDArray[np.int64]:
        """Where in a window the compared rows are, shape ``(K,)``."""
        return self.history + self.checked

    def freed(self, steps: Array) -> Array:
        """Return what contacts leave of errors of measured starts, ``(*, S, 2 nv)``."""
        return steps if self.touching is None else self.touching.freed(steps)

    def take(self, index: NDArray[np.int64]) -> Segments:
        """Return some of the segments."""
        names = "log", "start", "time", "qpos", "qvel", "ctrl", "uncertainty"
        known = {n: getattr(self, n) for n in names if getattr(self, n) is not None}
        return replace(
            self,
            touching=None if self.touching is None else self.touching.take(index),
            **{n: values[index] for n, values in known.items()},
        )


def cut(
    logs: Sequence[Log],
    horizon: int,
    *,
    history: int = 0,
    most: int | None = None,
    checks: int | None = None,
    burn_in: int = 0,
    skip: int = 0,
    stride: int | None = None,
) -> Segments:
    """Cut logs into segments that follow one another, or overlap.

    Args:
        logs: The logs.
        horizon: Control steps per segment.
        history: Rows that effects with a memory look back at.
        most: At most so many segments, evenly taken from all.
        checks: Compare after so many of the steps, evenly spaced and ending with the last;
            default after each.
        burn_in: Rows at the beginning of each log in which no segment starts, since nobody knows
            what was commanded before; an eighth of the log at most.
        skip: Compare nothing in the first rows, half of the horizon at most: a sensor that lags
            shows there what was measured before the start, which is no prediction.
        stride: Rows from one start to the next, so that segments overlap, and a last one up to the
            log's end; default the horizon.

    Raises:
        ValueError: No log is longer than the horizon.

    Example:
        >>> import torch
        >>> still = Log(
        ...     name="still",
        ...     time=torch.arange(21).double() / 100,
        ...     qpos=torch.zeros(21, 1).double(),
        ...     qvel=torch.zeros(21, 1).double(),
        ...     ctrl=torch.zeros(21, 1).double(),
        ...     velocity_gain=torch.zeros(1).double(),
        ...     measured=torch.ones(2, dtype=torch.bool),
        ... )
        >>> cut([still], 5).start
        array([ 0,  5, 10, 15])
    """
    found = [
        (i, k)
        for i, log in enumerate(logs)
        for k in _starts(min(burn_in, len(log) // 8), len(log) - horizon, horizon, stride)
    ]
    if not found:
        longest = max((len(log) for log in logs), default=0)
        expected = f"a log of more than {horizon} rows, one segment"
        raise ValueError(message(expected, f"{longest} rows", hint="record longer"))
    if most is not None and len(found) > most:
        keep = np.linspace(0, len(found) - 1, most).round().astype(int)
        found = [found[i] for i in keep]
    step = 1 if checks is None else max(1, -(-(horizon - skip) // checks))
    checked = np.arange(horizon, min(skip, horizon // 2), -step)[::-1].astype(np.int64)
    offsets = np.arange(-history, horizon + history + 1)

    def windows(name: str) -> Array:
        parts = []
        for i, k in found:
            values = getattr(logs[i], name).numpy()
            parts.append(values[np.clip(k + offsets, 0, len(values) - 1)])
        return np.stack(parts)

    log, start = np.array(found, dtype=np.int64).T
    return Segments(
        horizon,
        history,
        checked,
        log,
        start,
        windows("time"),
        windows("qpos"),
        windows("qvel"),
        windows("ctrl"),
        *of_velocities(logs),
        uncertainty=_at(found, [log.uncertainty for log in logs]),
        smoothed=any(log.smoothed for log in logs),
        touching=_touching(found, [log.touching for log in logs]),
    )


def _starts(first: int, end: int, horizon: int, stride: int | None) -> list[int]:
    """Return where segments start, before a row, with a last one there if they overlap."""
    starts = list(range(first, end, stride or horizon))
    if stride is not None and starts and starts[-1] < end - 1:
        starts.append(end - 1)
    return starts


def of_velocities(logs: Sequence[Log]) -> tuple[Array, Array]:
    """Return the largest gain and error of estimated velocities in several logs, ``(nv,)`` each."""
    gain = np.max([log.velocity_gain.numpy() for log in logs], axis=0)
    errors = [log.velocity_error.numpy() for log in logs if log.velocity_error is not None]
    return gain, np.max([np.zeros_like(gain), *errors], axis=0)


def _at(found: Sequence[tuple[int, int]], values: Sequence[Tensor | None]) -> Array | None:
    """Return what is known of starts, log ``i`` and row ``k`` each; nothing unless of all logs."""
    known = [one.numpy() for one in values if one is not None]
    return np.stack([known[i][k] for i, k in found]) if len(known) == len(values) else None


def _touching(
    found: Sequence[tuple[int, int]], values: Sequence[Touching | None]
) -> Touching | None:
    """Return the same of contacts."""
    known = [one for one in values if one is not None]
    if len(known) < len(values):
        return None
    return Touching(
        *(np.stack([part[i][k] for i, k in found]) for part in zip(*known, strict=True))
    )


def cut_for_fits(logs: Sequence[Log], horizon: int, *, history: int, most: int) -> Segments:
    """Cut logs into the segments that fits, screens and figures are made on."""
    return cut(
        logs,
        horizon,
        history=history,
        most=most,
        checks=_CHECKS,
        burn_in=history,
        skip=_SKIP,
    )
