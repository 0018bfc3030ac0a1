"""From a prior over physics to a policy trained where the real robot plausibly is.

    python recipes/sim2real_ppo.py task=cartpole

A surrogate robot has parameters that only the final score may see. Three rounds: the robot runs
the policy; a posterior over its parameters is inferred from those episodes; PPO goes on under that
posterior. The same PPO under the prior, with as many frames, is the baseline. Writes result.json,
pictures, learning curves, a film where rendering is possible, and a checkpoint; ``resume=FOLDER``
goes on after a break.
``collector=ray`` simulates the loop on Ray, by default in two workers on this machine.
"""

from __future__ import annotations

import dataclasses
import math
import shutil
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import recipe
from collectors import collectors
from intervals import of_mean
from rounds import Journal, compare, describe, draw_pictures, sentence, shown
from scoring import Score
from tasks import TASKS, Task, true_parameters
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.record.loggers import get_logger
from video import record
from workers import workers

from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.errors import message
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.influence import without_influence
from torchrl_bayessim.loop import SimToRealLoop, ended_return
from torchrl_bayessim.randomness import isolated
from torchrl_bayessim.ray_collectors import RayCollectors
from torchrl_bayessim.robots import SurrogateRobot
from torchrl_bayessim.sources import Grid
from torchrl_bayessim.summaries import SummaryStatistics
from torchrl_bayessim.transforms import DomainRandomizer

LOGGERS = ("csv", "tensorboard", "wandb", "mlflow")


@dataclass
class Sim2Real(recipe.Settings):
    """Settings; ``key=value`` on the command line overrides them."""

    task: str = "cartpole"
    truth: str = "nominal"  # or "random": drawn from the prior by the seed
    rounds: int = 3
    episodes: int = 4  # real episodes per round
    simulations: int = 1024  # pairs per round
    updates: int = 0  # PPO updates per round; 0 for the task's own number
    baseline: bool = True  # also train under the prior, with as many frames
    collector: str = "direct"  # or "ray": the loop simulates in Ray's workers
    workers: int = 2  # of Ray
    video: bool = True
    short: bool = False  # a smoke test: everything runs, little is learned
    logger: str = "csv"  # or tensorboard, wandb, mlflow
    resume: str = ""  # folder of a run that was broken off


def job(settings: Sim2Real, out: Path) -> dict[str, Any]:
    """Run the loop and its baseline, score both at the robot, and draw the pictures."""
    task = chosen(settings)
    if settings.short:
        settings.simulations = min(settings.simulations, 192)
        settings.updates = settings.updates or 2
    truth = true_parameters(task, settings.truth, seed=settings.seed)
    count = 16 if settings.short else 100
    score = Score(task, Grid(truth[None]), episodes=count, seed=1_000_003)
    check_logger(settings.logger)
    shutil.rmtree(out / "log", ignore_errors=True)  # of a broken run, which is logged again
    logger = get_logger(settings.logger, logger_name=str(out), experiment_name="log")

    loop, learner, there = make_loop(task, truth, settings, out)
    resumed = loop.resume() if settings.resume else False
    names = task.prior.names
    done = Journal(out / "rounds.json", resume=resumed, logger=logger, names=names)
    print(f"{settings.task}: {task.prior}")
    for name in idle(task):
        print(f"note: {name} changes nothing that is observed, so no data can tell it")
    planned = loop.planned_frames
    with there or nullcontext(), Baseline(settings, frames=planned) as baseline:
        for turn in loop:
            earned = of_mean(score(learner.policy))
            done.add(turn.index, describe(turn, task, truth, real=earned))
            said = f"the robot earns {shown(*earned)}"
            print(sentence(turn, task, done.rounds[-1], said=said))
        result: dict[str, Any] = {
            "task": settings.task,
            "parameters": list(task.prior.names),
            "true": truth.tolist(),
            "rounds": [{k: v for k, v in entry.items() if k != "curve"} for entry in done.rounds],
            "checkpoint": "checkpoint.pt",
        }
        if settings.video:
            film = out / "posterior.gif"
            result["video"] = record(task, learner.policy, truth, film)
        curves = {"posterior": [point for entry in done.rounds for point in entry["curve"]]}
        if settings.baseline:
            returns = score(learner.policy)
            weights, curves["prior"] = baseline.result()
            learner.policy.load_state_dict(weights)
            baseline_returns = score(learner.policy)
            earned = of_mean(baseline_returns)
            result |= compare(returns, baseline_returns, real=earned)
            print(f"prior only: the robot earns {shown(*earned)} after as many frames")
    posterior = loop.refinement.posterior
    assert posterior is not None  # every round refines it
    draw_pictures(out, task, posterior, result=result, curves=curves, score="return")
    print(f"Pictures and numbers are in {out}")
    return result


