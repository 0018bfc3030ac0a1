"""The page with the results: tables in Markdown, and two pictures."""

from __future__ import annotations

__all__ = ["failed", "table", "write_page"]

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import recipe

from torchrl_bayessim.whole_file import write_text

from .classes import CLASSES
from .comparison import comparison_table
from .frozen import told

Record = dict[str, Any]
_PLAIN = {"set_size", "mae", "median_error", "iou", "of_no_rule"}  # scores without an interval


def write_page(records: Sequence[Record], result: Mapping[str, Any], out: Path) -> None:
    """Write ``page.md``, ``confusion.png`` and ``calibration.png``."""
    parts = [
        "# Blind check of the gap diagnosis",
        f"Labels sealed before the first diagnosis: `{result['labels_sha256']}`. Causes count as "
        f"visible from a detectability of {result['threshold']:g}; intervals are Wilson's, 95 %.",
        *told(result["frozen"]).splitlines(),
        *_against(result),
        table(result),
        "By detectability (T1 and T2, class), beside one who knows the parameters, the noise and "
        "every strength, and names the likeliest effect of the catalogue:",
        _strata(result),
        "![confusion of classes](confusion.png)",
        "![predicted and true shrinkage](calibration.png)",
        "## Failures",
        _failures(records, result["threshold"]),
    ]
    write_text(out / "page.md", "\n\n".join(parts) + "\n")
    _confusion(records, result["threshold"], out / "confusion.png")
    _calibration(records, out / "calibration.png")


def _against(result: Mapping[str, Any]) -> list[str]:
    """Return the comparison with the baselines, where they were asked for."""
    if "methods" not in result:
        return []
    lead = "Against baselines on the same folders, scored by the same code, all robots together:"
    return ["## Baselines", lead, comparison_table(result["methods"]), "## All scores"]


def table(result: Mapping[str, Any]) -> str:
    """Return the scores of all tiers, all robots together and one by one."""
    rows = {f"{tier} (all)": scores for tier, scores in result["tiers"].items()}
    for robot, tiers in result["by_robot"].items():
        rows |= {f"{tier} {robot}": scores for tier, scores in tiers.items()}
    rows["where"] = result["where"]
    rows["regime"] = result["regime"]
    rows["shrinkage"] = result["shrinkage"]
    rows["strength"] = result["strength"]
    return _lines(rows)


def _lines(rows: Mapping[str, Mapping[str, Any]]) -> str:
    lines = ["| | score | value | 95 % | n |", "|---|---|---|---|---|"]
    for name, scores in rows.items():
        for score, value in scores.items():
            if isinstance(value, Mapping) and "ci95" in value and value["n"]:
                low, high = value["ci95"]
                text = f"{value['value']:.2f} | {low:.2f} to {high:.2f} | {value['n']}"
                lines.append(f"| {name} | {score} | {text} |")
            elif score == "p_uniform" and value["p_value"] is not None:
                said = f"D = {value['statistic']:.2f} | p = {value['p_value']:.2f}"
                lines.append(f"| {name} | Kolmogorov-Smirnov | {said} | {value['n']} |")
            elif score in _PLAIN and value is not None:
                lines.append(f"| {name} | {score} | {value:.2f} | | {scores['n']} |")
    return "\n".join(lines)


def _strata(result: Mapping[str, Any]) -> str:
    rows = {}
    for stratum, score in result["by_detectability"].items():
        known = result["oracle_by_detectability"][stratum]
        rows[stratum] = {"diagnosis": score, "oracle": known}
    return _lines(rows)


def failed(one: Record) -> bool:
    """Return whether a case counts against the diagnosis."""
    if one["verdict"] == "crash":
        return True
    if one["tier"] == "renamed":
        return not one.get("same", True)
    if one["tier"] in {"T3", "T4", "shuffled"} or (
        one["tier"] in {"T6", "T6B"} and not one["truth"]
    ):
        return one["verdict"] == "named"
    if not one["truth"]:
        return one["verdict"] not in {"none", "not_testable"}
    return not one.get("top1_class", one.get("exact"))


def _failures(records: Sequence[Record], threshold: float) -> str:
    lines = [
        "| case | robot | tier | truth | λ | verdict | said |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in records:
        if failed(one) and (not one["truth"] or one["detectability"] >= threshold):
            truth, named = " + ".join(one["truth"]) or "none", ", ".join(one["named"]) or "nothing"
            lines.append(
                f"| {one['case']} | {one['robot']} | {one['tier']} | {truth} "
                f"| {one['detectability']:.0f} | {one['verdict']} | {named} |"
            )
    return "\n".join(lines)


def _confusion(records: Sequence[Record], threshold: float, path: Path) -> None:
    from matplotlib.figure import Figure

    names = [*CLASSES, "nothing"]
    counts = np.zeros((len(names) - 1, len(names)))
    for one in records:
        if one["tier"] in {"T1", "T2"} and one["detectability"] >= threshold:
            said = one["named_class"][0] if one["named_class"] else "nothing"
            if said in names:
                counts[names.index(one["class"][0]), names.index(said)] += 1
    figure = Figure(figsize=(7, 6), layout="constrained")
    axes = figure.subplots()
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for (i, j), count in np.ndenumerate(counts):
        if count:
            color = "white" if share[i, j] > 0.5 else "black"
            axes.text(j, i, f"{count:.0f}", ha="center", va="center", color=color)
    axes.set_xticks(range(len(names)), names, rotation=60, ha="right")
    axes.set_yticks(range(len(names) - 1), names[:-1])
    axes.set(xlabel="named", ylabel="true class", title="T1 and T2, visible causes")
    recipe.save_picture(figure, path, dpi=120)


def _calibration(records: Sequence[Record], path: Path) -> None:
    from matplotlib.figure import Figure

    pairs = [r["shrinkage"] for r in records if r.get("shrinkage")]
    figure = Figure(figsize=(5, 5), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="grey", linewidth=1)
    for pair in pairs:
        low, high = pair["ci95"]
        axes.plot([pair["true"]] * 2, [low, high], color="tab:blue", alpha=0.4)
        axes.plot(pair["true"], pair["predicted"], "o", color="tab:blue", markersize=4)
    axes.set(
        xlabel="true share of the gap removed, noise-free new inputs", ylabel="predicted",
        xlim=(-0.1, 1.1), ylim=(-0.1, 1.1),
    )  # fmt: skip
    recipe.save_picture(figure, path, dpi=120)
