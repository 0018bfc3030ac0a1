"""Tables and pictures of `robustness.py`: curves over physics, and paired differences."""

from __future__ import annotations

import math
import statistics
from pathlib import Path
from typing import Any

import recipe
import torch
from intervals import interval

from torchrl_bayessim import plots

PALETTE = ("prior", "posterior", "oracle", "nominal")  # of one colour each in all pictures


def curves(runs: list[dict[str, Any]], robot: dict[str, float]) -> list[dict[str, Any]]:
    """Return the entries ``curves`` of result.json: means and spread over the seeds.

    Args:
        runs: One per seed and source.
        robot: Its value of each parameter, whose own score joins the grid.
    """
    found = []
    for source in dict.fromkeys(run["source"] for run in runs):
        own = [run for run in runs if run["source"] == source]
        for name, truth in robot.items():
            grid, values = zip(*(_with_robot(run, name, truth) for run in own), strict=True)
            scores = torch.tensor(values)
            spread = scores.std(0) if len(own) > 1 else torch.zeros(scores.shape[1])
            found.append(
                {
                    "source": source,
                    "parameter": name,
                    "grid": grid[0],
                    "return_mean": scores.mean(0).tolist(),
                    "return_sd": spread.tolist(),
                    "seeds": len(own),
                    "by_seed": scores.tolist(),
                }
            )
    return found


def _with_robot(run: dict[str, Any], name: str, truth: float) -> tuple[list[float], list[float]]:
    """Return grid and scores along one parameter, with what the policy scores at the robot."""
    points = zip(run["grids"][name]["grid"], run["grids"][name]["score"], strict=True)
    others = [point for point in points if not math.isclose(point[0], truth, rel_tol=1e-5)]
    # of more episodes than a point of the grid
    every = sorted([*others, (truth, run["at_real"])])
    return [value for value, _ in every], [score for _, score in every]


def compared(runs: list[dict[str, Any]], where: str) -> dict[str, Any]:
    """Return each source's scores, and the posterior's differences by seed.

    Args:
        runs: One per seed and source.
        where: ``at_real``, at the robot, or ``under_prior``.
    """
    scores = {
        source: [run[where] for run in runs if run["source"] == source]
        for source in dict.fromkeys(run["source"] for run in runs)
    }
    found: dict[str, Any] = {source: _spread(values) for source, values in scores.items()}
    for other in ("prior", "oracle"):
        if {"posterior", other} <= scores.keys():
            pairs = zip(scores["posterior"], scores[other], strict=True)
            found[f"posterior minus {other}"] = _spread([a - b for a, b in pairs])
    return found


def _spread(values: list[float]) -> dict[str, Any]:
    if len(values) > 1:
        found: dict[str, Any] = interval(values)
        return found | {"sd": statistics.stdev(values)}
    return {"mean": values[0], "low": None, "high": None, "values": values, "sd": None}


def table(result: dict[str, Any]) -> str:
    """Return the scores at the robot in Markdown."""
    seeds, score = result["seeds"], result["score"]
    lines = [
        f"{result['task']}, {result['algorithm']}, {seeds} seeds, {result['frames']:,} frames per "
        f"policy, {score} in the same {result['real_episodes']} episodes at the robot "
        f"({', '.join(f'{n} {v:.3g}' for n, v in _truth(result))}){_besides(result)}"
        f"{_chosen(result)}{_domains(result)}",
        "",
        f"| trained under | {score} at the robot, mean and 95 % interval over seeds | spread (sd) "
        f"| each seed | {score} under the prior | its own physics first solved after (frames) |",
        "|---|---|---|---|---|---|",
    ]
    for source, entry in result["at_real"].items():
        spread = "" if entry["sd"] is None else f"{entry['sd']:.2g}"
        elsewhere = result["under_prior"][source]
        solved = [run["solved"] for run in result["runs"] if run["source"] == source]
        when = ", ".join("never" if at is None else f"{at['frames']:,.0f}" for at in solved)
        share = score == "success" and " minus " not in source
        other = f"{_with_interval(elsewhere, share=share)}: {_each(elsewhere)}"
        cells = source, _with_interval(entry, share=share), spread, _each(entry), other, when
        lines.append(f"| {' | '.join(cells)} |")
    lines += ["", f"{_common(result)}{_commits(result)}"]
    told = [run["posterior"] for run in result["posteriors"]]
    if told:
        lines += ["", "| seed | posterior, mean ± sd | nats over the prior |", "|---|---|---|"]
    for run in result["posteriors"]:
        moments = zip(
            result["parameters"], run["posterior"]["mean"], run["posterior"]["sd"], strict=True
        )
        cell = ", ".join(f"{name} {mean:.3g} ± {sd:.2g}" for name, mean, sd in moments)
        lines.append(f"| {run['seed']} | {cell} | {run['posterior']['nats_over_prior']:+.1f} |")
    return "\n".join(lines) + "\n"


