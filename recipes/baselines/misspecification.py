"""Baseline: does the real summary lie among those that the simulator can make?

The conformal test of `torchrl_bayessim.inference.misspecification`, on draws of the parameters
alone, as many as the diagnosis' time steps make. It says that something is missing, never what.
"""

from __future__ import annotations

__all__ = ["misspecification"]

from typing import Any

import numpy as np

from torchrl_bayessim.inference.misspecification import strangeness

from .answers import answer
from .simulations import simulations
from .whole_runs import Runs

_ALPHA = 0.01
_LEAST = 200  # draws, of which the strangest two are beyond the level


def misspecification(runs: Runs, *, budget: int, seed: int) -> dict[str, Any]:
    """Return ``unknown`` where the robot is unlike every simulation, else ``none``."""
    rng = np.random.default_rng([seed, 5])
    draws = simulations(runs, ["none"], budget=budget, least=_LEAST, rng=rng)
    varies = draws.summaries.std(0) > 1e-9
    share, _ = strangeness(draws.summaries[:, varies], draws.observed[varies])
    theta = runs.sets["train"].theta(np.zeros(runs.sets["train"].size))
    verdict = "unknown" if share <= _ALPHA else "none"
    return answer(runs, verdict, found={}, theta=(theta, theta)) | {"p_value": share}
