"""In which regime of motion a cause acts, as a rule in words.

Where the error sits says little of a law: what a saturation does in one step is seen in the next
ten. Once the cause is in the model, what it changes in every single control step is known, and a
rule is sought that covers the steps in which it acts: those in which it changes more than a tenth
of the most that it changes in any. The rule is a conjunction that makes the intersection over union
with these steps largest on the training runs; support and share are counted on the validation runs.
"""

from __future__ import annotations

__all__ = ["acting_regime", "change"]

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..logs.log import Log
from .objective import Point, strengths_of
from .preparation import Prepared
from .regimes import Regime, features, worded
from .segments import Segments, cut

Array = NDArray[np.float64]
Cuts = tuple[tuple[str, str, float], ...]
_ACTS = 0.1  # of the largest change
_EVERYWHERE = 0.9  # share of the steps, from which a cause has no regime
_MOST = 3000  # steps looked at
_CUTS = np.linspace(0.02, 0.98, 49)  # quantiles of a feature
_DEPTH = 3  # comparisons in a rule
_BETTER = 0.05  # of the intersection over union, for one more


def acting_regime(prepared: Prepared, point: Point, name: str) -> list[Regime]:
    """Return the rule that says when an effect acts; none where it nearly always does.

    Args:
        prepared: Logs and simulator.
        point: Parameters and strengths, the effect among them.
        name: Of the effect, one of commands, forces or the model: of sensors there is none.
    """
    channels = {unit.effect.channel for unit in point.strengths if unit.name == name}
    if not channels or "sensing" in channels or not prepared.mode.synchronised:
        return []
    seen = [
        _steps(prepared, prepared.logs[split], point, name) for split in ("train", "validation")
    ]
    (columns, changed), (others, judged) = seen
    active = changed > _ACTS * changed.max(initial=1e-12)
    if not 0.0 < active.mean() < _EVERYWHERE:
        return []
    cuts = _best_cuts(columns, active)
    covered = _covered(cuts, others)
    support = float(covered.mean())
    if not cuts or not 0.0 < support < 1.0:
        return []
    share = float((judged[covered] ** 2).sum() / max((judged**2).sum(), 1e-300))
    return [Regime(worded(cuts), support, share)]


def _steps(
    prepared: Prepared, logs: Sequence[Log], point: Point, name: str
) -> tuple[dict[str, Array], Array]:
    """Return features of control steps, and how much the effect changes in each, ``(S,)``."""
    history = max(prepared.sets["train"].segments.history, 1)
    steps = cut(logs, 1, history=history, most=_MOST)
    columns = features(steps, prepared.predictor.system.robot)
    return {key: values[:, 0] for key, values in columns.items()}, change(
        prepared, steps, point, name
    )


def change(prepared: Prepared, steps: Segments, point: Point, name: str) -> Array:
    """Return the change of what is measured after each step, in standard deviations of noise."""
    without = {unit: s for unit, s in point.strengths.items() if unit.name != name}
    points = [point, Point(point.z, without)]
    predictor, theta = prepared.predictor, prepared.sets["train"].theta
    thetas = theta(np.stack([p.z for p in points]))
    there, gone = predictor.residuals(steps, thetas, strengths_of(points, predictor.system.robot))
    return np.asarray(np.linalg.norm(np.nan_to_num(there - gone)[:, 0] / prepared.noise, axis=-1))


def _best_cuts(columns: Mapping[str, Array], active: NDArray[np.bool_]) -> Cuts:
    """Return the comparisons whose conjunction covers the active steps best.

    Example:
        >>> speed = np.linspace(-1, 1, 401)
        >>> _best_cuts({"v": speed, "|v|": np.abs(speed)}, np.abs(speed) > 0.52)
        (('|v|', '>=', 0.52),)
    """
    cuts: Cuts = ()
    covered, best = np.ones(len(active), dtype=bool), float(active.mean())
    for _ in range(_DEPTH):
        tried = [
            (_overlap(covered & _side(values, sign, limit), active), (name, sign, float(limit)))
            for name, values in columns.items()
            for limit in np.unique(np.quantile(values, _CUTS))
            for sign in ("<", ">=")
        ]
        overlap, found = max(tried)
        if overlap < best + _BETTER:
            break
        best, cuts = overlap, (*cuts, found)
        covered &= _side(columns[found[0]], *found[1:])
    return cuts


def _covered(cuts: Cuts, columns: Mapping[str, Array]) -> NDArray[np.bool_]:
    covered = np.ones(len(next(iter(columns.values()))), dtype=bool)
    for name, sign, limit in cuts:
        covered &= _side(columns[name], sign, limit)
    return covered


def _side(values: Array, sign: str, limit: float) -> NDArray[np.bool_]:
    return (values < limit) == (sign == "<")


def _overlap(said: NDArray[np.bool_], true: NDArray[np.bool_]) -> float:
    union = int((said | true).sum())
    return int((said & true).sum()) / union if union else 0.0
