"""From a prior over physics to a policy trained where the real robot plausibly is.

    python recipes/sim2real_ppo.py task=cartpole

A surrogate robot has parameters that only the final score may see. Three rounds: the robot runs
the policy; a posterior over its parameters is inferred from those episodes; PPO goes on under that
posterior. The same PPO under the prior, with as many frames, is the baseline. Writes result.json,
pictures, learning curves and a checkpoint; ``resume=FOLDER`` goes on after a break.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import threading
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import Any

import recipe
import torch
from tasks import TASKS, Task, true_parameters
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.record.loggers import get_logger

from torchrl_bayessim import plots
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.errors import message
from torchrl_bayessim.evaluation import evaluate
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.loop import Round, SimToRealLoop, ended_return
from torchrl_bayessim.randomness import isolated
from torchrl_bayessim.robots import SurrogateRobot
from torchrl_bayessim.sources import Grid, draw
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
    short: bool = False  # a smoke test: everything runs, little is learned
    logger: str = "csv"  # or tensorboard, wandb, mlflow
    resume: str = ""  # folder of a run that was broken off


def job(settings: Sim2Real, out: Path) -> dict[str, Any]:
    """Run the loop and its baseline, score both at the robot, and draw the pictures."""
    torch.set_num_threads(1)  # batches are small: a second thread only costs
    task = chosen(settings)
    if settings.short:
        settings.simulations, settings.updates = min(settings.simulations, 192), 2
    truth = true_parameters(task, settings.truth, seed=settings.seed)
    score = Score(task, truth, episodes=16 if settings.short else 100)
    if settings.logger not in LOGGERS:
        raise ValueError(message("a logger", settings.logger, available=LOGGERS))
    logger = get_logger(settings.logger, logger_name=str(out), experiment_name="log")

    loop, learner = make_loop(task, truth, settings, out)
    done = Journal(out / "rounds.json", resume=loop.resume() if settings.resume else False)
    print(f"{settings.task}: {task.prior}")
    with Baseline(settings, frames=loop.planned_frames) as baseline:
        for turn in loop:
            done.add(turn.index, describe(turn, task, truth, score(learner.policy)))
            for entry in turn.curve:
                for name, value in entry.items():
                    logger.log_scalar(f"train/{name}", value, step=int(entry["frames"]))
            print(sentence(turn, task, done.rounds[-1]))
        result: dict[str, Any] = {
            "task": settings.task,
            "parameters": list(task.prior.names),
            "true": truth.tolist(),
            "rounds": [{k: v for k, v in entry.items() if k != "curve"} for entry in done.rounds],
            "checkpoint": out / "checkpoint.pt",
        }
        curves = {"posterior": [point for entry in done.rounds for point in entry["curve"]]}
        if settings.baseline:
            returns = score(learner.policy)
            weights, curves["prior"] = baseline.result()
            learner.policy.load_state_dict(weights)
            result |= compare(returns, score(learner.policy))
    posterior = loop.refinement.posterior
    assert posterior is not None  # every round refines it
    draw_pictures(out, task, posterior, result=result, curves=curves)
    print(f"Pictures and numbers are in {out}")
    return result


def chosen(settings: Sim2Real) -> Task:
    """Return the task, with less work for PPO if the run is to be short."""
    if settings.task not in TASKS:
        raise ValueError(message("a task", settings.task, available=TASKS))
    task = TASKS[settings.task]
    if settings.short:
        ppo = {**task.ppo, "epochs": 2, "minibatch_size": 1024}
        task = dataclasses.replace(task, shared_batches=1, ppo=ppo)
    return task


def compare(returns: Tensor, baseline: Tensor) -> dict[str, Any]:
    """Return the baseline's entries of result.json; episodes are paired by their initial state."""
    mean, interval = confidence(baseline)
    gain, gain_interval = confidence(returns - baseline)
    print(f"prior only: the robot earns {mean:.1f} {shown(interval)} after as many frames")
    return {
        "baseline": {"source": "prior", "real_return": mean, "real_return_ci": interval},
        "gain": {"real_return": gain, "real_return_ci": gain_interval},
    }


def make_loop(
    task: Task, truth: Tensor, settings: Sim2Real, out: Path
) -> tuple[SimToRealLoop, PPO]:
    """Return the loop and its learner."""
    randomizer = DomainRandomizer(task.prior, seed=settings.seed)
    env = task.make(task.environments, seed=settings.seed, randomizer=randomizer)
    robot_env = task.make(settings.episodes, seed=settings.seed, randomizer=None)
    learner = PPO(env, seed=settings.seed, **task.ppo)
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
        progress=settings.progress,
    )
    return loop, learner


class Score:
    """Returns at the robot; the only code that may see its parameters.

    The same initial states every time, so that two policies are compared in pairs.
    """

    def __init__(self, task: Task, truth: Tensor, *, episodes: int) -> None:
        self.max_steps = task.max_steps
        self.env = task.make(episodes, seed=0, randomizer=DomainRandomizer(Grid(truth[None])))

    def __call__(self, policy: Any) -> Tensor:
        """Return the return of every episode, shape ``(episodes,)``."""
        self.env.set_seed(1_000_003)
        with isolated("score"):
            return evaluate(self.env, policy, max_steps=self.max_steps)


