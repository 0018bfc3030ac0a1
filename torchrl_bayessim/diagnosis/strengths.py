"""How strongly effects act in each candidate of a batch."""

from __future__ import annotations

__all__ = ["Strengths"]

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import Effect

Strengths = Mapping[Effect, NDArray[np.float64]]
"""Strengths of the candidates, by effect: shape ``(P, N)`` for the effect's ``N`` targets."""
