"""Whether late sensors explain a gap, or merely show what was measured before a segment began.

What a late sensor shows first is the past, which was measured and not predicted, and its segments
start from true states that were shown later. So a delay of ``n`` steps makes an error that grows
with the horizon as small as it was ``n`` steps earlier, whatever its cause; over segments of few
steps that is all of it. (A delay of all channels alike is taken as one of all commands, see
`with_late_commands`, and does nothing of the kind.)
"""

from __future__ import annotations

__all__ = ["LATE", "rides_free"]

import numpy as np
from numpy.typing import NDArray

from ..effects.sensors import SensorDelay, SensorLag
from .model import Model, as_good
from .objective import Objective, Point, strengths_of
from .selection import Selection
from .strengths import with_late_commands

Array = NDArray[np.float64]
LATE = SensorDelay.name, SensorLag.name
_PREDICTED = 0.5  # of the rows that are compared: how many at least are predictions
_MORE = 0.5  # of the error that it has for nothing: what it may leave


def rides_free(objective: Objective, noise: Array, selection: Selection) -> bool:
    """Return whether the best model, or one that is as good, is one of late sensors for nothing.

    Args:
        objective: Of the segments to look at.
        noise: Standard deviation of each channel's noise.
        selection: What a search found.
    """
    rivals = [m for models in selection.alternatives.values() for m in models]
    models = [selection.best, *(m for m in rivals if as_good(selection.best, m))]
    late = [m for m in models if any(unit.name in LATE for unit in m.units)]
    if not late or not objective.located:
        return False
    points = [selection.nominal.fit.point, *(m.fit.point for m in late)]
    errors = objective.raw(points) * objective.whitening.weights[:, None, None]
    squares = np.nanmean((errors / noise) ** 2, axis=1)  # (P, K, C)
    return any(
        _no_more(squares[0], left, steps, objective.segments.checked)
        for left, steps in zip(squares[1:], _steps(objective, late), strict=True)
    )


def _steps(objective: Objective, models: list[Model]) -> list[Array]:
    """Return by how many control steps each channel is late in each model."""
    robot = objective.predictor.system.robot
    result = []
    for model in models:
        point = Point(model.fit.point.z, model.fit.point.strengths)
        strengths = with_late_commands(strengths_of([point], robot), len(robot.actuators))
        steps = np.zeros(len(robot.channels))
        for effect, values in strengths.items():
            if isinstance(effect, SensorDelay):
                steps += values[0] / robot.dt
            elif isinstance(effect, SensorLag):
                kept = np.exp(-robot.dt / np.maximum(values[0], 1e-9))
                steps += kept / (1 - kept)
        result.append(steps)
    return result


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
    left = free = predicted = 0.0
    for c in late:
        part = np.clip(checked - steps[c], 0.0, 1.0)  # of what is shown, the rest was measured
        earlier = np.interp(checked - steps[c], rows, np.r_[least[c], before[:, c]])
        left += float(part @ after[:, c])
        free += float(part @ earlier)
        predicted += float(part.sum())
    return bool(len(late)) and (
        left >= _MORE * free or predicted < _PREDICTED * len(late) * len(checked)
    )
