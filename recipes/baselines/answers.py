"""How a baseline answers: in the form of the diagnosis' report, so that the same code scores it."""

from __future__ import annotations

__all__ = ["FITS", "answer", "graded", "share_explained"]

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bayessim.diagnosis.objective import Unit
from torchrl_bayessim.effects.units import unit_at

from .whole_runs import Runs

Array = NDArray[np.float64]
_HORIZON = 20  # control steps over which the true shrinkage is computed
_NOTHING = 0.05  # of the error that an effect must remove, at least
FITS = 4.0  # mean square of a simulator that fits: noise at the start grows over a whole run
_NAMED, _PARTIAL = 0.8, 0.4  # shares of the gap, as in the diagnosis


def share_explained(before: float, after: float) -> float:
    """Return the share of the error above the noise that is gone, at most 1.

    Example:
        >>> share_explained(5.0, 2.0)
        0.75
    """
    return min((before - after) / (before - 1.0), 1.0) if before > 1.0 else 0.0


def graded(before: float, after: float, *, alike: int = 1) -> str:
    """Return the verdict on an effect, by the mean squares without and with it.

    Args:
        before: Without the effect.
        after: With it.
        alike: How many names explain as much.

    Example:
        >>> graded(1.01, 1.0), graded(30.0, 29.0), graded(30.0, 10.0), graded(30.0, 2.0)
        ('none', 'unknown', 'named_partial', 'named')
        >>> graded(30.0, 2.0, alike=2)
        'ambiguous'
    """
    if before - after < _NOTHING * max(before, 1.0):
        return "none" if before < FITS else "unknown"
    share = share_explained(before, after)
    if share >= _PARTIAL and alike > 1:
        return "ambiguous"
    return "named" if share >= _NAMED else "named_partial" if share >= _PARTIAL else "unknown"


def answer(
    runs: Runs,
    verdict: str,
    *,
    found: Mapping[Unit, float],
    confused: Sequence[str] = (),
    theta: tuple[Array, Array],
    explained: float | None = None,
) -> dict[str, Any]:
    """Return an answer in the report's form.

    Args:
        runs: The case.
        verdict: As in the report.
        found: Strengths of what is named, the first cause first.
        confused: Names that explain the data as well as the first; default the first.
        theta: Parameters without and with what is named, shape ``(D,)`` each.
        explained: Share of the gap that is said to be removed.
    """
    robot = runs.system.robot
    names = runs.system.prior.names if runs.system.prior is not None else ()
    effects = []
    for unit, strength in found.items():
        targets = unit.effect.targets(robot)
        on = {t: strength * d for t, d in zip(targets, unit.direction, strict=True) if d}
        one = targets.index(next(iter(on)))
        effects.append(
            {
                "name": unit.name, "where": unit.where, "strength": strength, "strengths": on,
                "unit": unit_at(unit.effect, robot, one), "ci95": (strength, strength),
            }
        )  # fmt: skip
    share = 0.0 if explained is None else explained
    return {
        "verdict": verdict,
        "effects": effects,
        "confusion_set": list(confused) or [unit.name for unit in list(found)[:1]],
        "gap": {"explained_fraction": share, "ci95": (share, share), "horizon_steps": _HORIZON},
        "parameters": [
            {"name": name, "without_effects": float(a), "with_effects": float(b)}
            for name, a, b in zip(names, *theta, strict=True)
        ],
        "audit": {"noise": dict(zip(robot.channels, runs.noise.tolist(), strict=True))},
    }
