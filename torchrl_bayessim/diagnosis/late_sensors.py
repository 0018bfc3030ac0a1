"""Whether late sensors explain a gap, or merely show what was measured before a segment began.

What a late sensor shows first is the past, which was measured and not predicted, and its segments
start from true states that were shown later. So a delay of ``n`` steps makes an error that grows
with the horizon as small as it was ``n`` steps earlier, whatever its cause; over segments of few
steps that is all of it. (A delay of all channels alike is taken as one of all commands, see
`with_late_commands`, and does nothing of the kind.)
"""

from __future__ import annotations

__all__ = ["LATE", "free_riders", "without_free_riders"]

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..effects.sensors import SensorDelay, SensorLag
from .model import Model
from .objective import Objective, Point, strengths_of
from .selection import Selection
from .strengths import with_late_commands

Array = NDArray[np.float64]
LATE = SensorDelay.name, SensorLag.name
_PREDICTED = 0.5  # of the rows that are compared: how many at least are predictions
_MORE = 0.5  # of the error that it has for nothing: what it may leave
_FURTHER = 2.0  # times what it explains for nothing, where noise is most of the error


def free_riders(
    objective: Objective, noise: Array, nominal: Model, models: Sequence[Model]
) -> set[Model]:
    """Return those models that have late sensors for nothing.

    Args:
        objective: Of the segments to look at.
        noise: Standard deviation of each channel's noise.
        nominal: Parameters alone.
        models: With effects.
    """
    late = [m for m in models if any(unit.name in LATE for unit in m.units)]
    if not objective.located or not late:
        return set()
    errors = objective.raw([m.fit.point for m in (nominal, *late)])
    errors = errors * objective.whitening.weights[:, None, None]
    before, *left = np.nanmean((errors / noise) ** 2, axis=1)  # (K, C) each
    checked = objective.segments.checked
    return {
        model
        for model, after in zip(late, left, strict=True)
        if _no_more(before, after, _steps(objective, model.fit.point), checked)
    }


def without_free_riders(objective: Objective, noise: Array, selection: Selection) -> Selection:
    """Return what was found, without rivals of late sensors that explain nothing."""
    rivals = [m for models in selection.alternatives.values() for m in models]
    riders = free_riders(objective, noise, selection.nominal, rivals)
    others = {
        name: tuple(m for m in models if m not in riders)
        for name, models in selection.alternatives.items()
    }
    return replace(selection, alternatives=others)


def _steps(objective: Objective, point: Point) -> Array:
    """Return by how many control steps each channel is late."""
    robot = objective.predictor.system.robot
    strengths = with_late_commands(strengths_of([point], robot), robot)
    steps = np.zeros(len(robot.channels))
    for effect, values in strengths.items():
        if isinstance(effect, SensorDelay):
            steps += values[0] / robot.dt
        elif isinstance(effect, SensorLag):
            for share in effect.shares:
                kept = np.exp(-robot.dt / np.maximum(share * values[0], 1e-9))
                steps += kept / (1 - kept)
    return steps


def _no_more(before: Array, after: Array, steps: Array, checked: NDArray[np.int64]) -> bool:
    """Return whether late channels leave as much as the error had that many steps earlier.

    Or show, for the most part, what was measured before the segment, and predict nothing.

    Args:
        before: Squares with fitted parameters, in units of the noise, shape ``(K, C)``.
        after: The same with late sensors.
        steps: By how many steps each channel is late, shape ``(C,)``.
        checked: After which steps the error is seen, shape ``(K,)``.
    """
    rows, least = np.r_[0, checked], np.minimum(1.0, before[0])
    late = np.flatnonzero(steps > 0)
    left = free = predicted = now = 0.0
    for c in late:
        part = np.clip(checked - steps[c], 0.0, 1.0)  # of what is shown, the rest was measured
        earlier = np.interp(checked - steps[c], rows, np.r_[least[c], before[:, c]])
        left += float(part @ after[:, c])
        free += float(part @ earlier)
        now += float(part @ before[:, c])
        predicted += float(part.sum())
    no_better = left >= _MORE * free and now - left < _FURTHER * (now - free)
    return bool(len(late)) and (no_better or predicted < _PREDICTED * len(late) * len(checked))