class Journal:
    """What each round gave, kept beside the checkpoint so that a resumed run reports them all."""

    def __init__(self, path: Path, *, resume: bool) -> None:
        self.path = path
        resume = resume and path.exists()  # not before the end of the first round
        self.rounds: list[dict[str, Any]] = json.loads(path.read_text()) if resume else []

    def add(self, index: int, entry: dict[str, Any]) -> None:
        """Keep the entry of round ``index``, which may be told twice after a break."""
        self.rounds = [*self.rounds[:index], entry]
        recipe.write(self.path, json.dumps(recipe.plain(self.rounds)))


class Baseline:
    """The same PPO under the prior, with as many frames, in a process beside the loop."""

    def __init__(self, settings: Sim2Real, *, frames: int) -> None:
        spawn = get_context("spawn")
        self.pool = ProcessPoolExecutor(1, mp_context=spawn, initializer=end_with_parent)
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


def end_with_parent() -> None:
    """End this process when its parent does, also if that is killed."""
    parent = parent_process()
    assert parent is not None  # it was spawned

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def train_under_prior(
    settings: Sim2Real, *, frames: int
) -> tuple[dict[str, Tensor], list[dict[str, float]]]:
    """Return the weights of a policy learned under the prior, and its learning curve."""
    torch.set_num_threads(1)
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


def describe(turn: Round, task: Task, truth: Tensor, returns: Tensor) -> dict[str, Any]:
    """Return the round's entry of result.json."""
    posterior = turn.posterior
    log_prob = posterior.log_prob(truth).item()
    mean, interval = confidence(returns)
    trained = [point["return"] for point in turn.curve if math.isfinite(point["return"])]
    return {
        "round": turn.index + 1,
        "posterior_mean": posterior.mean.tolist(),
        "posterior_sd": posterior.stddev.tolist(),
        "log_prob_true": log_prob,
        "nats_over_prior": log_prob - task.prior.log_prob(truth).item(),
        "real_return": mean,
        "real_return_ci": interval,
        "sim_return": trained[-1] if trained else None,
        "frames": turn.frames,
        "simulations": turn.simulations,
        "seconds": turn.seconds,
        "curve": turn.curve,
    }


def confidence(values: Tensor) -> tuple[float, list[float]]:
    """Return mean and 95 % interval of the mean."""
    mean = values.mean().item()
    half = 1.96 * values.std().item() / math.sqrt(len(values))
    return mean, [mean - half, mean + half]


def shown(interval: list[float]) -> str:
    """Return an interval as text."""
    return f"[{interval[0]:.1f}, {interval[1]:.1f}]"


def sentence(turn: Round, task: Task, entry: dict[str, Any]) -> str:
    """Return the round in one line."""
    rows = zip(
        task.prior.names,
        entry["posterior_mean"],
        entry["posterior_sd"],
        task.prior.units,
        strict=True,
    )
    physics = ", ".join(f"{n} {m:.3g} ± {s:.2g} {u}".rstrip() for n, m, s, u in rows)
    return (
        f"round {turn.index + 1}: {physics} ({entry['nats_over_prior']:+.1f} nats over the prior); "
        f"the robot earns {entry['real_return']:.1f} {shown(entry['real_return_ci'])} "
        f"after {turn.frames:,} frames, {turn.seconds:.0f} s"
    )


def draw_pictures(
    out: Path,
    task: Task,
    posterior: PhysicsPosterior,
    *,
    result: dict[str, Any],
    curves: dict[str, list[dict[str, float]]],
) -> None:
    """Write posterior.png (also zoomed), learning.png and return.png."""
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
        figure.savefig(out / f"{name}.png", dpi=150)
    lines = {
        f"trained under the {name}": (
            torch.tensor([point["frames"] for point in curve if ended(point)]),
            torch.tensor([point["return"] for point in curve if ended(point)]),
        )
        for name, curve in curves.items()
        if any(ended(point) for point in curve)
    }
    if lines:
        figure = plots.learning_curves(lines, ylabel="return of finished episodes in simulation")
        figure.savefig(out / "learning.png", dpi=150)
    baseline = result.get("baseline", {})
    figure = plots.return_per_round(
        [entry["real_return"] for entry in result["rounds"]],
        [tuple(entry["real_return_ci"]) for entry in result["rounds"]],
        baseline=baseline.get("real_return"),
        baseline_interval=tuple(baseline["real_return_ci"]) if baseline else None,
    )
    figure.savefig(out / "return.png", dpi=150)


def ended(point: dict[str, float]) -> bool:
    """Return whether an episode ended in this point's batch."""
    return point["return"] is not None and math.isfinite(point["return"])


if __name__ == "__main__":
    recipe.main(Sim2Real, job)
