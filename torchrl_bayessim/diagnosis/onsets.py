"""From where on an effect does anything in these data: limits that are never reached do nothing.

A saturation above all recorded commands changes nothing, and its first derivative is zero there.
So its strength is counted from the one at which it begins to act.
"""

from __future__ import annotations

__all__ = ["with_onsets"]

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .objective import Objective, Point, Unit

Index = NDArray[np.int64]
_HALVINGS = 8
_FIRST = 3  # segments that are looked at before the others
_NOTHING = 1e-6  # standard deviations


def with_onsets(objective: Objective, point: Point, units: Sequence[Unit]) -> list[Unit]:
    """Return the units, each limit with the largest strength that has no effect on the segments.

    Args:
        objective: The segments.
        point: Parameters.
        units: The effects; those that are no limits, or never act, are returned as they are.
    """
    if not any(unit.effect.limit for unit in units):
        return list(units)
    before = objective([point])[0]
    every = np.arange(len(before))

    def acting(unit: Unit, strength: float, some: Index) -> Index:
        """Return in which of some segments a strength does anything, where it does most first."""
        if not len(some):
            return some
        changed = objective.take(some)([Point(point.z, {unit: strength})])[0] - before[some]
        size = np.abs(changed).max(1)
        order = np.argsort(-size, kind="stable")
        return some[order[size[order] > _NOTHING]]

    def onset(unit: Unit) -> float:
        low, high, some = 0.0, unit.high, acting(unit, unit.high, every)
        for _ in range(_HALVINGS if len(some) else 0):
            middle = (low + high) / 2
            # a wider limit acts nowhere else, and last where this one does most
            if len(first := acting(unit, middle, some[:_FIRST])):
                high, some = middle, np.r_[first, some[_FIRST:]]
            elif len(others := acting(unit, middle, some[_FIRST:])):
                high, some = middle, others
            else:
                low = middle
        return low

    return [replace(u, onset=onset(u)) if u.effect.limit else u for u in units]
