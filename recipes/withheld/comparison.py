"""The diagnosis against the baselines: one score for every tier, and how far the gap shrinks.

Baselines answered the same folders, and are scored by the same code.
"""

from __future__ import annotations

__all__ = ["HEADLINES", "compared", "comparison_table"]

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .scoring import NAMING, Record, scores, share

HEADLINES = {
    "T0": "false_alarm", "T1": "top1_class", "T2": "top1_class", "T3": "wrong_named",
    "T4": "wrong_named", "T5": "exact", "T6": "top1_class", "T6B": "top1_class",
    "parameters": "false_alarm", "noise": "false_alarm", "shuffled": "wrong_named",
    "renamed": "same",
}  # fmt: skip
"""The score by which methods are compared, of every tier."""


def compared(methods: Mapping[str, Sequence[Record]], *, threshold: float) -> dict[str, Any]:
    """Return the headline score of every method on every tier, and the share of the gap removed.

    Args:
        methods: Records of all cases, by method.
        threshold: Detectability from which a cause counts as visible.
    """
    found: dict[str, Any] = {}
    for method, records in methods.items():
        result = scores(records, threshold=threshold)
        tiers = result["tiers"]
        seen = [r for r in records if r["detectability"] >= threshold]
        known = [r for r in seen if r["tier"] in {"T1", "T2"}]
        removed = [r["removed"] for r in known if r.get("removed") is not None]
        found[method] = {
            **{tier: tiers[tier][HEADLINES[tier]] for tier in tiers if tier in HEADLINES},
            "named_right": share(r["top1_class"] for r in known if r["verdict"] in NAMING),
            "gap_removed": {"n": len(removed), "median": float(np.median(removed or [np.nan]))},
            "crashes": result["crashes"],
            "seconds_per_case": result["seconds_per_case"],
        }
    return found


def comparison_table(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the comparison in Markdown: a row per tier, a column per method."""
    tiers = [t for t in HEADLINES if any(t in one for one in found.values())]
    lines = ["| | score | " + " | ".join(found) + " |", "|---" * (2 + len(found)) + "|"]
    for tier in tiers:
        cells = [_cell(one.get(tier)) for one in found.values()]
        lines.append(f"| {tier} | {HEADLINES[tier]} | " + " | ".join(cells) + " |")
    cells = [_cell(one["named_right"]) for one in found.values()]
    lines.append("| T1, T2 | right where something is named | " + " | ".join(cells) + " |")
    cells = [f"{one['gap_removed']['median']:.2f}" for one in found.values()]
    lines.append("| T1, T2 | share of the gap removed, median | " + " | ".join(cells) + " |")
    cells = [f"{one['seconds_per_case']:.1f}" for one in found.values()]
    return "\n".join([*lines, "| all | seconds per case | " + " | ".join(cells) + " |"])


def _cell(score: Mapping[str, Any] | None) -> str:
    if not score or not score["n"]:
        return ""
    low, high = score["ci95"]
    return f"{score['value']:.2f} ({low:.2f} to {high:.2f}), n={score['n']}"
