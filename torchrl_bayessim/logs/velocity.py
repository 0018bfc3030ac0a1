r"""Velocities from positions: a local cubic polynomial, with the noise that it lets through.

Around every row a cubic is fitted by least squares to the ``2 h + 1`` nearest rows; the velocity is
its slope there, a sum :math:`\dot q = \sum_j w_j q_j` (Savitzky & Golay, 1964, for rows at
any times). With independent noise of standard deviation :math:`\sigma` on positions it has the
standard deviation :math:`g \sigma`, and the *gain* is :math:`g = \|w\|`.

The width is chosen by leave-one-out prediction: the widest whose error is within a twentieth of
the best.
"""

from __future__ import annotations

__all__ = ["angular_velocity", "velocity"]

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
_HALF_WIDTHS = (2, 3, 4, 6, 9, 13, 19, 28)


def velocity(time: Array, position: Array) -> tuple[Array, float, int]:
    """Return the velocity, its gain and the half width ``h`` of the window.

    Args:
        time: Increasing, shape ``(T,)``, at least 5 rows.
        position: Shape ``(T,)``.

    Returns:
        Shape ``(T,)``; the median gain, 1/s; ``h``. The first and last ``h`` rows are fitted from
        one side and have larger gains.

    Example:
        >>> t = np.arange(50) * 0.01
        >>> slope, gain, half = velocity(t, np.sin(3 * t))
        >>> bool(np.abs(slope - 3 * np.cos(3 * t)).max() < 1e-3)
        True
    """
    return _fitted(time, lambda rows: (position[rows] - position[:, None])[..., None])


def angular_velocity(time: Array, quaternion: Array) -> tuple[Array, float, int]:
    """Return angular velocities in the frame of the body, shape ``(T, 3)``; else as `velocity`.

    Args:
        time: Shape ``(T,)``.
        quaternion: Unit quaternions ``w, x, y, z``, shape ``(T, 4)``.
    """

    def near(rows: Rows) -> Array:
        own = np.repeat(quaternion, rows.shape[1], axis=0)
        own, other = (
            Rotation.from_quat(q, scalar_first=True) for q in (own, quaternion[rows.reshape(-1)])
        )
        return (own.inv() * other).as_rotvec().reshape(*rows.shape, 3)

    return _fitted(time, near)


def _fitted(time: Array, near: Callable[[Rows], Array]) -> tuple[Array, float, int]:
    """Fit in windows of every width; ``near`` gives what neighbours differ by, ``(T, w, K)``."""
    fits = []
    for half in _HALF_WIDTHS:
        if 2 * half + 1 > max(5, len(time) // 2):
            break
        rows, smooth, slope = _weights(time, half)
        differences = near(rows)
        own = (rows == np.arange(len(time))[:, None]).nonzero()
        leverage = smooth[own]
        # the row itself differs from itself by zero: what is fitted there is the residual
        fitted = np.einsum("tw,twk->tk", smooth, differences)
        error = np.mean((fitted / (1 - leverage[:, None])) ** 2)
        fits.append((error, half, np.einsum("tw,twk->tk", slope, differences), slope))
    best = min(error for error, *_ in fits)
    _, half, result, slope = [fit for fit in fits if fit[0] <= 1.05 * best][-1]
    gain = float(np.median(np.linalg.norm(slope, axis=1)))
    return (result[:, 0] if result.shape[1] == 1 else result), gain, half


def _weights(time: Array, half: int) -> tuple[Rows, Array, Array]:
    """Return each row's window, and the weights of the value and of the slope, ``(T, w)``."""
    width = 2 * half + 1
    first = np.clip(np.arange(len(time)) - half, 0, len(time) - width)
    rows = first[:, None] + np.arange(width)
    offset = time[rows] - time[:, None]
    scale = np.abs(offset).max(1, keepdims=True)
    powers = (offset / scale)[..., None] ** np.arange(4)
    normal = np.einsum("twi,twj->tij", powers, powers)
    weights = np.linalg.solve(normal, powers.transpose(0, 2, 1))
    return rows, weights[:, 0], weights[:, 1] / scale
