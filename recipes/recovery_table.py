"""The rows and the tables of `posterior_recovery`, from what was found with each seed."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from typing import Any

import torch
from recovery_problems import PROBLEMS
from scipy.stats import kstest
from torch import Tensor

from torchrl_bayessim.inference.calibration import coverage_band

BY_PRODUCT = "BayesSim pooled"
DEFAULTS = "BayesSim"


def rows(parts: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield one row per problem, parameter and method."""
    for name in dict.fromkeys(part["problem"] for part in parts):
        own = [part for part in parts if part["problem"] == name]
        problem = PROBLEMS[name]
        for d, parameter in enumerate(problem.prior.names):
            for method in own[0]["methods"]:
                entries = _entries(own, method)
                at_truth = [e["log_prob"][d] for e in entries]
                nats = [row[d] for e in entries for row in e["nats"]]
                place = torch.tensor([row[d] for e in entries for row in e["place"]])
                fits = [e["seconds_fit"] for e in entries]
                yield {
                    "problem": name,
                    "parameter": parameter,
                    "method": method,
                    "log_prob_mean": statistics.fmean(at_truth),
                    "log_prob_sd": statistics.stdev(at_truth) if len(at_truth) > 1 else None,
                    "nats_over_prior": statistics.fmean(nats) if nats else None,
                    "coverage_50": covered(place, 0.5),
                    "coverage_90": covered(place, 0.9),
                    "sbc_p": uniform(place),
                    "truths": len(place),
                    "seconds_simulate": statistics.fmean(p["seconds_simulate"] for p in own),
                    "seconds_fit": None if None in fits else statistics.fmean(fits),
                    "simulations": own[0]["simulations"],
                    "seeds": len(entries),
                    "paper_best": problem.paper[parameter],
                    "prior": -math.log(problem.prior.high[d] - problem.prior.low[d]),
                }


def _entries(parts: list[dict[str, Any]], method: str) -> list[dict[str, Any]]:
    """Return what a method said with each seed that it was asked with; the first has all."""
    return [part["methods"][method] for part in parts if method in part["methods"]]


def covered(place: Tensor, level: float) -> float | None:
    """Return the share of truths in central intervals of this level."""
    return ((place - 0.5).abs() <= level / 2).float().mean().item() if len(place) else None


def uniform(place: Tensor) -> float | None:
    """Return how likely places as uneven are if they are uniform, as those of a right posterior.

    Simulation-based calibration (Talts et al., 2018, arXiv:1804.06788), by Kolmogorov and Smirnov.
    """
    return float(kstest(place.numpy(), "uniform").pvalue) if len(place) else None