def _common(result: dict[str, Any]) -> str:
    """Return what intervals over seeds leave out."""
    text = "Intervals are over seeds. All policies are scored in the same episodes"
    if result["score"] != "success":
        return f"{text}: other episodes would move them together."
    columns = ("at_real", "under_prior")
    shares = [run[column] for run in result["runs"] for column in columns] or [0.0]
    error = max((p * (1 - p) / result["real_episodes"]) ** 0.5 for p in shares)
    return f"{text}: others would move them together, by a standard error of {error:.3f} at most."


def _besides(result: dict[str, Any]) -> str:
    """Return what the posterior costs beside training."""
    frames = result.get("inference_frames", 0)  # which older results do not say
    text = f"; the posterior took {frames:,} frames of simulation besides"
    return f"{text}, and the prior's policy, which collects" if frames else ""


def _chosen(result: dict[str, Any]) -> str:
    """Return which of a training's policies was taken; older results do not say."""
    told = {"best": "each the best of its looks under its own physics", "last": "each the last"}
    kind = result.get("checkpoint")
    return f"; policies are {told[kind]}" if kind else ""


def _domains(result: dict[str, Any]) -> str:
    """Return how many domains were trained under, if they were drawn once."""
    count = result.get("domains", 0)
    return f"; under prior and posterior each policy saw {count} domains" if count else ""


def _commits(result: dict[str, Any]) -> str:
    """Return which code trained which policies, where it was not one code for all."""
    made: dict[str, list[str]] = {}
    for run in result["runs"]:
        commit = run.get("provenance", {}).get("commit") or "older code"
        made.setdefault(commit, []).append(run["source"])
    if len(made) < 2:
        return ""
    told = (f"{commit} ({', '.join(dict.fromkeys(who))})" for commit, who in made.items())
    return f" Policies were trained at commits {', '.join(told)}."


def _with_interval(entry: dict[str, Any], *, share: bool) -> str:
    """Return mean and interval; Student's does not know that a share ends at 0 and 1."""
    low, high = entry["low"], entry["high"]
    if share and low is not None:
        low, high = max(low, 0.0), min(high, 1.0)
    span = "" if low is None else f" [{low:.3g}, {high:.3g}]"
    return f"{entry['mean']:.3g}{span}"


def _each(entry: dict[str, Any]) -> str:
    return ", ".join(f"{value:.3g}" for value in entry["values"])


def _truth(result: dict[str, Any]) -> Any:
    return zip(result["parameters"], result["true"], strict=True)


def draw_pictures(out: Path, result: dict[str, Any]) -> list[Path]:
    """Write robustness_PARAMETER.png and learning.png; return their paths."""
    paths = []
    for name, truth in _truth(result):
        own = [curve for curve in result["curves"] if curve["parameter"] == name]
        lines = {c["source"]: (torch.tensor(c["grid"]), torch.tensor(c["by_seed"])) for c in own}
        figure = plots.learning_curves(
            lines,
            xlabel=name,
            ylabel=result["score"],
            marks={"the robot": truth},
            palette=PALETTE,
        )
        paths.append(out / f"robustness_{name}.png")
        recipe.save_picture(figure, paths[-1])
    lines = {}
    for source in dict.fromkeys(run["source"] for run in result["runs"]):
        own = [run["curve"] for run in result["runs"] if run["source"] == source]
        key = "score" if all("score" in point for point in own[0]) else "return"
        values = [[p[key] if p[key] is not None else math.nan for p in curve] for curve in own]
        frames = [point["frames"] for point in own[0]]
        lines[source] = torch.tensor(frames), torch.tensor(values)
    if lines and all(len(x) for x, _ in lines.values()):
        ylabel = f"{result['score']} under its own physics"
        figure = plots.learning_curves(lines, ylabel=ylabel, palette=PALETTE)
        paths.append(out / "learning.png")
        recipe.save_picture(figure, paths[-1])
    return paths
