"""Whether the simulator holds together at all on these data."""

from __future__ import annotations

__all__ = ["divergence_alarms"]

from collections.abc import Mapping

import numpy as np

from .objective import Objective, Point


def divergence_alarms(objective: Objective, points: Mapping[str, Point]) -> list[str]:
    """Return an alarm for each point at which simulations of measured stretches diverge.

    Args:
        objective: Segments of logs.
        points: What to simulate, by what it is called in the alarm.
    """
    residuals = objective.raw(list(points.values()))
    alarms = []
    for name, residual in zip(points, residuals, strict=True):
        diverged = float((~np.isfinite(residual)).any((1, 2)).mean())
        if diverged:
            alarms.append(
                f"the simulator {name} diverges on {diverged:.0%} of the stretches that the robot "
                "lived through: check masses, stiffnesses and the time step"
            )
    return alarms