def joint(parts: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield nats over the prior of all parameters together, and the time to fit, per method.

    And how many truths highest-density regions hold (expected coverage, Hermans et al., 2022,
    arXiv:2110.06581), where the method says.
    """
    for name in dict.fromkeys(part["problem"] for part in parts):
        own = [part for part in parts if part["problem"] == name]
        for method in own[0]["methods"]:
            entries = _entries(own, method)
            if all(e["joint_nats"] for e in entries):
                yield {
                    "problem": name,
                    "method": method,
                    "nats": statistics.fmean(v for e in entries for v in e["joint_nats"]),
                    "seconds_fit": statistics.fmean(e["seconds_fit"] for e in entries),
                    **_regions([level for e in entries for level in e.get("region") or ()]),
                }


def _regions(levels: list[float]) -> dict[str, Any]:
    edge = torch.tensor(levels)
    inside = {f"coverage_{round(100 * c)}": (edge <= c).float().mean().item() for c in (0.5, 0.9)}
    return inside | {"sbc_p": uniform(edge), "truths": len(edge)} if levels else {"truths": 0}


def table(result: dict[str, Any], names: list[str]) -> str:
    """Return the tables in Markdown."""
    lines = [
        "Log-density at the truth, mean ± deviation over seeds; in brackets nats over the prior, "
        "averaged over other truths, and how many of these 50 % and 90 % intervals hold.",
        "",
    ]
    for name in names:
        found = [row for row in result["rows"] if row["problem"] == name]
        parameters = list(dict.fromkeys(row["parameter"] for row in found))
        lines += [f"**{name}**", "", f"| method | {' | '.join(parameters)} | fit [s] |"]
        lines += ["|---" * (len(parameters) + 2) + "|"]
        best = {row["parameter"]: row["paper_best"] for row in found}
        flat = {row["parameter"]: row["prior"] for row in found}
        lines += [f"| prior | {' | '.join(f'{flat[p]:.2f}' for p in parameters)} | |"]
        lines += [f"| paper, best | {' | '.join(f'{best[p]:.2f}' for p in parameters)} | |"]
        for method in dict.fromkeys(row["method"] for row in found):
            own = [row for row in found if row["method"] == method]
            spent = own[0]["seconds_fit"]
            cells = " | ".join(cell(row) for row in own)
            lines += [f"| {method} | {cells} | {'' if spent is None else f'{spent:.1f}'} |"]
        lines += ["", *(f"- {text}" for text in result["said"].get(name, [])), ""]
    if result["paper_mode"]:
        lines += [*against_the_paper(result["rows"]), ""]
    together = [{**row, "parameter": "all together"} for row in result["joint"]]
    lines += [*calibration([*result["rows"], *together]), ""]
    lines += ["All parameters together, nats over the prior averaged over other truths:", ""]
    lines += ["| problem | method | nats | fit [s] |", "|---|---|---|---|"]
    lines += [
        f"| {row['problem']} | {row['method']} | {row['nats']:.2f} | {row['seconds_fit']:.1f} |"
        for row in result["joint"]
    ]
    return "\n".join(lines) + "\n"


def against_the_paper(rows: list[dict[str, Any]]) -> list[str]:
    """Return the best of our columns beside the best of the paper's, and the pooling one."""
    lines = ["| | the paper's best | our best | of | BayesSim pooled |", "|---|---|---|---|---|"]
    for name, parameter in dict.fromkeys((row["problem"], row["parameter"]) for row in rows):
        own = [row for row in rows if (row["problem"], row["parameter"]) == (name, parameter)]
        best = max(own, key=lambda row: row["log_prob_mean"])
        pooled = [row["log_prob_mean"] for row in own if row["method"].startswith(BY_PRODUCT)]
        note = " (unidentifiable)" if parameter in PROBLEMS[name].unidentifiable else ""
        lines += [
            f"| {name}, {parameter}{note} | {best['paper_best']:.2f} | {best['log_prob_mean']:.2f} "
            f"| {best['method']} | {pooled[0]:.2f} |"
        ]
    return ["Log-density at the truth, mean over seeds:", "", *lines]


def calibration(rows: list[dict[str, Any]]) -> list[str]:
    """Return how often our default networks' intervals and regions hold the truth, and ranks."""
    own = [
        row
        for row in sorted(rows, key=lambda row: list(PROBLEMS).index(row["problem"]))
        if row["truths"] and (row["method"] == DEFAULTS or row["method"].startswith(BY_PRODUCT))
    ]
    if not own:
        return []
    text = {
        count: ", ".join(
            "{:.0%}: {:.1%} to {:.1%}".format(level, *coverage_band(count, level))
            for level in (0.5, 0.9)
        )
        for count in dict.fromkeys(row["truths"] for row in own)
    }
    lines = [
        "How many of the truths our intervals hold, and regions of highest density of all "
        "parameters together, and the chance of ranks as uneven if they were uniform. A right "
        "posterior's are 19 times of 20 in these bands, of "
        + "; of ".join(f"{count} truths {band}" for count, band in text.items())
        + ".",
        "",
        "| problem, parameter | method | 50 % | 90 % | p of the ranks | truths |",
        "|---|---|---|---|---|---|",
    ]
    return lines + [
        f"| {row['problem']}, {row['parameter']} | {row['method']} | {row['coverage_50']:.1%} "
        f"| {row['coverage_90']:.1%} | {row['sbc_p']:.2g} | {row['truths']} |"
        for row in own
    ]


def cell(row: dict[str, Any]) -> str:
    """Return one row's cell."""
    sd = "" if row["log_prob_sd"] is None else f" ± {row['log_prob_sd']:.2f}"
    text = f"{row['log_prob_mean']:.2f}{sd}"
    if row["nats_over_prior"] is None:
        return text
    return (
        f"{text} [{row['nats_over_prior']:+.2f}; "
        f"{row['coverage_50']:.0%}, {row['coverage_90']:.0%}]"
    )
