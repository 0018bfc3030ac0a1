"""The table and the figure of `close_the_loop.py`: what the effect in the simulator changes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import recipe
from intervals import interval
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

SOURCES = ("without", "with")
_COLOURS = {"without": "#D55E00", "with": "#0072B2"}
_INK, _GREY = "#222222", "#8A8A8A"


def summarised(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return means and 95 % Student intervals over seeds, and the paired difference in return."""
    sources: dict[str, Any] = {}
    for source in SOURCES:
        own = [run for run in runs if run["source"] == source]
        names = [n for n in own[0]["z"] if all(n in run["z"] for run in own)]
        sources[source] = {
            "distance": {n: interval([abs(run["z"][n]) for run in own]) for n in names},
            "mean": {n: interval([_mean(run, n) for run in own]) for n in names},
            "nats_over_prior": {n: interval([run["nats_over_prior"][n] for run in own])
                                for n in names},
            "doubted": sum(bool(run["doubts"]) for run in own),
            "real_return": interval([run["real_return"] for run in own]),
            "sim_return": interval([run["sim_return"] for run in own]),
        }  # fmt: skip
    pairs = zip(*(sources[s]["real_return"]["values"] for s in ("with", "without")), strict=True)
    return {
        "seeds": len(runs) // len(SOURCES),
        "frames": runs[0]["frames"],
        "sources": sources,
        "gain": interval([one - other for one, other in pairs]),
        "runs": runs,
    }


def _mean(run: dict[str, Any], name: str) -> float:
    return run["posterior_mean"][run["names"].index(name)]


def true_values(result: dict[str, Any]) -> dict[str, float]:
    """Return what the robot hides, by name."""
    hidden = result["effect"]
    strength = {f"{hidden['name']}[{hidden['where']}]": hidden["strength"]}
    return dict(zip(result["parameters"], result["true"], strict=True)) | strength


def table(result: dict[str, Any]) -> str:
    """Return what moved, in Markdown."""
    without, corrected = (result["sources"][source] for source in SOURCES)

    def cell(entry: dict[str, Any] | None, digits: str) -> str:
        if entry is None:
            return ""
        low, high = format(entry["low"], digits), format(entry["high"], digits)
        return f"{entry['mean']:{digits}} [{low}, {high}]"

    lines = [
        f"{result['task']}, {result['seeds']} seeds, {result['frames']:,} frames per policy, mean "
        "and 95 % interval over seeds",
        "",
        "| | truth | simulator without the effect | simulator with the effect |",
        "|---|---|---|---|",
    ]
    rows = {
        "posterior mean": ("mean", ".3g"),
        "distance from the truth in posterior sd": ("distance", ".1f"),
        "nats over the prior at the truth": ("nats_over_prior", ".1f"),
    }
    for name, true in true_values(result).items():
        for label, (key, digits) in rows.items():
            shown = f"{true:.3g}" if key == "mean" else ""
            cells = [cell(source[key].get(name), digits) for source in (without, corrected)]
            lines.append(f"| {name}: {label} | {shown} | {cells[0]} | {cells[1]} |")
    for label, key in {"in its own simulator": "sim_return", "at the robot": "real_return"}.items():
        cells = [cell(source[key], ".1f") for source in (without, corrected)]
        lines.append(f"| return {label} | | {cells[0]} | {cells[1]} |")
    doubted = [f"{source['doubted']} of {result['seeds']}" for source in (without, corrected)]
    lines += [
        f"| seeds on which the loop doubted its simulator | | {doubted[0]} | {doubted[1]} |",
        f"| at the robot, with minus without, paired | | | {cell(result['gain'], '.1f')} |",
    ]
    return "\n".join(lines) + "\n"


def draw_figure(path: Path, result: dict[str, Any]) -> None:
    """Write the picture: a panel for each of what is hidden, and one for the return."""
    hidden = true_values(result)
    figure = Figure(figsize=(2.5 * (len(hidden) + 1), 3.4), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(hidden) + 1)
    units = {n: u for r in result["runs"] for n, u in zip(r["names"], r["units"], strict=True)}
    for axes, (name, true) in zip(panels, hidden.items(), strict=False):
        _posteriors(axes, result["runs"], name)
        axes.axhline(true, color=_INK, lw=1.0, ls="--")
        axes.set_title(f"{name}, {units.get(name, '')}", fontsize=9)
    panels[0].set_ylabel("posterior mean and 95 %; dashed: the robot", fontsize=8)
    _returns(panels[-1], result)
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    handles = [
        figure.axes[0].plot([], [], "o-", color=_COLOURS[s], label=f"simulator {s} the effect")[0]
        for s in SOURCES
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    recipe.save_picture(figure, path)


def _posteriors(axes: Any, runs: list[dict[str, Any]], name: str) -> None:
    """Draw what is believed of one parameter on each seed."""
    for source, shift in {"without": -0.12, "with": 0.12}.items():
        own = [run for run in runs if run["source"] == source and name in run["z"]]
        axes.errorbar(
            [run["seed"] + shift for run in own],
            [_mean(run, name) for run in own],
            yerr=[1.96 * run["posterior_sd"][run["names"].index(name)] for run in own],
            fmt="o",
            color=_COLOURS[source],
            ms=4,
            capsize=2,
            lw=1.2,
        )
    seeds = sorted({run["seed"] for run in runs})
    axes.set_xlim(seeds[0] - 0.5, seeds[-1] + 0.5)
    axes.set_xticks(seeds)
    axes.set_xlabel("seed", fontsize=9)


def _returns(axes: Any, result: dict[str, Any]) -> None:
    """Draw the return at the robot, a line for each seed, means with their intervals."""
    both = [result["sources"][source]["real_return"] for source in SOURCES]
    for pair in zip(*(entry["values"] for entry in both), strict=True):
        axes.plot([0, 1], pair, color=_GREY, lw=0.9, marker=".", ms=4)
    for x, (source, entry) in enumerate(zip(SOURCES, both, strict=True)):
        half = entry["high"] - entry["mean"]
        place = x + (0.15 if x else -0.15)
        axes.errorbar(place, entry["mean"], yerr=half, fmt="o", color=_COLOURS[source], capsize=4)
    axes.set_xlim(-0.45, 1.45)
    axes.set_xticks([0, 1], ["without", "with"])
    axes.set_xlabel("trained in the simulator … the effect", fontsize=8)
    axes.set_title("return at the robot", fontsize=9)
