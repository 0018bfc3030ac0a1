r"""Velocities from positions: a local cubic polynomial, with the noise that it lets through.

Around every row a cubic is fitted by least squares to the ``2 h + 1`` nearest rows; the velocity is
its slope there, a sum :math:`\dot q = \sum_j w_j q_j` (Savitzky & Golay, 1964, for rows at
any times). With independent noise of standard deviation :math:`\sigma` on positions it has the
standard deviation :math:`g \sigma`, and the *gain* is :math:`g = \|w\|`.

The width is chosen by leave-one-out prediction: the widest whose error is within a twentieth of
the best. What a wide one leaves should be noise, one row like another. Where that is much of how
the position varies, and swings back within a few rows, the motion is faster than any polynomial,
and a wide window would only lose the rows at the ends: the narrowest is taken.
"""

from __future__ import annotations

__all__ = ["Windows", "angular_velocity", "velocity"]

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
_HALF_WIDTHS = (2, 3, 4, 6, 9, 13, 19, 28)
_SOON = 1, 2, 3  # rows, within which no polynomial swings there and back
_SWINGING = -0.4  # correlation of what is left with itself so soon; of noise -0.2 on average
_WIDE = 9  # half width from which noise alone is seldom correlated so
_MUCH = 0.1  # of a position's variance


class Windows:
    """Least squares around every row, set up once for all positions of a record.

    Args:
        time: Increasing, shape ``(T,)``, at least 5 rows.
    """

    def __init__(self, time: Array) -> None:
        self._time, self._step = time, np.diff(time).mean()
        self._even = bool(np.abs(np.diff(time) - self._step).max() <= 0.02 * self._step)
        self._fits: dict[int, tuple[Rows, Array, Array]] = {}

    @property
    def half_widths(self) -> list[int]:
        """Half widths ``h`` that leave at least as many rows outside as inside."""
        fitting = [h for h in _HALF_WIDTHS if 2 * h + 1 <= len(self._time) // 2]
        return fitting or [2]

    def fit(self, half: int) -> tuple[Rows, Array, Array]:
        """Return each row's window, and the weights of the value and of the slope, ``(T, w)``."""
        if half not in self._fits:
            count, width = len(self._time), 2 * half + 1
            first = np.clip(np.arange(count) - half, 0, count - width)
            rows = first[:, None] + np.arange(width)
            if self._even:  # all windows alike: only the place of the row in its window matters
                own = np.arange(count) - first
                smooth, slope = _weights(np.arange(width) - np.arange(width)[:, None])
                smooth, slope = smooth[own], slope[own] / self._step
            else:
                smooth, slope = _weights(self._time[rows] - self._time[:, None])
            self._fits[half] = rows, smooth, slope
        return self._fits[half]


def velocity(windows: Windows, position: Array) -> tuple[Array, float, int]:
    """Return the velocity, its gain and the half width ``h`` of the window.

    Args:
        windows: Of the record's times.
        position: Shape ``(T,)``.

    Returns:
        Shape ``(T,)``; the median gain, 1/s; ``h``. The first and last ``h`` rows are fitted from
        one side and have larger gains.

    Example:
        >>> t = np.arange(50) * 0.01
        >>> slope, gain, half = velocity(Windows(t), np.sin(3 * t))
        >>> bool(np.abs(slope - 3 * np.cos(3 * t)).max() < 1e-3)
        True
    """
    slope, gain, half = _fitted(windows, lambda rows: position[rows] - position[:, None])
    return slope, gain, half


def angular_velocity(windows: Windows, quaternion: Array) -> tuple[Array, float, int]:
    """Return angular velocities in the frame of the body, shape ``(T, 3)``; else as `velocity`.

    Args:
        windows: Of the record's times.
        quaternion: Unit quaternions ``w, x, y, z``, shape ``(T, 4)``.
    """

    def near(rows: Rows) -> Array:
        own = np.repeat(quaternion, rows.shape[1], axis=0)
        own, other = (
            Rotation.from_quat(q, scalar_first=True) for q in (own, quaternion[rows.reshape(-1)])
        )
        turns = (own.inv() * other).as_rotvec().reshape(*rows.shape, 3)
        return np.moveaxis(turns, -1, 0)

    slope, gain, half = _fitted(windows, near)
    return slope.T, gain, half


def _weights(offset: NDArray[Any]) -> tuple[Array, Array]:
    """Return weights of value and slope at offset 0, from windows of offsets, ``(N, w)``."""
    scale = np.abs(offset).max(1, keepdims=True)
    powers = (offset / scale)[..., None] ** np.arange(4)
    transposed = powers.transpose(0, 2, 1)
    weights = np.linalg.solve(transposed @ powers, transposed)
    return weights[:, 0], weights[:, 1] / scale


def _fitted(windows: Windows, near: Callable[[Rows], Array]) -> tuple[Array, float, int]:
    """Fit in windows of every width; ``near`` gives what neighbours differ by, ``(*, T, w)``."""
    fits = []
    for half in windows.half_widths:
        rows, smooth, slope = windows.fit(half)
        differences = near(rows)
        leverage = smooth[rows == np.arange(len(rows))[:, None]]
        # a row differs from itself by zero, so what is fitted there is the residual
        residual = (smooth * differences).sum(-1) / (1 - leverage)
        fits.append((np.mean(residual**2), half, (slope * differences).sum(-1), slope, residual))
        if fits[-1][0] > 2 * min(error for error, *_ in fits):
            break  # wider windows only bend more
    best = min(error for error, *_ in fits)
    _, half, result, slope, residual = [fit for fit in fits if fit[0] <= 1.05 * best][-1]
    first = np.zeros((residual.shape[-1], 1), dtype=np.int64)
    if half >= _WIDE and _swings(residual, near(first)[..., 0]):
        _, half, result, slope, _ = fits[0]
    return result, float(np.median(np.linalg.norm(slope, axis=1))), half


def _swings(residual: Array, moved: Array) -> bool:
    """Return whether residuals ``(*, T)`` turn round within a few rows, as noise does not.

    Args:
        residual: Of a wide window.
        moved: How far each row is from the first, ``(*, T)``.
    """
    power = np.mean(residual**2)
    if power < _MUCH * np.mean(np.var(moved, axis=-1)):
        return False  # a smooth motion with what its sensor makes of it
    later = [np.mean(residual[..., k:] * residual[..., :-k]) for k in _SOON]
    return bool(min(later) < _SWINGING * power)
