"""How noisy each channel is: from what no model can explain, the differences of innovations."""

from __future__ import annotations

__all__ = ["assumed_noise", "measured_noise"]

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..logs.log import Log
from .objective import Objective, Point, origin, parameters_at, pushes_of
from .prediction import Predictor
from .refit import refit
from .segments import cut
from .whitening import innovation_noise, noise_from_differences, whitening

Array = NDArray[np.float64]


def assumed_noise(predictor: Predictor, logs: Sequence[Log]) -> Array:
    """Return what the sensor's spec says, or else third differences, shape ``(C,)``."""
    system = predictor.system
    smooth = noise_from_differences(logs, [_coordinates(predictor, log) for log in logs])
    given = np.array([system.noise.get(name, np.nan) for name in system.robot.channels])
    tiny = 1e-6 * system.robot.channel_scale.numpy()
    return np.maximum(np.where(np.isnan(given), smooth, given), tiny)


def measured_noise(
    predictor: Predictor, logs: Sequence[Log], *, history: int, alarms: list[str]
) -> tuple[Array, str]:
    """Return each channel's noise: the differences of innovations, checked by the sensor's spec."""
    system, noise = predictor.system, assumed_noise(predictor, logs)
    channels, tiny = system.robot.channels, 1e-6 * system.robot.channel_scale.numpy()
    given = np.array([system.noise.get(name, np.nan) for name in channels])
    steps = min(8, min(len(log) for log in logs) // 2)
    pieces = cut(logs, steps, history=history, most=60, burn_in=history)
    pushes = pushes_of(system.robot)
    z = origin(system.prior)
    for _ in range(2):
        white = whitening(predictor, pieces, parameters_at(system.prior, z), noise)
        objective = Objective(predictor, system.prior, pieces, white)
        fit = refit(objective, [Point(z)], iterations=4)[0]
        z = fit.point.z
        points = [Point(z, {unit: 0.1 * unit.high}) for unit in pushes]
        pushed = objective(points) if points else np.zeros((0, *fit.innovations.shape))
        factor = innovation_noise(fit.innovations, pushed - fit.innovations, len(pieces.checked))
        factor = np.clip(factor, 0.2, 5.0)
        noise = np.maximum(noise * factor, tiny)
    apart = [
        f"{name}: {estimate:.3g} against {spec:.3g}"
        for name, estimate, spec in zip(channels, noise, given, strict=True)
        if spec > 0 and not 0.7 < estimate / spec < 1.4
    ]
    if apart:
        alarms.append("noise floor uncertain, estimated against specified: " + ", ".join(apart))
    return noise, "differences of innovations"


def _coordinates(predictor: Predictor, log: Log) -> Array:
    """Return the measured channels as tangent coordinates seen from the first row, ``(T, C)``."""
    qpos = log.qpos.numpy()
    both = [predictor.tangent.difference(qpos[:1], qpos), log.qvel.numpy()]
    return np.concatenate(both, -1)[:, list(predictor.system.channel_index)]
