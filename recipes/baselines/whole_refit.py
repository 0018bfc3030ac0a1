"""Baseline: every effect refitted together with the parameters on whole runs, the best chosen.

The recipe of published actuator models: fit each candidate to whole trajectories, keep the one with
the least error on trajectories that were held out (Duclusaud, Passault & Ly 2024, "Extended
friction models for the physics simulation of servo actuators").
"""

from __future__ import annotations

__all__ = ["whole_refit"]

from typing import Any

import numpy as np

from torchrl_bayessim.diagnosis.objective import Point
from torchrl_bayessim.diagnosis.refit import refit

from .strength_grid import best_of_grid, scan
from .whole_runs import Runs

_ITERATIONS = 6


def whole_refit(runs: Runs) -> dict[str, Any]:
    """Return what explains the validation runs best, when all is fitted to the training runs."""
    train = runs.sets["train"]
    nominal = refit(train, [Point(np.zeros(train.size))])[0]
    strengths = scan(train, nominal.point.z, runs.units)
    starts = [Point(nominal.point.z, {unit: s}) for unit, s in strengths.items()]
    fits = refit(train, starts, iterations=_ITERATIONS, race=nominal.cost)
    points = {fit.units[0]: fit.point for fit in fits}
    return best_of_grid(runs, nominal.point, points)
