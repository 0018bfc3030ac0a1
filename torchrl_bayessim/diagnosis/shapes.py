"""Frequency and phase of periodic forces, read off the force that is missing.

A periodic disturbance ``s sin(2πft + φ)`` and cogging ``s sin(kq + φ)`` each have two numbers
beside their strength, which no screen at fixed values can find. Over a few steps a missing force is
nearly constant, so its course is estimated first, one value per short segment and joint, and the
best sine over time and over position is fitted to it.
"""

from __future__ import annotations

__all__ = ["shaped"]

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..effects.disturbance import Cogging, PeriodicDisturbance
from ..effects.effect import Effect
from ..logs.log import Log
from .location import missing_force
from .objective import Objective, Point, Unit, parameters_at, units_of
from .prediction import Predictor
from .segments import cut
from .whitening import whitening

Array = NDArray[np.float64]
_STEPS = 6  # control steps over which a force is taken to be constant
_MOST = 400  # segments
_SLOWEST = 0.5  # cycles per log: slower ones are trends
_NUMBERS = np.arange(2, 25)  # cogs per turn; one is gravity's
_CLEAR = 0.1  # share of the force's variance that a sine must explain


def shaped(
    predictor: Predictor, logs: Sequence[Log], *, z: Array, noise: Array, pushes: Sequence[Unit]
) -> list[Unit]:
    """Return a periodic disturbance and cogging at each joint where a sine stands out.

    Args:
        predictor: Simulates.
        logs: The training logs.
        z: Where the parameters were fitted.
        noise: Standard deviation of each channel's noise.
        pushes: A constant force at each joint.
    """
    shortest = min(len(log) for log in logs)
    if not pushes or shortest <= 2 * _STEPS:
        return []
    system = predictor.system
    pieces = cut(logs, _STEPS, history=1, most=_MOST)
    white = whitening(predictor, pieces, parameters_at(system.prior, z), noise)
    objective = Objective(predictor, system.prior, pieces, white)
    force = missing_force(objective, Point(z), pushes)
    middle = pieces.history + _STEPS // 2
    time, spacing = pieces.time[:, middle], _STEPS * system.control_dt
    span = float(np.mean([len(log) for log in logs])) * system.control_dt
    frequencies = np.arange(_SLOWEST / span, 0.5 / spacing, 0.125 / span)
    units: list[Unit] = []
    for i, push in enumerate(pushes):
        position = pieces.qpos[:, middle, system.robot.qpos_index[push.joint(system.robot)]]
        found: list[Effect] = []
        best = _sine(force[:, i], 2 * np.pi * time, frequencies)
        if best is not None:
            found.append(PeriodicDisturbance(frequency=best[0], phase=best[1]))
        best = _sine(force[:, i], position, _NUMBERS.astype(np.float64))
        if best is not None:
            found.append(Cogging(number=round(best[0]), phase=best[1]))
        units += [u for u in units_of(found, system.robot) if u.where == push.where]
    return units


def _sine(force: Array, angle: Array, rates: Array) -> tuple[float, float] | None:
    """Return rate and phase of the sine of the angle that explains most, if it stands out."""
    # large forces are outliers of short segments: a median's distance bounds what they weigh
    bound = 4.0 * np.median(np.abs(force - np.median(force))) + 1e-12
    target = np.clip(force - np.median(force), -bound, bound)
    total = float(((target - target.mean()) ** 2).sum())
    best, choice = _CLEAR * total, None
    for rate in rates:
        columns = np.stack([np.sin(rate * angle), np.cos(rate * angle), np.ones_like(angle)], 1)
        solution, *_ = np.linalg.lstsq(columns, target, rcond=None)
        explained = total - float(((target - columns @ solution) ** 2).sum())
        if explained > best:
            best = explained
            choice = float(rate), math.atan2(solution[1], solution[0])
    return choice