def check_logger(name: str) -> None:
    """Refuse a logger that there is not, or whose package is not installed."""
    if name not in LOGGERS:
        raise ValueError(message("a logger", name, available=LOGGERS))
    if name != "csv" and find_spec(name) is None:
        expected = f"the package of logger={name} to be installed"
        raise ValueError(message(expected, "none", hint=f"pip install {name}"))


def chosen(settings: Sim2Real) -> Task:
    """Return the task, with less work for PPO if the run is to be short."""
    if settings.task not in TASKS:
        raise ValueError(message("a task", settings.task, available=TASKS))
    task = TASKS[settings.task]
    if settings.short:
        ppo = {**task.ppo, "epochs": 2, "minibatch_size": 1024}
        task = dataclasses.replace(task, shared_batches=1, ppo=ppo)
    return task


def make_loop(
    task: Task, truth: Tensor, settings: Sim2Real, out: Path
) -> tuple[SimToRealLoop, PPO, RayCollectors | None]:
    """Return the loop, its learner, and where it simulates if not here."""
    randomizer = DomainRandomizer(task.prior, seed=settings.seed)
    env = task.make(task.environments, seed=settings.seed, randomizer=randomizer)
    robot_env = task.make(settings.episodes, seed=settings.seed, randomizer=None)
    learner = PPO(env, seed=settings.seed, **task.ppo)
    place = {"seed": settings.seed, "workers": settings.workers}
    there = collectors(settings.collector, task, learner.policy, **place)
    loop = SimToRealLoop(
        env,
        learner,
        SurrogateRobot(robot_env, truth, max_steps=task.horizon),
        refinement=PosteriorRefinement(
            task.prior,
            simulations=settings.simulations,
            seed=settings.seed,
            fit_options={"progress": settings.progress},
        ),
        statistics=SummaryStatistics(*task.summaries),
        randomizer=randomizer,
        horizon=task.horizon,
        episodes=settings.episodes,
        updates=settings.updates or task.updates,
        shared_batches=task.shared_batches,
        rounds=settings.rounds,
        seed=settings.seed,
        checkpoint_file=out / "checkpoint.pt",
        collectors=there,
        progress=settings.progress,
    )
    return loop, learner, there


def idle(task: Task) -> tuple[str, ...]:
    """Return the parameters that change nothing in the simulator: their posterior is the prior."""
    randomizer = DomainRandomizer(task.prior)
    env = task.make(4, seed=0, randomizer=randomizer)
    return without_influence(env, randomizer, task.prior, steps=min(100, task.horizon))


class Baseline:
    """The same PPO under the prior, with as many frames, in a process beside the loop."""

    def __init__(self, settings: Sim2Real, *, frames: int) -> None:
        self.pool = workers(1, threads=settings.threads)
        if settings.baseline:
            self.future = self.pool.submit(train_under_prior, settings, frames=frames)

    def __enter__(self) -> Baseline:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:  # nobody will ask for the result
            for process in active_children():
                process.terminate()
        self.pool.shutdown(cancel_futures=True)

    def result(self) -> tuple[dict[str, Tensor], list[dict[str, float]]]:
        """Return the policy's weights and the learning curve."""
        return self.future.result()


def train_under_prior(
    settings: Sim2Real, *, frames: int
) -> tuple[dict[str, Tensor], list[dict[str, float]]]:
    """Return the weights of a policy learned under the prior, and its learning curve."""
    task = chosen(settings)
    env = task.make(task.environments, seed=settings.seed, randomizer=DomainRandomizer(task.prior))
    learner = PPO(env, seed=settings.seed, **task.ppo)
    batch_frames = task.environments * task.horizon
    collector = Collector(
        env,
        learner.policy,
        frames_per_batch=batch_frames,
        total_frames=frames,
        auto_register_policy_transforms=False,
    )
    curve: list[dict[str, float]] = []
    updates = math.ceil(frames / batch_frames)
    for update in range(updates):
        with isolated(settings.seed, "prior", update):
            batch: Any = collector.next()
        reported = learner.update(batch, key=("prior", update), progress=update / updates)
        frames_so_far = (update + 1.0) * batch_frames
        curve.append({"frames": frames_so_far, "return": ended_return(batch), **reported})
    collector.shutdown()
    return dict(learner.policy.state_dict()), curve


if __name__ == "__main__":
    recipe.main(Sim2Real, job)
