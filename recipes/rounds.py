"""What the rounds of a `sim2real` job gave: entries of result.json, the journal, the pictures."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import kept_json
import recipe
import torch
from intervals import of_mean
from tasks import Task
from torch import Tensor
from torchrl.record.loggers import Logger

from torchrl_bayessim import plots
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.loop import Round
from torchrl_bayessim.sources import draw
from torchrl_bayessim.whole_file import write_text

_ANEW = "begin the run anew in another folder, as its earlier rounds are told nowhere else"


class Journal:
    """What each round gave, kept beside the checkpoint so that a resumed run reports them all.

    A logger, if there is one, is told everything again: it begins anew in every process. Over the
    frames of training it gets ``train/*``, and each round ``posterior/NAME``, ``posterior/NAME_sd``
    of the parameters' ``names``, and ``real/return``.

    Raises:
        ValueError: The file of the run to resume is damaged.
    """

    def __init__(
        self,
        path: Path,
        *,
        resume: bool,
        logger: Logger | None = None,
        names: tuple[str, ...] = (),
    ) -> None:
        self.path, self.logger, self.names = path, logger, names
        resume = resume and path.exists()  # not before the end of the first round
        self.rounds: list[dict[str, Any]] = (
            kept_json.read(path, list, entries=dict, hint=_ANEW) if resume else []
        )
        for entry in self.rounds:
            self._log(entry)

    def add(self, index: int, entry: dict[str, Any]) -> None:
        """Keep the entry of round ``index``, which may be told twice after a break."""
        if index == len(self.rounds):
            self._log(entry)
        self.rounds = [*self.rounds[:index], entry]
        write_text(self.path, json.dumps(recipe.plain(self.rounds)))

    def _log(self, entry: dict[str, Any]) -> None:
        if self.logger is None:
            return
        for point in entry["curve"]:
            for name, value in point.items():
                number = math.nan if value is None else value
                self.logger.log_scalar(f"train/{name}", number, step=int(point["frames"]))
        moments = zip(self.names, entry["posterior_mean"], entry["posterior_sd"], strict=True)
        scalars = {"real/return": entry["real_return"]}
        for name, mean, sd in moments:
            scalars |= {f"posterior/{name}": mean, f"posterior/{name}_sd": sd}
        for name, value in scalars.items():
            self.logger.log_scalar(name, value, step=entry["frames"])


def describe(
    turn: Round, task: Task, truth: Tensor, *, real: tuple[float, list[float]]
) -> dict[str, Any]:
    """Return the round's entry of result.json; ``real`` is the robot's score with its interval."""
    log_prob = turn.posterior.log_prob(truth).item()
    trained = [point["return"] for point in turn.curve if ended(point)]
    return {
        "round": turn.index + 1,
        "posterior_mean": turn.posterior.mean.tolist(),
        "posterior_sd": turn.posterior.stddev.tolist(),
        "log_prob_true": log_prob,
        "nats_over_prior": log_prob - task.prior.log_prob(truth).item(),
        "real_return": real[0],
        "real_return_ci": real[1],
        "sim_return": trained[-1] if trained else None,
        "frames": turn.frames,
        "simulations": turn.simulations,
        "seconds": turn.seconds,
        "curve": turn.curve,
    }


def compare(posterior: Tensor, prior: Tensor, *, real: tuple[float, list[float]]) -> dict[str, Any]:
    """Return the entries of the baseline, whose score is ``real``; episodes are paired."""
    gain, interval = of_mean(posterior - prior)
    return {
        "baseline": {"source": "prior", "real_return": real[0], "real_return_ci": real[1]},
        "gain": {"real_return": gain, "real_return_ci": interval},
    }


def shown(mean: float, interval: list[float], *, digits: int = 1) -> str:
    """Return a score and its interval as text."""
    low, high = (f"{bound:.{digits}f}" for bound in interval)
    return f"{mean:.{digits}f} [{low}, {high}]"


def sentence(turn: Round, task: Task, entry: dict[str, Any], *, said: str) -> str:
    """Return the round in one line, with what is ``said`` of the robot."""
    moments = entry["posterior_mean"], entry["posterior_sd"]
    rows = zip(task.prior.names, *moments, task.prior.units, strict=True)
    physics = ", ".join(f"{n} {m:.3g} ± {s:.2g} {u}".rstrip() for n, m, s, u in rows)
    return (
        f"round {turn.index + 1}: {physics} ({entry['nats_over_prior']:+.1f} nats over the prior); "
        f"{said} after {turn.frames:,} frames, {turn.seconds:.0f} s"
    )


def draw_pictures(
    out: Path,
    task: Task,
    posterior: PhysicsPosterior,
    *,
    result: dict[str, Any],
    curves: dict[str, list[dict[str, float]]],
    score: str,
) -> None:
    """Write posterior.png (also zoomed), learning.png and return.png.

    Args:
        out: Folder.
        task: Whose parameters these are.
        posterior: Of the last round.
        result: Holds the truth, the rounds and, if there is one, the baseline.
        curves: What a policy was trained under, to its points with ``frames`` and ``return``.
        score: What the robot gives.
    """
    samples = draw(posterior, 4000, key=("picture",))
    prior_samples = draw(task.prior, 4000, key=("picture", "prior"))
    for name, zoom in {"posterior": False, "posterior_zoom": True}.items():
        figure = plots.pair_plot(
            samples,
            names=task.prior.names,
            units=task.prior.units,
            prior_samples=prior_samples,
            truth=torch.tensor(result["true"]),
            zoom=zoom,
        )
        recipe.save_picture(figure, out / f"{name}.png")
    lines = {
        f"under the {name}": (
            torch.tensor([point["frames"] for point in curve if ended(point)]),
            torch.tensor([point["return"] for point in curve if ended(point)]),
        )
        for name, curve in curves.items()
        if any(ended(point) for point in curve)
    }
    if lines:
        figure = plots.learning_curves(lines, ylabel="return of finished episodes in simulation")
        recipe.save_picture(figure, out / "learning.png")
    baseline = result.get("baseline", {})
    figure = plots.return_per_round(
        [entry["real_return"] for entry in result["rounds"]],
        [tuple(entry["real_return_ci"]) for entry in result["rounds"]],
        baseline=baseline.get("real_return"),
        baseline_interval=tuple(baseline["real_return_ci"]) if baseline else None,
        ylabel=f"{score} at the real system",
    )
    recipe.save_picture(figure, out / "return.png")


def ended(point: dict[str, float]) -> bool:
    """Return whether an episode ended in this point's batch."""
    return point["return"] is not None and math.isfinite(point["return"])
