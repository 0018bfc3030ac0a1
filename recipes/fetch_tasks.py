"""Fetch tasks of the recipes: simulator, prior, hidden truth, summaries, and DDPG's settings.

Friction is set on table and object under one name: MuJoCo takes the larger of two geoms' friction,
so that of the object alone changes nothing on a table of 1.0. The prior of friction is that of the
BayesSim paper (arXiv:1906.01728, sec. V). It does not state the true friction; here it lies inside
the prior, where the object moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium
import torch
from tasks import Task
from torch import Tensor
from torchrl.envs import EnvBase, GymEnv

from torchrl_bayessim.agents.ddpg import DDPG
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.tasks.fetch import goal_reward
from torchrl_bayessim.errors import message
from torchrl_bayessim.evaluation import successes
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.summaries import cross_correlation, linear_dynamics

MEASURED = ("observation", "achieved_goal", "desired_goal")
ARM = ("shoulder_pan", "shoulder_lift", "upperarm_roll", "elbow_flex", "wrist_flex", "wrist_roll")
DAMPING = tuple(f"dof_damping[robot0:{joint}_joint]" for joint in ARM)  # nominally all 50
FRICTION = ("geom_friction[body:table0,0]", "geom_friction[object0,0]")


@dataclass(frozen=True, kw_only=True)
class GoalTask(Task):
    """A task whose episodes have goals and last ``max_steps``.

    Attributes:
        simulator_name: Under which the simulator knows it.
        warmup: Batches under the prior that make the data-collecting policy.
        budget: Batches in a training of its own, as `robustness.py` has them.
        ddpg: DDPG's settings.
    """

    simulator_name: str
    warmup: int
    budget: int
    ddpg: Mapping[str, Any] = field(default_factory=dict)

    def learner(self, env: EnvBase, **options: Any) -> DDPG:
        """Return an untrained learner."""
        return DDPG(env, goal_reward, **{**self.ddpg, **options})

    def rendered(self, size: int) -> EnvBase:
        """Return gymnasium-robotics' simulator with square pictures: its own take long to draw."""
        import gymnasium_robotics  # which talks when it is imported

        gymnasium.register_envs(gymnasium_robotics)
        pictures = {"from_pixels": True, "pixels_only": False, "width": size, "height": size}
        return GymEnv(self.simulator_name, **pictures)

    def scores(self, env: EnvBase, policy: Any) -> Tensor:
        """Return 1 for each environment whose goal is reached, 0 for the others."""
        return successes(env, policy, max_steps=self.max_steps).float()


def goal_task(simulator_name: str, **settings: Any) -> GoalTask:
    """Return a task of the batched Fetch environment, on one thread."""
    return GoalTask(
        simulator_name=simulator_name,
        simulator=lambda n, seed: BatchedMujocoEnv(simulator_name, n, seed=seed, threads=1),
        **{"max_steps": 50, "horizon": 50, "environments": 16, "shared_batches": 8, **settings},
    )


