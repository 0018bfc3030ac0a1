"""Open-loop error over whole test runs, in the units of the measurements."""

from __future__ import annotations

__all__ = ["rollout_errors", "worse_rollouts"]

from collections.abc import Mapping

import numpy as np

from .objective import Point, strengths_of
from .preparation import Prepared
from .segments import cut

_WORSE = 1.5


def rollout_errors(prepared: Prepared, points: Mapping[str, Point]) -> dict[str, dict[str, float]]:
    """Return root mean square errors of each channel, by name of the point.

    Every test run is simulated from its first measured state to its end. Where a simulation
    diverges the error is infinite.
    """
    predictor, objective = prepared.predictor, prepared.sets["test"]
    squares: dict[str, list[np.ndarray]] = {name: [] for name in points}
    every = list(points.values())
    theta = objective.theta(np.stack([point.z for point in every]))
    strengths = strengths_of(every, predictor.system.robot)
    history = objective.segments.history
    for log in prepared.logs["test"]:
        if len(log) < 3:
            continue
        whole = cut([log], len(log) - 1, history=history)
        residual = predictor.residuals(whole, theta, strengths)
        for name, one in zip(points, residual, strict=True):
            squares[name].append(one[0] ** 2)
    result: dict[str, dict[str, float]] = {}
    for name, parts in squares.items():
        error = np.sqrt(np.concatenate(parts).mean(0)) if parts else np.full(1, np.nan)
        error = np.nan_to_num(error, nan=np.inf)
        result[name] = dict(zip(predictor.system.robot.channels, error.tolist(), strict=False))
    return result


def worse_rollouts(errors: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return an alarm for channels that whole runs with the effects predict worse than without.

    What explains short segments and not the runs is not all of the cause, or not the cause.

    Example:
        >>> worse_rollouts({"refit": {"hinge": 0.8}, "with_effects": {"hinge": 3.8}})
        ['whole runs are predicted worse with the effects than without: hinge 3.8 against 0.8']
        >>> worse_rollouts({"refit": {"hinge": 0.8}})  # nothing was found
        []
    """
    before, after = errors["refit"], errors.get("with_effects", errors["refit"])
    found = [
        f"{name} {after[name]:.3g} against {before[name]:.3g}"
        for name in before
        if np.isfinite(before[name]) and after[name] > _WORSE * before[name]
    ]
    text = "whole runs are predicted worse with the effects than without: "
    return [text + ", ".join(found)] if found else []
