"""Does the cause act where the report says that the error sits?

The generator notes how much the cause changes in every control step: commands, forces or
measurements. It *acts* where that exceeds a tenth of the largest change in all runs. The report's
first rule, such as ``|hinge velocity| < 0.35 & hinge position >= 0.2``, is read again on the logs.
Their intersection over union is compared with that of no rule at all, the share of the steps in
which the cause acts.
"""

from __future__ import annotations

__all__ = ["overlap", "rows_of_rule", "times_of_action"]

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bayessim.diagnosis.regimes import features
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

Array = NDArray[np.float64]
_ACTS = 0.1  # of the largest change
_EVERYWHERE = 0.9  # share of the steps, from which a cause has no regime


def overlap(
    system: System, logs: Sequence[Log], sealed: Path, report: Mapping[str, Any]
) -> dict[str, float] | None:
    """Return the intersection over union of the rule, and that of no rule.

    ``None`` where the cause acts nearly always or changes the model itself, or where the report has
    no rule.

    Args:
        system: The nominal system.
        logs: The runs, by the names of their files.
        sealed: File in which it is noted when causes act.
        report: Of the diagnosis.
    """
    rules = (report.get("where") or {}).get("regimes") or ()
    with np.load(sealed) as arrays:
        acts = [arrays[f"acts{i}"] for i in range(len(logs))]
    if not rules or acts[0].shape[1] != 1:
        return None
    steps = cut(logs, 1, history=1)  # one row each: what happens from one row to the next
    true = times_of_action([run[:, 0] for run in acts])
    active = np.array([true[log][row] for log, row in zip(steps.log, steps.start, strict=True)])
    if not 0.0 < active.mean() < _EVERYWHERE:
        return None
    seen = {name: values[:, 0] for name, values in features(steps, system.robot).items()}
    said = rows_of_rule(rules[0]["rule"], seen)
    union = (said | active).mean()
    return {"iou": float((said & active).mean() / union), "of_no_rule": float(active.mean())}


def times_of_action(changes: Sequence[Array]) -> list[NDArray[np.bool_]]:
    """Return in which steps of each run a cause acts, given how much it changes, ``(T,)`` each."""
    largest = max(float(run.max()) for run in changes)
    return [run > _ACTS * largest for run in changes]


def rows_of_rule(rule: str, features: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Return the rows that a rule covers.

    Raises:
        ValueError: It is no conjunction of comparisons of the features.
    """
    covered = np.ones(len(next(iter(features.values()))), dtype=bool)
    for part in rule.split(" & "):
        found = re.fullmatch(r"(.*) (<|>=) (\S+)", part)
        if found is None or found[1] not in features:
            raise ValueError(f"expected a rule such as 'time >= 1.5 & ...', got {rule!r}")
        below = features[found[1]] < float(found[3])
        covered &= below == (found[2] == "<")
    return covered
