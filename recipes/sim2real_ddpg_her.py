"""Fetch with unknown friction: from a prior to a policy trained where the real table plausibly is.

    python recipes/sim2real_ddpg_her.py task=fetch_push

A policy trained under the prior collects data: a surrogate robot with a friction that only the
final score may see runs it for a few episodes. A posterior over the friction is inferred from them,
and DDPG with hindsight replay goes on under that posterior, with a new friction in every episode;
then all again. The same training under the prior, with as many frames, is the baseline.
``algorithm=td3`` trains TD3 instead, ``preset=paper`` has the original budget and settings
(1,000,000 frames, hours). Writes result.json, pictures, a video where rendering is possible, and
checkpoints; ``resume=FOLDER`` goes on after a break.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import recipe
import torch
from fetch_tasks import FETCH, MEASURED, GoalTask, paper
from scipy.stats import binomtest
from sim2real_ppo import Journal, confidence
from tasks import true_parameters
from torch import Tensor
from training import Plan, Trained, scored, single_thread, train
from video import record

from torchrl_bayessim import plots
from torchrl_bayessim.agents.ddpg import DDPG
from torchrl_bayessim.errors import message
from torchrl_bayessim.evaluation import successes
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.influence import check_influence
from torchrl_bayessim.loop import Round, SimToRealLoop
from torchrl_bayessim.randomness import isolated, seed_from
from torchrl_bayessim.robots import SurrogateRobot
from torchrl_bayessim.sources import Grid, draw
from torchrl_bayessim.summaries import SummaryStatistics
from torchrl_bayessim.transforms import DomainRandomizer

PRESETS = ("fast", "paper")


@dataclass
class Sim2RealFetch(recipe.Settings):
    """Settings; ``key=value`` on the command line overrides them."""

    task: str = "fetch_push"
    truth: str = "nominal"  # or "random": drawn from the prior by the seed
    rounds: int = 2
    episodes: int = 4  # real episodes per round
    simulations: int = 256  # pairs per round
    warmup: int = 0  # batches for the data-collecting policy; 0 for the task's own number
    updates: int = 0  # batches per round under the posterior; 0 for the task's own number
    algorithm: str = ""  # ddpg or td3; empty for the task's own
    critic_sees_physics: bool = False
    preset: str = "fast"  # or "paper"
    baseline: bool = True  # also go on under the prior, with as many frames
    video: bool = True
    short: bool = False  # a smoke test: everything runs, little is learned
    resume: str = ""  # folder of a run that was broken off


def job(settings: Sim2RealFetch, out: Path) -> dict[str, Any]:
    """Train the collecting policy, run the loop and its baseline, score them, draw pictures."""
    single_thread()
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    task = chosen(settings)
    truth = true_parameters(task, settings.truth, seed=settings.seed)
    count = 16 if settings.short else 256
    score = GoalScore(task, Grid(truth[None]), episodes=count, seed=1_000_003)
    under_prior = GoalScore(task, task.prior, episodes=count, seed=1_000_033)
    run = Run(task, truth, settings, out)
    print(f"{settings.task}: {run.learner.name}, {task.prior}")
    resumed = run.loop.resume() if settings.resume else False
    collecting = None if resumed else run.collect()  # the loop's checkpoint goes on from it
    journal = Journal(out / "rounds.json", resume=resumed)
    for turn in run.loop:
        reached = score(run.learner.policy)
        journal.add(turn.index, describe(turn, task, truth, reached))
        print(sentence(turn, task, journal.rounds[-1]))
    after = {"posterior": score(run.learner.policy)}
    result: dict[str, Any] = {
        "task": settings.task,
        "algorithm": run.learner.name,
        "parameters": list(task.prior.names),
        "true": truth.tolist(),
        "rounds": [{k: v for k, v in entry.items() if k != "curve"} for entry in journal.rounds],
        "collecting_frames": task.warmup * task.environments * task.horizon,
        "success_under_prior": {"posterior": report(under_prior(run.learner.policy))},
        "checkpoint": out / "checkpoint.pt",
    }
    curves = {"posterior": [point for entry in journal.rounds for point in entry["curve"]]}
    posterior = run.loop.refinement.posterior
    if settings.video:
        result["video"] = record(task, run.learner.policy, truth, out / "posterior.gif")
    if settings.baseline:
        curves["prior"] = run.go_on_under_prior().curve
        after["prior"] = score(run.learner.policy)
        result |= compare(after["posterior"], after["prior"])
        result["success_under_prior"]["prior"] = report(under_prior(run.learner.policy))
    assert posterior is not None  # every round refines it
    if collecting is not None:
        curves["collecting"] = collecting.curve
    draw_pictures(out, task, posterior, result=result, curves=curves)
    print(f"Pictures and numbers are in {out}")
    return result


def chosen(settings: Sim2RealFetch) -> GoalTask:
    """Return the task as the settings have it."""
    if settings.task not in FETCH:
        raise ValueError(message("a task", settings.task, available=FETCH))
    if settings.preset not in PRESETS:
        raise ValueError(message("a preset", settings.preset, available=PRESETS))
    task = FETCH[settings.task]
    if settings.preset == "paper":
        task = paper(task, settings.rounds)
    ddpg = dict(task.ddpg)
    if settings.algorithm:
        ddpg["algorithm"] = settings.algorithm
    if settings.critic_sees_physics:
        ddpg["critic_keys"] = ("theta",)
    warmup, updates = settings.warmup or task.warmup, settings.updates or task.updates
    if settings.short:
        settings.simulations, settings.episodes = min(settings.simulations, 48), 2
        warmup, updates = 2, 2
        ddpg |= {"hidden": (32, 32), "batch_size": 64, "updates_per_frame": 0.02}
        task = replace(task, environments=8, shared_batches=1)
    return replace(task, warmup=warmup, updates=updates, ddpg=ddpg)


class GoalScore:
    """Successes under given physics, in the same episodes every time.

    Args:
        task: The task.
        source: Physics of the episodes.
        episodes: Their number; each is an environment of its own.
        seed: Other than that of training, and of other scores.
    """

    def __init__(self, task: GoalTask, source: Any, *, episodes: int, seed: int) -> None:
        self.max_steps, self.seed = task.max_steps, seed
        self.randomizer = DomainRandomizer(source, seed=seed)
        self.begun = self.randomizer.get_extra_state()
        self.env = task.make(episodes, seed=seed, randomizer=self.randomizer)

    def __call__(self, policy: Any) -> Tensor:
        """Return whether each goal was reached, shape ``(episodes,)``."""
        self.env.set_seed(self.seed)
        self.randomizer.set_extra_state(dict(self.begun))
        with isolated("score"):
            return successes(self.env, policy, max_steps=self.max_steps).float()


class Run:
    """The learner, its environments, and what it is trained for in turn."""

    def __init__(self, task: GoalTask, truth: Tensor, settings: Sim2RealFetch, out: Path) -> None:
        seed = settings.seed
        self.task, self.settings, self.out = task, settings, out
        self.randomizer = DomainRandomizer(task.prior, seed=seed)
        self.env = task.make(task.environments, seed=seed, randomizer=self.randomizer)
        check_influence(self.env, self.randomizer, task.prior, steps=task.max_steps)
        self.learner: DDPG = task.learner(self.env, seed=seed)
        robot_env = task.make(settings.episodes, seed=seed, randomizer=None)
        epochs = 40 if settings.short else 300
        self.loop = SimToRealLoop(
            self.env,
            self.learner,
            SurrogateRobot(robot_env, truth, max_steps=task.horizon, measured=MEASURED),
            refinement=PosteriorRefinement(
                task.prior,
                simulations=settings.simulations,
                seed=seed,
                fit_options={"progress": settings.progress, "epochs": epochs},
            ),
            statistics=SummaryStatistics(*task.summaries),
            randomizer=self.randomizer,
            horizon=task.horizon,
            episodes=settings.episodes,
            updates=task.updates,
            shared_batches=task.shared_batches,
            rounds=settings.rounds,
            seed=seed,
            checkpoint_file=out / "checkpoint.pt",
            checkpoint_every=40,
            progress=settings.progress,
        )

    def collect(self) -> Trained:
        """Train the data-collecting policy under the prior; all else starts from it."""
        return self._train("collecting", self.task.warmup, decays=False)

    def go_on_under_prior(self) -> Trained:
        """Train the collecting policy under the prior for as many frames as the loop did."""
        self.collect()  # which is in its checkpoint
        frames = self.loop.planned_frames
        batches = frames // (self.task.environments * self.task.horizon)
        return self._train("prior", batches, decays=True)

    def _train(self, name: str, batches: int, *, decays: bool) -> Trained:
        self.randomizer.source = self.task.prior
        plan = Plan(
            batches, self.task.horizon, decays=decays, file=self.out / f"{name}.pt", keep_every=50
        )
        select = GoalScore(self.task, self.task.prior, episodes=64, seed=seed_from(name) % 2**31)
        return train(
            self.learner,
            self.env,
            self.randomizer,
            plan,
            key=(self.settings.seed, name),
            score=None if self.settings.short else lambda policy: select(policy).mean().item(),
            label=f"{name} policy",
            progress=self.settings.progress,
        )


def report(reached: Tensor) -> dict[str, Any]:
    """Return the share of successes with its 95 % interval (Wilson 1927)."""
    found = binomtest(int(reached.sum()), len(reached))
    low, high = found.proportion_ci(method="wilson")
    return {"mean": reached.mean().item(), "ci": [low, high], "episodes": len(reached)}


def compare(posterior: Tensor, prior: Tensor) -> dict[str, Any]:
    """Return the baseline's entries of result.json; episodes are paired by their start and goal."""
    found = report(prior)
    gain, gain_interval = confidence(posterior - prior)
    mean, interval = found["mean"], found["ci"]
    print(f"prior only: {mean:.2f} {shown(interval)} of goals reached after as many frames")
    return {
        "baseline": {"source": "prior", "real_return": mean, "real_return_ci": interval},
        "gain": {"real_return": gain, "real_return_ci": gain_interval},
    }


