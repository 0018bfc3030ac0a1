"""Model effects on environments that are reset again and again, without ever compounding.

At a reset the entries that an effect wrote get back what they held before, unless something else
has written them since; then physics write absolute values; then the effect acts on those.
"""

from __future__ import annotations

__all__ = ["Overlay"]

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..physics.consequences import DERIVED_FROM
from .effect import ModelEffect
from .fields import Entry, ModelFields, Models
from .robot import Robot

_Array = NDArray[np.float64]


class Overlay:
    """What one effect has written to the models of environments.

    Args:
        models: The models of ``P`` environments.
    """

    def __init__(self, models: Models) -> None:
        self._models = models
        self._written: dict[Entry, tuple[_Array, _Array]] = {}  # before and since, shape (P,)

    def remove(self, rows: NDArray[np.bool_]) -> None:
        """Undo in ``rows``, boolean, shape ``(P,)``, what is still as it was written."""
        stale = np.zeros_like(rows)
        for entry, (before, since) in self._written.items():
            now = self._models.read(*entry)
            mine = rows & (now == since)
            if mine.any():
                self._models.write(*entry, np.where(mine, before, now), np.ones_like(rows))
                stale |= mine & (entry[0] in DERIVED_FROM)
            since[rows] = np.nan
        if stale.any():
            self._models.refresh(stale)

    def put(
        self, effect: ModelEffect, strength: Tensor, robot: Robot, rows: NDArray[np.bool_]
    ) -> None:
        """Let the effect act in ``rows``, with strengths ``(P, N)``."""
        fields = ModelFields(self._models, rows)
        effect.write(fields, strength, robot)
        fields.finish()
        for entry, old in fields.before.items():
            now = self._models.read(*entry)
            nothing = np.full_like(old, np.nan)
            before, since = self._written.setdefault(entry, (nothing, nothing.copy()))
            changed = rows & (now != old)
            before[changed], since[changed] = old[changed], now[changed]
