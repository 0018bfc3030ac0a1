"""Whether the simulator holds together at all on these data."""

from __future__ import annotations

__all__ = ["HINT", "divergence_alarms", "diverges_throughout"]

from collections.abc import Mapping

import numpy as np

from .objective import Objective, Point

HINT = "check masses, stiffnesses, the time step, and that angles are in radians"


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
                f"lived through: {HINT}"
            )
    return alarms


def diverges_throughout(rollouts: Mapping[str, Mapping[str, float]]) -> bool:
    """Return whether the simulator without effects lives through no whole run.

    Over a few steps even that is finite, and what then explains it is anything that holds it back.

    Args:
        rollouts: Open-loop error of each channel, infinite after a divergence, by name of the
            point: ``raw`` and ``refit``.
    """
    alone = rollouts["raw"], rollouts["refit"]
    return all(not np.isfinite(list(errors.values())).any() for errors in alone)