def shown(interval: list[float]) -> str:
    """Return an interval of shares as text."""
    return f"[{interval[0]:.2f}, {interval[1]:.2f}]"


def describe(turn: Round, task: GoalTask, truth: Tensor, reached: Tensor) -> dict[str, Any]:
    """Return the round's entry of result.json; ``real_return`` is the share of goals reached."""
    log_prob = turn.posterior.log_prob(truth).item()
    found = report(reached)
    trained = [point["return"] for point in turn.curve]
    return {
        "round": turn.index + 1,
        "posterior_mean": turn.posterior.mean.tolist(),
        "posterior_sd": turn.posterior.stddev.tolist(),
        "log_prob_true": log_prob,
        "nats_over_prior": log_prob - task.prior.log_prob(truth).item(),
        "real_return": found["mean"],
        "real_return_ci": found["ci"],
        "sim_return": trained[-1] if trained else None,
        "frames": turn.frames,
        "simulations": turn.simulations,
        "seconds": turn.seconds,
        "curve": turn.curve,
    }


def sentence(turn: Round, task: GoalTask, entry: dict[str, Any]) -> str:
    """Return the round in one line."""
    name, unit = task.prior.names[0], task.prior.units[0]
    mean, sd = entry["posterior_mean"][0], entry["posterior_sd"][0]
    return (
        f"round {turn.index + 1}: {name} {mean:.3g} ± {sd:.2g} {unit}".rstrip()
        + f" ({entry['nats_over_prior']:+.1f} nats over the prior); the robot reaches "
        f"{entry['real_return']:.2f} {shown(entry['real_return_ci'])} of its goals after "
        f"{turn.frames:,} frames, {turn.seconds:.0f} s"
    )


