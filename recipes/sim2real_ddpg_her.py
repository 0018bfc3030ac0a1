"""Fetch with unknown friction: from a prior to a policy trained where the real table plausibly is.

    python recipes/sim2real_ddpg_her.py task=fetch_push

A policy trained under the prior collects data: a surrogate robot with a friction that only the
final score may see runs it for a few episodes. A posterior over the friction is inferred from them,
and DDPG with hindsight replay goes on under that posterior, with a new friction in every episode;
then all again. The same training under the prior, with as many frames, is the baseline.
``algorithm=td3`` trains TD3 instead, ``preset=paper`` has the original budget and settings
(1,000,000 frames, hours), ``preset=wide`` larger networks and more updates for Push. Writes
result.json, pictures, a video where rendering is possible, and checkpoints; ``resume=FOLDER`` goes
on after a break.
"""

from __future__ import annotations

import logging
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import recipe
from collectors import collectors
from fetch_tasks import FETCH, MEASURED, GoalTask, as_preset, with_learner
from intervals import share
from rounds import Journal, compare, describe, draw_pictures, sentence, shown
from scoring import Score
from tasks import true_parameters
from torch import Tensor
from training import Plan, Trained, train
from video import record

from torchrl_bayessim import checkpoint
from torchrl_bayessim.agents.ddpg import DDPG
from torchrl_bayessim.counts import check_count
from torchrl_bayessim.errors import message
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.influence import check_influence
from torchrl_bayessim.loop import SimToRealLoop
from torchrl_bayessim.randomness import seed_from
from torchrl_bayessim.robots import SurrogateRobot
from torchrl_bayessim.sources import Grid
from torchrl_bayessim.summaries import SummaryStatistics
from torchrl_bayessim.transforms import DomainRandomizer


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
    critic_sees_physics: bool | None = None  # None for the task's own
    preset: str = "fast"  # or "wide", or "paper"
    baseline: bool = True  # also go on under the prior, with as many frames
    collector: str = "direct"  # or "ray": the loop simulates in Ray's workers
    workers: int = 2  # of Ray
    video: bool = True
    short: bool = False  # a smoke test: everything runs, little is learned
    resume: str = ""  # folder of a run that was broken off


