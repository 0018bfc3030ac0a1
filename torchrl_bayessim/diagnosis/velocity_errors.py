"""How wrong velocities are that were estimated from positions, where the motion is fast.

Noise is one part of their error, and known by its gain. The other is motion between the rows: a leg
that swings forth and back from one row to the next looks as if it stood. How much of it there is
the simulator says: its own motion under the recorded commands, read at the rows, is put through
the same estimate and compared with its own velocities.
"""

from __future__ import annotations

__all__ = ["with_velocity_errors"]

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..logs.log import Log
from ..logs.velocity import Windows, velocity
from .prediction import Predictor
from .segments import cut

Array = NDArray[np.float64]
_ROWS = 12  # of a simulated motion that lasted


def with_velocity_errors(predictor: Predictor, logs: Sequence[Log], theta: Array) -> list[Log]:
    """Return the logs with the errors that the estimates of their velocities have in simulation.

    Of hinges and slides; the median over rows, as a standard deviation, and the largest of all
    logs, since what one joint does is what the others may do.

    Args:
        predictor: Simulates.
        logs: Those with measured velocities are returned as they are.
        theta: Parameters, shape ``(D,)``.
    """
    robot = predictor.system.robot
    guessed = [log for log in logs if log.velocity_gain.any()]
    error = np.zeros(predictor.tangent.size)
    for log in guessed:
        positions, velocities = _motion(predictor, log, theta)
        if len(positions) < _ROWS:
            continue
        rows = np.arange(len(positions), dtype=np.float64)
        windows = Windows(predictor.system.control_dt * rows)
        for q, v in zip(robot.qpos_index, robot.dof_index, strict=True):
            if log.velocity_gain[v] > 0:
                slope, _, half = velocity(windows, positions[:, q])
                wrong = np.abs(slope - velocities[:, v])[half:-half]
                error[v] = max(error[v], 1.4826 * float(np.median(wrong)))
    found = torch.from_numpy(error)
    return [replace(log, velocity_error=found) if log.velocity_gain.any() else log for log in logs]


def _motion(predictor: Predictor, log: Log, theta: Array) -> tuple[Array, Array]:
    """Return what the simulator does under a log's commands, until it diverges."""
    whole = cut([log], len(log) - 1)
    positions, velocities = (one[0, 0] for one in predictor.states(whole, theta[None]))
    lasting = np.isfinite(positions).all(1) & np.isfinite(velocities).all(1)
    count = len(lasting) if lasting.all() else int(np.argmin(lasting))
    return positions[:count], velocities[:count]
