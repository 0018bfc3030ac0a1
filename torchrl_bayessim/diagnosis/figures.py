"""The numbers behind the pictures of a report, as plain lists.

Nothing here decides anything: the search is over, and what it left is drawn.
"""

from __future__ import annotations

__all__ = ["figures"]

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..effects.robot import Robot
from .location import excess, signature_curves
from .objective import Objective, Point, Unit, pushes_of, strengths_of
from .prediction import Predictor
from .preparation import Prepared
from .regimes import features
from .screening import Screen
from .segments import Segments
from .selection import Selection
from .shrinkage import Shrinkage
from .whitening import whitening

Array = NDArray[np.float64]
_WORST = 3  # segments
_PANELS = 4  # channels of a segment
_LEADING = 12  # effects of the confusability matrix
_BINS = 12
_SHORT = 10  # control steps over which a force is nearly constant
_QUARTERS = (0.25, 0.5, 0.75)


def figures(prepared: Prepared, selection: Selection, measured: Shrinkage) -> dict[str, Any]:
    """Return what the page draws.

    Args:
        prepared: Split, noise, horizon.
        selection: What the search found.
        measured: Figures on the test runs.

    Returns:
        ``waterfall``: intervals of two of its bars. ``segments``: the worst stretches of test runs.
        ``signature``: the force that is missing. ``confusability``: cosines between signatures.
        ``heat``: excess error by output and regime. ``units``: of strengths, by effect and target.
    """
    seen = selection.screens[0]
    robot = prepared.predictor.system.robot
    return {
        "waterfall": {
            "refit": [1.0 + bound for bound in measured.excess_ci],
            "with_effects": [1.0 + bound for bound in measured.remainder_ci],
        },
        "segments": _segments(prepared, selection),
        "signature": _signature(prepared, selection),
        "confusability": _confusability(seen),
        "heat": _heat(prepared.sets["validation"], selection.nominal.fit.point),
        "units": _units({*seen.units, *selection.best.units}, robot),
    }


def _segments(prepared: Prepared, selection: Selection) -> list[dict[str, Any]]:
    """Return the test segments that the parameters alone predict worst, row by row."""
    test = prepared.sets["test"]
    points = [selection.nominal.fit.point, selection.best.fit.point]
    innovations = test(points[:1])[0] / test.whitening.weights[:, None]
    worst = np.argsort(-(innovations**2).sum(-1))[:_WORST]
    every = np.arange(1, test.segments.horizon + 1, dtype=np.int64)
    some = replace(test.segments.take(worst), checked=every)
    predictor, robot = prepared.predictor, prepared.predictor.system.robot
    theta = test.theta(np.stack([point.z for point in points]))
    residual = predictor.residuals(some, theta, strengths_of(points, robot))
    real = _measured(predictor, some)
    size = np.nan_to_num(np.abs(residual[0]), nan=np.inf).max(1) / prepared.noise
    found = []
    for s in range(len(worst)):
        shown = np.sort(np.argsort(-size[s])[:_PANELS])
        found.append(
            {
                "log": prepared.names["test"][int(some.log[s])],
                "time": some.time[s, some.rows].tolist(),
                "channels": [
                    {
                        "name": robot.channels[c],
                        "noise": float(prepared.noise[c]),
                        "real": real[s, :, c].tolist(),
                        "without": _finite(real[s, :, c] - residual[0, s, :, c]),
                        "with": _finite(real[s, :, c] - residual[1, s, :, c]),
                    }
                    for c in shown.tolist()
                ],
            }
        )
    return found


def _measured(predictor: Predictor, segments: Segments) -> Array:
    """Return measured channels at the compared rows, ``(S, K, C)``.

    Positions of free joints and balls are counted from the segment's start.
    """
    at, rows = segments.history, segments.rows
    moved = predictor.tangent.difference(segments.qpos[:, at : at + 1], segments.qpos[:, rows])
    tangent = np.concatenate([moved, segments.qvel[:, rows]], -1)
    tangent = tangent[..., list(predictor.system.channel_index)]
    scalar = np.array(predictor.system.robot.channel_joint) >= 0
    values = predictor.sensing.values(segments.qpos[:, rows], segments.qvel[:, rows])
    return np.where(scalar, values, tangent)


def _finite(values: Array) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]


