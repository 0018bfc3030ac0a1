r"""The step to which commands are rounded, looked for by simulation.

What rounding a command u to multiples of s takes from it, :math:`s \cdot \operatorname{round}(u /
s) - u`, at a step :math:`s (1 + \delta)` has nothing in common with that at s once :math:`\delta
|u| / s` is half: signatures at a few strengths miss all steps between them. The course of the
missing force shows some (:mod:`.shapes`), but not where contacts or noise hide a single row's
command. So where nothing explains half of what is missing, steps are simulated as far apart as the
largest command allows, from the finest that so many can tell apart.
"""

from __future__ import annotations

__all__ = ["rounded", "steps_between"]

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..effects.action import ActionQuantization
from .objective import Objective, Unit, units_of
from .refit import Fit
from .screening import screen
from .shapes import at_step

Array = NDArray[np.float64]
_FINEST = 0.1  # of the largest step that is plausible
_MOST = 600  # steps that are tried
_APART = 0.25  # of a step, by which the multiple nearest to the largest command moves at most
_FARTHEST = 0.05  # of a step, at most
_REFINED = 2  # times, each four times as close


def rounded(train: Objective, fit: Fit, units: Sequence[Unit]) -> list[Unit]:
    """Return rounded commands at the step of each actuator that fits the data best, if any does.

    Args:
        train: What to explain.
        fit: What is in the model already.
        units: The effects that are considered: one is returned where it is among them.
    """
    robot = train.predictor.system.robot
    asked = {unit.where for unit in units if unit.name == ActionQuantization.name}
    found: list[Unit] = []
    for unit in units_of([ActionQuantization()], robot):
        if unit.where not in asked or unit.where == "all":
            continue
        column = unit.direction.index(1.0)
        largest = float(np.abs(train.segments.ctrl[..., column]).max())
        least = max(_FINEST * unit.high, _told_apart(unit.high, largest))
        step = _best(train, fit, unit, steps_between(least, unit.high, largest))
        if step is not None:
            found.append(at_step(unit, step))
    return found


def _told_apart(most: float, largest: float) -> float:
    """Return from which step on so many tell all steps apart, ``n = (1/s - 1/most) largest/a``."""
    return 1 / (1 / most + _MOST * _APART / max(largest, most))


def steps_between(least: float, most: float, largest: float) -> Array:
    """Return steps from the least to the most, as close as the largest command tells them apart.

    Example:
        >>> steps_between(0.1, 0.2, 1.0).round(4)[:4]
        array([0.1   , 0.1025, 0.1051, 0.1079])
    """
    steps = [least]
    while steps[-1] < most:
        apart = _APART * steps[-1] / max(largest, steps[-1])
        steps.append(steps[-1] * (1 + min(apart, _FARTHEST)))
    return np.array(steps)


def _best(train: Objective, fit: Fit, unit: Unit, steps: Array) -> float | None:
    """Return the step whose signature matches best, found on ever finer grids."""
    best = None
    for _ in range(1 + _REFINED):
        seen = screen(train, fit, [unit], levels=tuple(steps / unit.high))
        ratios = seen.ratios(1.0)
        if not ratios.any():
            break
        row = int(ratios.argmax())
        best, width = float(seen.strengths[row]), float(np.gradient(steps)[row])
        steps = best + width * np.linspace(-1.0, 1.0, 9)
    return best