def job(settings: Sim2RealFetch, out: Path) -> dict[str, Any]:
    """Train the collecting policy, run the loop and its baseline, score them, draw pictures."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    task = chosen(settings)
    truth = true_parameters(task, settings.truth, seed=settings.seed)
    count = 16 if settings.short else 256
    score = Score(task, Grid(truth[None]), episodes=count, seed=1_000_003)
    under_prior = Score(task, task.prior, episodes=count, seed=1_000_033)
    run = Run(task, truth, settings, out)
    print(f"{settings.task}: {run.learner.name}, {task.prior}")
    resumed = run.loop.resume() if settings.resume else False
    if not resumed:  # otherwise the loop's checkpoint goes on from it
        run.hand_over()
    with run.collectors or nullcontext():
        rounds = run.rounds(score, Journal(out / "rounds.json", resume=resumed))
    posterior = run.loop.refinement.posterior
    assert posterior is not None  # every round refines it
    after = score(run.learner.policy)
    result: dict[str, Any] = {
        "task": settings.task,
        "algorithm": run.learner.name,
        "parameters": list(task.prior.names),
        "true": truth.tolist(),
        "rounds": [{k: v for k, v in entry.items() if k != "curve"} for entry in rounds],
        "collecting_frames": run.collecting_frames,
        "success_under_prior": {"posterior": report(under_prior(run.learner.policy))},
        "checkpoint": "checkpoint.pt",
    }
    curves = {"posterior": [point for entry in rounds for point in entry["curve"]]}
    if settings.video:
        film = out / "posterior.gif"
        episodes = 1 if settings.short else 0
        result["video"] = record(task, run.learner.policy, truth, film, episodes=episodes)
    if settings.baseline:
        curves["prior"] = run.go_on_under_prior().curve
        baseline = score(run.learner.policy)
        result |= compare(after, baseline, real=share(baseline))
        result["success_under_prior"]["prior"] = report(under_prior(run.learner.policy))
        told = shown(*share(baseline), digits=2)
        print(f"prior only: {told} of goals reached after as many frames")
    draw_pictures(out, task, posterior, result=result, curves=run.joined(curves), score="success")
    print(f"Pictures and numbers are in {out}")
    return result


def chosen(settings: Sim2RealFetch) -> GoalTask:
    """Return the task as the settings have it."""
    if settings.task not in FETCH:
        raise ValueError(message("a task", settings.task, available=FETCH))
    for name in ("warmup", "updates"):
        check_count(f"batches, {name}=", getattr(settings, name), least=0)
    for name in ("rounds", "episodes", "simulations"):
        check_count(f"{name}=", getattr(settings, name))
    task = as_preset(FETCH[settings.task], settings.preset, rounds=settings.rounds)
    warmup, updates = settings.warmup or task.warmup, settings.updates or task.updates
    if settings.short:
        settings.simulations, settings.episodes = min(settings.simulations, 48), 2
        warmup, updates = settings.warmup or 2, settings.updates or 2
        task = replace(task, environments=8, shared_batches=1)
    task = with_learner(
        task,
        algorithm=settings.algorithm,
        critic_sees_physics=settings.critic_sees_physics,
        short=settings.short,
    )
    return replace(task, warmup=warmup, updates=updates)


class Run:
    """The learner, its environments, and what it is trained for in turn."""

    def __init__(self, task: GoalTask, truth: Tensor, settings: Sim2RealFetch, out: Path) -> None:
        seed = settings.seed
        self.task, self.truth, self.settings, self.out = task, truth, settings, out
        self.collecting_frames = task.warmup * task.environments * task.horizon
        self.randomizer = DomainRandomizer(task.prior, seed=seed)
        self.env = task.make(task.environments, seed=seed, randomizer=self.randomizer)
        check_influence(self.env, self.randomizer, task.prior, steps=task.max_steps)
        self.learner: DDPG = task.learner(self.env, seed=seed)
        robot_env = task.make(settings.episodes, seed=seed, randomizer=None)
        place = {"seed": seed, "workers": settings.workers}
        self.collectors = collectors(settings.collector, task, self.learner.policy, **place)
        epochs = 20 if settings.short else 150
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
            collectors=self.collectors,
            progress=settings.progress,
        )

    def hand_over(self) -> None:
        """Train the data-collecting policy, from which the loop goes on, and forget its episodes.

        They ran under the prior: kept, they would be half of what is replayed until the end, and
        the critic would value actions under their physics too. What the policy simulates for
        inference, before it learns anew, is then the first in the replay buffer; going on from no
        more than that is enough (Zhou et al. 2024, https://arxiv.org/abs/2412.07762).
        """
        self.collect()
        self.learner.buffer.empty()

    def rounds(self, score: Score, journal: Journal) -> list[dict[str, Any]]:
        """Go through the rounds that are left; return the entries of all."""
        for turn in self.loop:
            real = share(score(self.learner.policy))
            journal.add(turn.index, describe(turn, self.task, self.truth, real=real))
            said = f"the robot reaches {shown(*real, digits=2)} of its goals"
            print(sentence(turn, self.task, journal.rounds[-1], said=said))
        return journal.rounds

    def collect(self) -> Trained:
        """Train the data-collecting policy under the prior; all else starts from it."""
        return self._train("collecting", self.task.warmup, decays=False)

    def joined(self, curves: dict[str, list[Any]]) -> dict[str, list[Any]]:
        """Return the learning curves after that of the policy from which they start."""
        first = checkpoint.load(self.out / "collecting.pt")["curve"]
        before = self.collecting_frames
        later = {
            name: [{**point, "frames": before + point["frames"]} for point in curve]
            for name, curve in curves.items()
        }
        return {**later, "prior, collecting": first}

    def go_on_under_prior(self) -> Trained:
        """Train the collecting policy under the prior for as many frames as the loop did.

        Its episodes stay in the replay buffer: they are of the same prior.
        """
        self.collect()  # which is in its checkpoint
        frames = self.loop.planned_frames
        batches = frames // (self.task.environments * self.task.horizon)
        return self._train("prior", batches, decays=True)

    def _train(self, name: str, batches: int, *, decays: bool) -> Trained:
        self.randomizer.source = self.task.prior
        plan = Plan(
            batches,
            self.task.horizon,
            decays=decays,
            file=self.out / f"{name}.pt",
            keep_every=50,
            score_every=max(20, batches // 25),  # for the picture only
        )
        select = Score(self.task, self.task.prior, episodes=64, seed=seed_from(name) % 2**31)
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
    """Return the same as an entry of result.json."""
    mean, interval = share(reached)
    return {"mean": mean, "ci": interval, "episodes": len(reached)}


if __name__ == "__main__":
    recipe.main(Sim2RealFetch, job)
