"""In which regime of motion the error sits, as rules in words: a small honest regression tree.

The target is the excess squared innovation of each compared row, the features are what a roboticist
would plot it against: speed, direction, position and command of each joint, time. The tree is grown
on the training segments; support and share of a rule come from the validation segments (Athey &
Imbens 2016 call this honest).
"""

from __future__ import annotations

__all__ = ["Regime", "features", "regimes", "worded"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..effects.robot import Robot
from .segments import Segments

Array = NDArray[np.float64]
_Cut = tuple[str, str, float]  # feature, side and threshold
_CUTS = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95)
_DEPTH = 2
_LEAST = 12  # rows in a leaf


@dataclass(frozen=True)
class Regime:
    """A rule, how many rows it covers, and how much of the excess error they hold.

    Attributes:
        rule: In words.
        support: Share of rows.
        share: Share of the excess squared error.
    """

    rule: str
    support: float
    share: float


def features(segments: Segments, robot: Robot) -> dict[str, Array]:
    """Return what rules may speak of, each at every compared row, shape ``(S, K)``."""
    rows = segments.rows
    before = rows - 1  # the action and the motion that led to the row
    result: dict[str, Array] = {}
    for j, name in enumerate(robot.joints):
        velocity = segments.qvel[:, before, robot.dof_index[j]]
        result[f"|{name} velocity|"] = np.abs(velocity)
        result[f"{name} velocity"] = velocity
        result[f"{name} position"] = segments.qpos[:, before, robot.qpos_index[j]]
    for a, name in enumerate(robot.actuators):
        command = segments.ctrl[:, before, a]
        result[f"|{name} command|"] = np.abs(command)
        result[f"change of {name} command"] = np.abs(command - segments.ctrl[:, before - 1, a])
    result["time"] = segments.time[:, rows]
    return result


def regimes(
    train: tuple[Mapping[str, Array], Array], judged: tuple[Mapping[str, Array], Array]
) -> list[Regime]:
    """Return the rules whose rows hold more of the excess than their number would suggest.

    Args:
        train: Features and excess squared innovations ``(S, K)`` to grow the tree on.
        judged: The same, to count support and share on.
    """
    names = list(train[0])
    grown = np.stack([train[0][n].ravel() for n in names]), train[1].ravel()
    counted = np.stack([judged[0][n].ravel() for n in names]), judged[1].ravel()
    total = max(float(np.maximum(counted[1], 0.0).sum()), 1e-12)
    found = []
    for rule, rows in _leaves(grown, counted[0], names):
        support = float(rows.mean())
        share = float(np.maximum(counted[1], 0.0)[rows].sum() / total)
        if 0.0 < support < 1.0 and share > 1.3 * support:
            found.append(Regime(worded(rule), support, share))
    return sorted(found, key=lambda regime: -regime.share)


def worded(cuts: Sequence[_Cut]) -> str:
    """Return cuts in words; of several on one side of a feature the last holds, which is nearest.

    >>> worded([("time", "<", 1.68), ("|v|", ">=", 0.2), ("time", "<", 1.36)])
    'time < 1.36 & |v| >= 0.2'
    """
    last = {(name, sign): cut for name, sign, cut in cuts}
    return " & ".join(f"{name} {sign} {cut:.3g}" for (name, sign), cut in last.items())


def _leaves(
    grown: tuple[Array, Array], counted: Array, names: list[str]
) -> list[tuple[list[_Cut], NDArray[np.bool_]]]:
    """Return the leaves' rules and which of the counted rows they cover."""
    values, target = grown
    todo: list[tuple[list[_Cut], NDArray[np.bool_], NDArray[np.bool_], int]] = [
        ([], np.ones(values.shape[1], bool), np.ones(counted.shape[1], bool), 0)
    ]
    leaves: list[tuple[list[_Cut], NDArray[np.bool_]]] = []
    while todo:
        rule, here, there, depth = todo.pop()
        best = _best_cut(values[:, here], target[here]) if depth < _DEPTH else None
        if best is None:
            if rule:
                leaves.append((rule, there))
            continue
        feature, cut = best
        for below, sign in ((True, "<"), (False, ">=")):
            side = (values[feature] < cut) == below
            other = (counted[feature] < cut) == below
            todo.append(
                ([*rule, (names[feature], sign, cut)], here & side, there & other, depth + 1)
            )
    return leaves


def _best_cut(values: Array, target: Array) -> tuple[int, float] | None:
    """Return the feature and threshold that explain most of the target's variance."""
    if target.size < 2 * _LEAST:
        return None
    centred = target - target.mean()
    best, gain = None, 0.05 * float((centred**2).sum())
    for f, column in enumerate(values):
        for cut in np.unique(np.quantile(column, _CUTS)):
            below = column < cut
            count = int(below.sum())
            if min(count, target.size - count) < _LEAST:
                continue
            total = float(centred[below].sum())
            explained = total**2 / count + total**2 / (target.size - count)
            if explained > gain:
                best, gain = (f, float(cut)), explained
    return best
