"""Where the error sits: which channel of the robot, which outputs, joints and regime, when."""

from __future__ import annotations

__all__ = ["excess", "location", "signature_curves"]

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .missing_force import missing_forces
from .objective import Objective, Unit
from .refit import Fit
from .regimes import features, regimes
from .screening import Screen

Array = NDArray[np.float64]
_CHANNELS: tuple[str, ...] = ("sensing", "actuation", "body", "contact")


def location(
    train: tuple[Objective, Array],
    judged: tuple[Objective, Array],
    seen: Screen,
    found: Mapping[Unit, float],
    *,
    confused: Sequence[str] = (),
) -> dict[str, Any]:
    """Return shares of the excess error, by channel, output, joint, regime and time.

    Args:
        train: Objective and residuals ``(S, K, C)`` of the training segments.
        judged: The same of the validation segments.
        seen: The signatures that the residuals are compared with.
        found: The effects that were named, with the error that each removes: they say more about
            channels and joints than any projection can.
        confused: Names that cannot be told from the first of them, itself first. The error may
            sit with any of these: they share its channel, which counts the first one twice.
    """
    robot = judged[0].predictor.system.robot
    beyond = excess(*judged)
    by_output = np.maximum(beyond.mean((0, 1)), 0.0)
    rules, over_time = [], []
    if judged[0].located:
        rules = regimes(
            (features(train[0].segments, robot), excess(*train).mean(-1)),
            (features(judged[0].segments, robot), beyond.mean(-1)),
        )
        times = judged[0].segments.time[:, judged[0].segments.rows]
        over_time = _over_time(times, beyond.mean(-1))
    gains = dict(found) or _gains(seen)
    channels: dict[str, float] = dict.fromkeys(_CHANNELS, 0.0)
    joints = dict.fromkeys(robot.joints, 0.0)
    rivals = {u.name: u.effect.channel for u in seen.units if u.name in confused}
    for unit, gain in gains.items():
        perhaps = [unit.effect.channel]
        if unit.name in confused[:1]:
            perhaps += [rivals.get(name, unit.effect.channel) for name in confused]
        for channel in perhaps:
            channels[channel] += gain / len(perhaps)
        moved = [j for i in unit.targets if (j := unit.effect.joint(robot, i)) >= 0]
        for joint in moved:
            joints[robot.joints[joint]] += gain / len(moved)
    if not any(joints.values()):  # of what acts at no joint, where it shows
        for joint, share in zip(robot.channel_joint, by_output, strict=True):
            if joint >= 0:
                joints[robot.joints[joint]] += float(share)
    return {
        "channel": _shares(channels),
        "outputs": _named(dict(zip(robot.channels, by_output.tolist(), strict=True))),
        "joints": _named(joints),
        "regimes": [{"rule": r.rule, "support": r.support, "share": r.share} for r in rules[:4]],
        "time": over_time,
    }


def excess(objective: Objective, residual: Array) -> Array:
    """Return squared residuals over what noise would leave, minus one, ``(S, K, C)``."""
    scaled = np.clip(np.nan_to_num(residual, nan=np.inf) / objective.whitening.spread, -1e3, 1e3)
    return scaled**2 - 1.0


def _gains(seen: Screen) -> dict[Unit, float]:
    """Return likelihood ratios of the units that matter, where none has been named.

    Signatures overlap: each takes what those before it left.
    """
    scores = seen.scores.copy()
    gains: dict[Unit, float] = {}
    for _ in range(5):
        if not len(scores):
            break
        best = int(np.argmax(scores))
        if scores[best] < 3.0:
            break
        unit = seen.units[best]
        gains[unit] = gains.get(unit, 0.0) + float(scores[best] ** 2)
        scores = scores - scores[best] * seen.correlation[best]
    return gains


def _shares(amounts: Mapping[str, float]) -> dict[str, float]:
    total = sum(amounts.values())
    return {name: (amount / total if total > 0 else 0.0) for name, amount in amounts.items()}


def _named(amounts: Mapping[str, float]) -> list[dict[str, Any]]:
    shares = _shares(amounts)
    ordered = sorted(shares.items(), key=lambda pair: -pair[1])
    return [{"name": name, "share": share} for name, share in ordered]


def _over_time(time: Array, excess: Array) -> list[dict[str, float]]:
    """Return shares of the error in quarters of the trajectories."""
    edges = np.linspace(time.min(), time.max() + 1e-9, 5)
    amounts = [
        float(np.maximum(excess[(time >= a) & (time < b)], 0.0).sum()) for a, b in pairwise(edges)
    ]
    total = max(sum(amounts), 1e-12)
    return [
        {"t0": float(a), "t1": float(b), "share": amount / total}
        for (a, b), amount in zip(pairwise(edges), amounts, strict=True)
    ]


def signature_curves(objective: Objective, fit: Fit, pushes: list[Unit]) -> dict[str, Any]:
    """Return the generalised force that would remove the error, against what may cause it.

    In each segment the constant force at each joint that explains most of the residual is found by
    least squares; its bin means over velocity, position, command and time show the law: a step at
    zero velocity is dry friction, a line viscous friction, a sine of the position gravity.

    Args:
        objective: Segments and whitening.
        fit: The fit that leaves the error.
        pushes: A constant force at each joint.
    """
    if not pushes:
        return {}
    (force, _), _ = missing_forces(objective, fit.point, pushes)
    segments, robot = objective.segments, objective.predictor.system.robot
    middle = segments.history + segments.horizon // 2
    curves: dict[str, Any] = {}
    for i, unit in enumerate(pushes):
        joint = unit.joint(robot)
        against = {
            "velocity": segments.qvel[:, middle, robot.dof_index[joint]],
            "position": segments.qpos[:, middle, robot.qpos_index[joint]],
            "time": segments.time[:, middle],
        }
        for a, moved in enumerate(robot.joint_of_actuator):
            if moved == joint:
                against["command"] = segments.ctrl[:, middle, a]
        curves[unit.where] = {
            name: {"x": x.tolist(), "force": force[:, i].tolist()} for name, x in against.items()
        }
    return curves
