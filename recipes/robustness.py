"""What a policy is worth when the physics are others: nominal, prior, posterior, oracle.

    python recipes/robustness.py task=cartpole
    python recipes/robustness.py task=fetch_push out=recipes/results/robustness_fetch_push

One policy per seed and source of physics, each with as many frames of training: the simulator's
nominal physics, the prior, the posterior, and the robot's true physics (oracle). The posterior is
inferred from a few episodes of the seed's own prior policy at the robot; what is simulated for that
comes on top, and is told. All policies are then scored in
the same episodes: over a grid of each parameter with the others at the truth, at the robot, and
under physics drawn from the prior. Posterior and prior are compared in pairs: one difference per
seed, with its Student interval. Episodes by which a checkpoint is chosen are others.

CartPole's PPO has two presets: ``paper``, with the settings of rl-zoo, which the paper cites, and
100 domains drawn once, as the paper has them, but rl-zoo's 100,000 frames and not the paper's two
million; and ``strong``, of a longer view, with a new domain in every episode. DDPG's on Fetch are
``fast``, ``wide``, larger networks and more updates for Push, as older results have it, and
``paper``, the original budget. Writes result.json, table.md and a picture per parameter, and films
the first seed's policies; ``resume=FOLDER`` goes on, also with other ``seed=``, ``seeds=`` or
``sources=``: seeds that ran side by side, each with ``seeds=1`` in the one folder, become one
figure so.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import recipe
import torch
from fetch_tasks import FETCH, PRESETS, GoalTask, as_preset, with_learner
from robustness_report import compared, curves, draw_pictures, table
from robustness_study import Study, nominal
from tasks import TASKS, Task
from torch import Tensor
from tqdm.auto import tqdm

from torchrl_bayessim.counts import check_count
from torchrl_bayessim.errors import message
from torchrl_bayessim.kinds import check_choice
from torchrl_bayessim.whole_file import write_text

SOURCES = ("nominal", "prior", "posterior", "oracle")
# "paper": PPO as rl-zoo sets CartPole, which the paper cites, but for a constant clip range;
# "strong": a longer view and larger batches, under which the prior policy solved the box in trials.
PPO_PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "environments": 8,
        "horizon": 32,
        "budget": 400,
        "domains": 100,
        "ppo": {"gamma": 0.98, "gae_lambda": 0.8, "minibatch_size": 256, "epochs": 20},
    },
    "strong": {
        "environments": 32,
        "horizon": 128,
        "budget": 100,
        "domains": 0,
        "ppo": {"gamma": 0.99, "gae_lambda": 0.95, "minibatch_size": 512, "epochs": 10},
    },
}

COUNTS = {
    "seeds": 0,
    "domains": -1,
    "batches": 0,  # 0 for the task's own
    "episodes": 1,
    "simulations": 8,
    "refinements": 0,
    "points": 1,
    "grid_episodes": 1,
    "real_episodes": 1,
}


@dataclass
class Robustness(recipe.Settings):
    """Settings; ``key=value`` on the command line overrides them."""

    free: ClassVar = (*recipe.Settings.free, "seed", "seeds", "sources")

    task: str = "cartpole"
    sources: str = "nominal,prior,posterior,oracle"
    seeds: int = 0  # policies per source; 0 for 5 (CartPole) or 3 (Fetch)
    batches: int = 0  # of training per policy; 0 for the task's own number
    preset: str = ""  # paper or strong (CartPole), fast, wide or paper (Fetch); or the first
    truth: str = ""  # the robot's parameters, such as 0.3 or 0.5,0.1; empty for the task's own
    domains: int = -1  # drawn once, and trained under; 0 for new ones always, -1 for the preset's
    algorithm: str = ""  # ddpg or td3; empty for the task's own
    critic_sees_physics: bool | None = None  # of Fetch; None for the task's own
    episodes: int = 8  # real episodes that the posterior is inferred from
    simulations: int = 512  # per refinement of the posterior
    refinements: int = 0  # 0 for 2 (CartPole) or 1 (Fetch)
    checkpoint: str = "best"  # under the policy's own physics; or last
    points: int = 10  # of the grid of each parameter, to which the robot is added
    grid_episodes: int = 64  # per point
    real_episodes: int = 256  # at the robot
    video: bool = True  # of the first seed's policies at the robot
    short: bool = False
    resume: str = ""


def job(settings: Robustness, out: Path) -> dict[str, Any]:
    """Train every policy, score all, compare and draw."""
    settings = replace(settings)  # what is chosen below is not what the user said
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    task = chosen(settings)
    if settings.short:
        settings.simulations, settings.episodes, settings.checkpoint = 24, 2, "last"
        settings.grid_episodes, settings.real_episodes = 2, 8
    truth = torch.tensor([task.truth[name] for name in task.prior.names])
    sources = chosen_sources(settings, truth, nominal(task))
    seeds = range(settings.seed, settings.seed + (settings.seeds or default_seeds(task)))
    runs: list[dict[str, Any]] = []
    total = len(seeds) * len(sources)
    with tqdm(total=total, desc="policies", disable=not settings.progress) as bar:
        for seed in seeds:
            study = Study(task, truth, settings, out / f"seed{seed}", seed=seed)
            for source in sources:
                runs.append({"source": source, "seed": seed, **study.scored(source)})
                bar.update()
                bar.write(f"seed {seed}, {source}: {runs[-1]['at_real']:.2f} at the robot")
    result = {
        "task": settings.task,
        "algorithm": study.algorithm,
        "preset": settings.preset,
        "domains": settings.domains,
        "parameters": list(task.prior.names),
        "true": truth.tolist(),
        "score": "success" if isinstance(task, GoalTask) else "return",
        "seeds": len(seeds),
        "checkpoint": settings.checkpoint,
        "frames": int(runs[0]["curve"][-1]["frames"]),
        "inference_frames": study.inference_frames if "posterior" in sources else 0,
        "real_episodes": runs[0]["real_episodes"],
        "curves": curves(runs, dict(zip(task.prior.names, truth.tolist(), strict=True))),
        "at_real": compared(runs, "at_real"),
        "under_prior": compared(runs, "under_prior"),
        "posteriors": [
            {"seed": run["seed"], "posterior": run["posterior"]} for run in runs if run["posterior"]
        ],
        "runs": runs,
    }
    write_text(out / "table.md", table(result))
    print(table(result))
    draw_pictures(out, result)
    return result


def chosen(settings: Robustness) -> Task:
    """Return the task as the settings have it."""
    known = {"cartpole": TASKS["cartpole"], **FETCH}
    check_choice("a task", settings.task, known)
    task = known[settings.task]
    for name, least in COUNTS.items():
        check_count(f"{name}=", getattr(settings, name), least=least)
    available = PRESETS if isinstance(task, GoalTask) else tuple(PPO_PRESETS)
    settings.preset = settings.preset or available[0]
    check_choice("a preset", settings.preset, available)
    check_choice("a checkpoint", settings.checkpoint, ["best", "last"])
    # one friction is found at once; a mass at the edge of its prior, once simulations are near it
    settings.refinements = settings.refinements or (1 if isinstance(task, GoalTask) else 2)
    if settings.truth:
        task = replace(task, truth=as_truth(settings.truth, task))
    if isinstance(task, GoalTask):
        settings.domains = max(settings.domains, 0)
        task = as_preset(task, settings.preset)
        if settings.short:
            task = replace(task, environments=4)
        return with_learner(
            task,
            algorithm=settings.algorithm,
            critic_sees_physics=settings.critic_sees_physics,
            short=settings.short,
        )
    if settings.algorithm or settings.critic_sees_physics is not None:
        got = settings.algorithm or f"critic_sees_physics={settings.critic_sees_physics}"
        raise ValueError(message("an algorithm or a critic's view for Fetch tasks only", got))
    given = PPO_PRESETS[settings.preset]
    settings.domains = given["domains"] if settings.domains < 0 else settings.domains
    settings.batches = settings.batches or given["budget"]
    ppo = {**given["ppo"], "final_learning_rate": 0.0} | ({"epochs": 2} if settings.short else {})
    return replace(task, environments=given["environments"], horizon=given["horizon"], ppo=ppo)


def as_truth(text: str, task: Task) -> dict[str, float]:
    """Return the robot's parameters by name.

    Raises:
        ValueError: They are not as many numbers as the prior has, or outside of it.
    """
    names, low, high = task.prior.names, task.prior.low.tolist(), task.prior.high.tolist()
    try:
        values = [float(value) for value in text.split(",")]
    except ValueError:
        values = []
    if len(values) != len(names) or not task.prior.log_prob(torch.tensor(values)).isfinite():
        box = ", ".join(f"{n} in [{a:g}, {b:g}]" for n, a, b in zip(names, low, high, strict=True))
        raise ValueError(message(f"truth= as numbers within the prior, {box}", text))
    return dict(zip(names, values, strict=True))


def default_seeds(task: Task) -> int:
    """Return how many policies of each source make a figure."""
    return 3 if isinstance(task, GoalTask) else 5


def chosen_sources(settings: Robustness, truth: Tensor, usual: Tensor) -> list[str]:
    """Return the sources in order, prior before posterior; nominal only where it is not true."""
    asked = settings.sources.split(",")
    for name in asked:
        check_choice("a source of physics", name, SOURCES)
    if "posterior" in asked and "prior" not in asked:
        raise ValueError(
            message("the prior among the sources: its policy collects", settings.sources)
        )
    if "nominal" in asked and "oracle" in asked and torch.allclose(truth, usual):
        print("The robot's physics are the nominal ones: one policy is both, called oracle.")
        asked.remove("nominal")
    return [name for name in SOURCES if name in asked]


if __name__ == "__main__":
    recipe.main(Robustness, job)