def _signature(prepared: Prepared, selection: Selection) -> dict[str, Any]:
    """Return the missing generalised force at the joint that matters most, before and after.

    A force is nearly constant over a few steps only, so training segments are cut into short ones.
    """
    train, robot = prepared.sets["train"], prepared.predictor.system.robot
    pushes = pushes_of(robot)
    if not pushes or not prepared.mode.synchronised:
        return {}
    before_fit, after_fit = selection.nominal.fit, selection.best.fit
    short = _shortened(train.segments)
    white = whitening(prepared.predictor, short, train.theta(before_fit.point.z), prepared.noise)
    train = Objective(prepared.predictor, train.prior, short, white)
    one, two = train([before_fit.point, after_fit.point])
    before = signature_curves(train, replace(before_fit, innovations=one), pushes)
    joint = _joint(selection.best.units, robot) or max(before, key=lambda j: _variance(before[j]))
    curves = {"before": before[joint]}
    if selection.best.units:
        fit = replace(after_fit, innovations=two)
        curves["after"] = signature_curves(train, fit, pushes)[joint]
    push = next(unit for unit in pushes if unit.where == joint)
    return {
        "joint": joint,
        "unit": push.measured_in(robot),
        "curves": {
            name: {
                when: _binned(np.array(c[name]["x"]), np.array(c[name]["force"]))
                for when, c in curves.items()
            }
            for name in before[joint]
        },
    }


def _shortened(segments: Segments) -> Segments:
    """Return the same stretches in shorter segments."""
    horizon = min(_SHORT, segments.horizon)
    offsets = range(0, segments.horizon - horizon + 1, horizon)
    width, known = 2 * segments.history + horizon + 1, segments.uncertainty
    windows = {
        name: np.concatenate([getattr(segments, name)[:, o : o + width] for o in offsets])
        for name in ("time", "qpos", "qvel", "ctrl")
    }
    return replace(
        segments,
        horizon=horizon,
        checked=np.arange(1, horizon + 1, dtype=np.int64),
        log=np.tile(segments.log, len(offsets)),
        start=np.concatenate([segments.start + o for o in offsets]),
        uncertainty=None if known is None else np.tile(known, (len(offsets), 1, 1)),
        touching=None,  # of the first starts only
        **windows,
    )


def _joint(units: Sequence[Unit], robot: Robot) -> str:
    """Return the joint of the first effect that has one, else nothing."""
    joints = [unit.joint(robot) for unit in units]
    return next((robot.joints[j] for j in joints if j >= 0), "")


def _variance(curves: dict[str, Any]) -> float:
    return float(np.var(curves["velocity"]["force"]))


def _binned(x: Array, force: Array) -> dict[str, list[float]]:
    """Return means and their standard errors in bins of equally many segments."""
    parts = np.array_split(np.argsort(x), min(_BINS, max(1, len(x) // 3)))
    means = [float(force[part].mean()) for part in parts]
    errors = [float(force[part].std() / np.sqrt(len(part))) for part in parts]
    return {"x": [float(x[part].mean()) for part in parts], "force": means, "error": errors}


def _confusability(seen: Screen) -> dict[str, Any]:
    """Return absolute cosines between signatures of the leading effects, each at its best."""
    best: dict[str, int] = {}
    ratios = seen.ratios(1.0)
    for i in np.argsort(-ratios).tolist():
        if seen.norms[i] > 0:
            best.setdefault(seen.units[i].name, i)
    rows = list(best.values())[:_LEADING]
    return {
        "effects": [[seen.units[i].name, seen.units[i].where] for i in rows],
        "matrix": np.abs(seen.correlation[np.ix_(rows, rows)]).clip(0, 1).tolist(),
    }


def _heat(judged: Objective, point: Point) -> dict[str, Any]:
    """Return the excess of each output in quarters of what it depends on most.

    The excess is the mean square of residuals over what noise would leave, minus one; quarters hold
    equally many rows, and the feature is the one between whose quarters it varies most.
    """
    robot = judged.predictor.system.robot
    beyond = excess(judged, judged.raw([point])[0])
    best: tuple[float, str, list[float], Array] | None = None
    for name, values in features(judged.segments, robot).items():
        cuts = np.unique(np.quantile(values, _QUARTERS))
        quarter = np.searchsorted(cuts, values, side="right")
        if len(np.unique(quarter)) <= len(cuts):
            continue
        means = np.stack([beyond[quarter == i].mean(0) for i in range(len(cuts) + 1)], 1)
        spread = float(means.mean(0).var())
        if best is None or spread > best[0]:
            best = spread, name, cuts.tolist(), means
    if best is None:
        return {}
    _, name, cuts, means = best
    return {
        "outputs": list(robot.channels),
        "feature": name,
        "cuts": cuts,
        "excess": np.maximum(means, 0.0).tolist(),
    }


def _units(units: set[Unit], robot: Robot) -> dict[str, str]:
    """Return the unit of each effect's strength, by ``effect[target]``."""
    return {str(unit): unit.measured_in(robot) for unit in units}
