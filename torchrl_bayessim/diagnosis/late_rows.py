"""Commands that stand a row too late in the logs: a fault of the record, not of the robot."""

from __future__ import annotations

__all__ = ["late_row_alarms"]

from dataclasses import replace

import numpy as np

from .objective import Objective
from .refit import Fit, refit

_SHARE = 0.8  # of the gap that must go


def late_row_alarms(objective: Objective, nominal: Fit) -> list[str]:
    """Return an alarm if the commands of the row after explain most of what is missing.

    Rows hold a state and the command that acts from there on. Where it is the one that led there
    the robot seems to answer before it is asked, which no effect of the catalogue does.

    Args:
        objective: Of the training segments.
        nominal: The parameters alone.
    """
    before = nominal.mean_square - 1.0
    if not objective.located or not objective.segments.ctrl.shape[-1] or before <= 0:
        return []
    segments = objective.segments
    earlier = replace(segments, ctrl=np.roll(segments.ctrl, -1, axis=1))
    after = refit(objective.along(earlier), [nominal.point])[0].mean_square - 1.0
    share = 1.0 - after / before
    if share < _SHARE:
        return []
    return [
        f"with the commands of the row after, {100 * share:.0f} % of the gap is gone: do rows hold "
        "the command that led to their state, and not the one that acts from there on?"
    ]
