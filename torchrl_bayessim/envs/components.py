"""Components of start states and choices of environments, as they come from users."""

from __future__ import annotations

__all__ = ["chosen_rows", "finite_rows"]

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import message


def finite_rows(name: str, value: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return one row of finite numbers for each environment, in double precision.

    Example:
        >>> finite_rows("qvel", [[1, 2]], (1, 2))
        array([[1., 2.]])

    Raises:
        ValueError: ``value`` has not this shape (nothing is broadcast), or is not finite.
    """
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        got = "others" if array.shape == shape else array.shape
        raise ValueError(message(f"finite numbers of shape {shape} for {name}", got))
    return array


def chosen_rows(mask: ArrayLike | None, count: int) -> NDArray[np.int64]:
    """Return which of ``count`` environments a boolean mask chooses; without one, all.

    Example:
        >>> chosen_rows([True, False, True], 3)
        array([0, 2])

    Raises:
        ValueError: The mask is not boolean, or has not shape ``(count,)``.
    """
    if mask is None:
        return np.arange(count)
    array = np.asarray(mask)
    if array.shape != (count,) or array.dtype != bool:
        expected = f"a boolean mask of shape ({count},)"
        raise ValueError(message(expected, f"{array.dtype} of shape {array.shape}"))
    return np.flatnonzero(array)
