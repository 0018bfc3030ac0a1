"""Baseline: system identification of the parameters alone, by MuJoCo's own least squares.

``mujoco.minimize.least_squares`` is the optimiser of MuJoCo's toolbox ``mujoco.sysid``, which
itself needs packages that MuJoCo does not install. It is given residuals of whole runs, all points
of an iteration in one batch. It names nothing: what it can say is that a simulator with the best
parameters fits or does not.
"""

from __future__ import annotations

__all__ = ["fitted_parameters", "parameters_only"]

from typing import Any

import mujoco.minimize
import numpy as np

from torchrl_bayessim.diagnosis.objective import Point

from .answers import FITS, answer
from .whole_runs import Array, Runs, mean_square

_EDGE = np.sqrt(3.0)  # of a uniform prior, in its standard deviations


def fitted_parameters(runs: Runs) -> Array:
    """Return the parameters that explain the training runs best, standardised, ``(D + 1,)``."""
    train = runs.sets["train"]
    count = train.size - 1
    z = np.zeros(train.size)
    if not count:
        return z

    def residual(x: Array) -> Array:
        """Return residuals, ``(m, P)``, of points ``(D, P)``."""
        rows = np.concatenate([x.reshape(count, -1).T, np.zeros((x.size // count, 1))], 1)
        return train([Point(row) for row in rows]).reshape(len(rows), -1).T

    edge = np.full(count, _EDGE)
    z[:-1], _ = mujoco.minimize.least_squares(
        z[:-1], residual, [-edge, edge], eps=1e-3, max_iter=30, verbose=0
    )
    return z


def parameters_only(runs: Runs) -> dict[str, Any]:
    """Return whether a simulator with fitted parameters fits the validation runs."""
    z = fitted_parameters(runs)
    train, validation = runs.sets["train"], runs.sets["validation"]
    left = mean_square(validation([Point(z)]))
    theta = train.theta(np.zeros(train.size)), train.theta(z)
    return answer(runs, "none" if left < FITS else "unknown", found={}, theta=theta)
