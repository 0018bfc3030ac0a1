"""From where on an effect does anything in these data: limits that are never reached do nothing.

A saturation above all recorded commands changes nothing, and its first derivative is zero there.
So its strength is counted from the one at which it begins to act.
"""

from __future__ import annotations

__all__ = ["with_onsets"]

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .objective import Objective, Point, Unit

_HALVINGS = 8
_NOTHING = 1e-6  # standard deviations


def with_onsets(objective: Objective, point: Point, units: Sequence[Unit]) -> list[Unit]:
    """Return the units, each limit with the largest strength that has no effect on the segments.

    Args:
        objective: The segments.
        point: Parameters.
        units: The effects; those that are no limits, or never act, are returned as they are.
    """
    limits = [unit for unit in units if unit.effect.limit]
    if not limits:
        return list(units)
    before = objective([point])[0]

    def acts(strengths: Sequence[float]) -> list[bool]:
        points = [Point(point.z, {u: s}) for u, s in zip(limits, strengths, strict=True)]
        return (np.abs(objective(points) - before).max((1, 2)) > _NOTHING).tolist()

    ever = acts([unit.high for unit in limits])
    low, high = [0.0] * len(limits), [unit.high for unit in limits]
    for _ in range(_HALVINGS):
        middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
        for i, act in enumerate(acts(middle)):
            if act:
                high[i] = middle[i]
            else:
                low[i] = middle[i]
    found = {
        unit: replace(unit, onset=onset)
        for unit, onset, some in zip(limits, low, ever, strict=True)
        if some
    }
    return [found.get(unit, unit) for unit in units]