def draw_pictures(
    out: Path,
    task: GoalTask,
    posterior: Any,
    *,
    result: dict[str, Any],
    curves: dict[str, list[dict[str, float]]],
) -> None:
    """Write posterior.png, learning.png and return.png."""
    figure = plots.pair_plot(
        draw(posterior, 4000, key=("picture",)),
        names=task.prior.names,
        units=task.prior.units,
        prior_samples=draw(task.prior, 4000, key=("picture", "prior")),
        truth=torch.tensor(result["true"]),
    )
    figure.savefig(out / "posterior.png", dpi=150)
    lines = {
        f"{name} policy": (
            torch.tensor([point["frames"] for point in scored(curve)]),
            torch.tensor([point["score"] for point in scored(curve)]),
        )
        for name, curve in curves.items()
        if scored(curve)
    }
    if lines:
        figure = plots.learning_curves(lines, ylabel="success under the prior, 64 episodes")
        figure.savefig(out / "learning.png", dpi=150)
    baseline = result.get("baseline", {})
    figure = plots.return_per_round(
        [entry["real_return"] for entry in result["rounds"]],
        [tuple(entry["real_return_ci"]) for entry in result["rounds"]],
        baseline=baseline.get("real_return"),
        baseline_interval=tuple(baseline["real_return_ci"]) if baseline else None,
        ylabel="success at the real system",
    )
    figure.savefig(out / "return.png", dpi=150)


if __name__ == "__main__":
    recipe.main(Sim2RealFetch, job)