def slowing(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
    """Return how a moving object loses speed, pushed or not and then away from the hand, L = 18.

    Free sliding loses ``μ g Δt`` of speed per control step. Both times, over the steps at whose
    start the object moves faster than 2 cm/s: their share, the mean speed, mean and quantiles of
    the loss, and the ratio of summed losses to summed speeds. Unlike `recovery_problems.sliding`
    it looks at one step at a time, so that the steps of several episodes may be put together.
    """
    del action
    before, after = (_object_speed(x) for x in (state, next_state))
    moving = mask & (before > 0.02 * 0.04)
    apart = torch.linalg.vector_norm(next_state[..., 6:9], dim=-1) > 0.06
    parts = [_losses(before, after, steps) for steps in (moving, moving & apart)]
    return torch.cat(parts, -1)


def _losses(before: Tensor, after: Tensor, steps: Tensor) -> Tensor:
    """Return statistics of the loss of speed over ``steps``, shape ``(*, 9)``; 0 without any."""
    loss = torch.where(steps, before - after, torch.nan)
    speed = torch.where(steps, before, torch.nan)
    grid = torch.tensor([0.1, 0.3, 0.5, 0.7, 0.9])
    quantiles = loss.nanquantile(grid, dim=-1).movedim(0, -1)
    ratio = loss.nansum(-1) / speed.nansum(-1).clamp(min=1e-9)
    means = [100 * speed.nanmean(-1), 100 * loss.nanmean(-1), ratio]
    share = steps.double().mean(-1).to(before.dtype)
    return torch.cat([torch.stack([share, *means], -1), 100 * quantiles], -1).nan_to_num(0.0)


def _object_speed(state: Tensor) -> Tensor:
    """Return the object's horizontal speed in m per control step, ``(*, 25) -> (*,)``."""
    # the observation holds it relative to the gripper's
    return torch.linalg.vector_norm(state[..., 14:16] + state[..., 20:22], dim=-1)


def gripper_dynamics(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
    """Return the linear dynamics of the gripper's position and velocity, given the command."""
    columns = [0, 1, 2, 5, 6, 7]
    return linear_dynamics(state[..., columns], action[..., :3], next_state[..., columns], mask)


def pushes(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
    """Return how the object's displacement goes with hand and object, as correlations."""
    columns = [3, 4, 6, 7, 8, 14, 15]
    return cross_correlation(state[..., columns], action[..., :3], next_state[..., columns], mask)


# With DDPG's own settings the updates of a frame take three times as long as its simulation. These
# have a fifth of the multiplications; 0.95 is the discount of rl-zoo's agents for Fetch. The critic
# sees friction: on seed 7 the policy passed 0.95 after 414,000 frames so, 532,000 otherwise.
PUSH: dict[str, Any] = {
    "hidden": (256, 256),
    "actor_every": 2,
    "updates_per_frame": 0.1,
    "gamma": 0.95,
    "tau": 0.01,
    "critic_keys": ("theta",),
}

FETCH: dict[str, GoalTask] = {
    "fetch_push": goal_task(
        "FetchPush-v4",
        prior=BoxPrior({"friction": (0.1, 1.0)}),
        truth={"friction": 0.3},
        physics=lambda: MujocoPhysics(friction=FRICTION),
        summaries=(slowing, pushes),
        environments=32,
        shared_batches=4,
        warmup=125,
        updates=62,
        budget=375,
        ddpg=PUSH,
    ),
    "fetch_slide": goal_task(
        "FetchSlide-v4",
        prior=BoxPrior({"friction": (0.1, 1.0)}),
        truth={"friction": 0.15},
        physics=lambda: MujocoPhysics(friction=FRICTION),
        summaries=(slowing, pushes),
        warmup=300,
        updates=150,
        budget=600,
        ddpg={"algorithm": "td3", "final_learning_rate": 3e-4},
    ),
    "fetch_reach": goal_task(
        "FetchReach-v4",
        prior=BoxPrior({"damping": (10.0, 200.0)}, units={"damping": "N m s/rad"}),
        truth={"damping": 50.0},
        physics=lambda: MujocoPhysics(damping=DAMPING),
        summaries=(gripper_dynamics,),
        warmup=8,
        updates=8,
        budget=24,
        shared_batches=1,
    ),
}

# Plappert et al. (2018), one worker: 200 epochs of 100 episodes, 400,000 updates. There 40 follow
# two episodes, here 160 eight, since the first have to fill a batch. Target networks there keep
# 0.95 once in 40 updates, here as much at every one.
PAPER = {
    "algorithm": "ddpg",
    "updates_per_frame": 0.4,
    "tau": 1 - 0.95 ** (1 / 40),
    "moving": None,
    "final_learning_rate": 1e-3,
}


PRESETS = ("fast", "wide", "paper")


def as_preset(task: GoalTask, preset: str, *, rounds: int = 1) -> GoalTask:
    """Return the task with the settings of one of the presets.

    Raises:
        ValueError: There is no such preset, or it is the task's own already.
    """
    if preset not in PRESETS:
        raise ValueError(message("a preset", preset, available=PRESETS))
    if preset == "wide" and task.ddpg is not PUSH:
        got = f"{preset} on {task.simulator_name}"
        hint = "fast, which on this task has the large networks"
        raise ValueError(message("a preset that changes something", got, hint=hint))
    if preset == "paper":
        return paper(task, rounds)
    return wide(task) if preset == "wide" else task


def with_learner(
    task: GoalTask,
    *,
    algorithm: str = "",
    critic_sees_physics: bool | None = None,
    short: bool = False,
) -> GoalTask:
    """Return the task with another algorithm, another critic, or a learner that learns little.

    Args:
        task: Whose own settings hold where nothing is said.
        algorithm: Of `DDPG`, or empty.
        critic_sees_physics: Whether ``theta`` is shown to the critic, or None.
        short: Whether to learn little.
    """
    ddpg = dict(task.ddpg)
    if algorithm:
        ddpg["algorithm"] = algorithm
    if critic_sees_physics is not None:
        ddpg["critic_keys"] = ("theta",) if critic_sees_physics else ()
    if short:
        ddpg |= {"hidden": (32, 32), "batch_size": 64, "updates_per_frame": 0.02}
    return replace(task, ddpg=ddpg)


def wide(task: GoalTask) -> GoalTask:
    """Return Push with DDPG's own settings, in 16 environments."""
    return replace(
        task,
        environments=16,
        shared_batches=8,
        warmup=250,
        updates=125,
        budget=750,
        ddpg={},
    )


def paper(task: GoalTask, rounds: int) -> GoalTask:
    """Return the task with the original settings and 1,000,000 frames in ``rounds`` rounds."""
    batches = 2_500  # of eight episodes
    warmup = batches // 2
    return replace(
        task,
        environments=8,
        warmup=warmup,
        updates=(batches - warmup) // rounds,
        budget=batches,
        ddpg={**PAPER},
    )
