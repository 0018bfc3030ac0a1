"""Positions that no motion can have: far beyond all others, out and back within a row."""

from __future__ import annotations

__all__ = ["beyond_all"]

import numpy as np
from numpy.typing import NDArray

_LEAST = 0.5  # rad or m
_BEYOND = 2.0  # times what all other rows travel, so faster by far than anything among them


def beyond_all(position: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which rows, one in fifty at most, are out and back by more than others travel.

    An impact within a control step may turn a velocity, but brings no joint there and back.

    Example:
        >>> beyond_all(np.array([0.0, 0.1, 0.2, 30.0, 0.3, 0.4])).nonzero()[0]
        array([3])
    """
    before, after = np.diff(position)[:-1], -np.diff(position)[1:]
    apart = np.where(before * after > 0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    apart = np.concatenate([[0.0], apart, [0.0]])
    found = np.zeros(len(position), dtype=bool)
    for row in np.argsort(-apart)[: len(position) // 50 + 1]:  # the farthest hide those nearer
        others = ~found
        others[row] = False
        if apart[row] < max(_LEAST, _BEYOND * float(np.ptp(position[others]))):
            break
        found[row] = True
    return found
