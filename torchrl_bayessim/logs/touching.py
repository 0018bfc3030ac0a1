"""What contacts say of measured states, which sensors alone do not know."""

from __future__ import annotations

__all__ = ["Touching"]

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Touching(NamedTuple):
    """Of ``N`` measured states, in the tangent space of ``2 nv`` dimensions.

    Attributes:
        step: From each to the state that contacts allow, shape ``(N, 2 nv)``; 0 where none touch.
        free: What contacts leave of an error of the measured state, shape ``(N, 2 nv, 2 nv)``.
        error: Covariance of the error of ``step``, shape ``(N, 2 nv, 2 nv)``.
    """

    step: Array
    free: Array
    error: Array

    def take(self, index: NDArray[np.int64]) -> Touching:
        """Return that of some of the states.

        Example:
            >>> none = Touching(np.zeros((3, 2)), np.zeros((3, 2, 2)), np.zeros((3, 2, 2)))
            >>> none.take(np.array([0, 2])).error.shape
            (2, 2, 2)
        """
        return Touching(*(part[index] for part in self))

    def freed(self, steps: Array) -> Array:
        """Return what contacts leave of errors of the measured states, ``(*, N, 2 nv)``."""
        return np.einsum("sij,...sj->...si", self.free, steps)
