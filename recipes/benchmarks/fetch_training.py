"""How much faster does the Fetch loop train than the same loop on gymnasium-robotics stepping?

Both collect episodes with DDPG's exploring policy and TorchRL's collector, draw a new friction for
each episode, fill the hindsight replay buffer, and make as many gradient updates per frame; one
steps 16 environments natively, the other a ``SerialEnv`` of 16 gymnasium environments. They take
turns, so ratios are within a run. While the native one steps in a thread of its own the learner
makes its updates; Python simulators leave it no time. ``collect`` is the loop without its updates,
``train`` the whole of it; environment frames per second. ``updates=0.2`` (per frame) is the
recipe's setting::

    python recipes/benchmarks/fetch_training.py [task=FetchPush-v4] [runs=5] [updates=0.2]
        [matmul_precision=medium]
"""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import gymnasium_robotics
import torch
from measuring import compare, report
from torchrl.envs import Compose, DoubleToFloat, EnvBase, GymEnv, SerialEnv, TransformedEnv

from torchrl_bayessim import ApplyPhysics, BoxPrior, DomainRandomizer, MujocoPhysics
from torchrl_bayessim.agents.ddpg import DDPG
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.tasks.fetch import goal_reward
from torchrl_bayessim.overlapped import Overlapped
from torchrl_bayessim.randomness import isolated
from torchrl_bayessim.simulate import make_collector, next_batch

FRICTION = ("geom_friction[body:table0,0]", "geom_friction[object0,0]")
PRIOR = BoxPrior({"friction": (0.1, 1.0)})
STEPS = 50  # an episode


def batched(task: str, n: int, threads: int) -> EnvBase:
    """Return n environments, stepped natively."""
    env = BatchedMujocoEnv(task, n, threads=threads)
    physics = ApplyPhysics(MujocoPhysics(friction=FRICTION))
    return TransformedEnv(env, Compose(physics, DomainRandomizer(PRIOR)))


def one(task: str) -> EnvBase:
    """Return one gymnasium-robotics environment."""
    physics = ApplyPhysics(MujocoPhysics(friction=FRICTION))
    return TransformedEnv(GymEnv(task), Compose(physics, DoubleToFloat()))


def serial(task: str, n: int) -> EnvBase:
    """Return n gymnasium-robotics environments in this process."""
    return TransformedEnv(SerialEnv(n, partial(one, task)), DomainRandomizer(PRIOR))


def loop(env: EnvBase, updates: float, batches: int) -> Callable[[], int]:
    """Return a case: ``batches`` batches of whole episodes, and the updates that go with them."""
    frames = env.batch_size.numel() * STEPS
    learner = DDPG(env, goal_reward, updates_per_frame=updates)
    learning = Overlapped(learner)
    collector = make_collector(env, learner.policy, steps=STEPS)

    def case() -> int:
        for index in range(batches):
            with isolated(index):
                batch: Any = next_batch(collector, meanwhile=learning.meanwhile)
            if updates:
                learning.update(batch, into={}, key=(index,))
            else:
                learner.buffer.extend(batch.select(*learner.kept_keys))
        return batches * frames

    return case


def main(*arguments: str) -> None:
    """Measure both loops in turn, without and with updates."""
    given = {"task": "FetchPush-v4", "n": "16", "runs": "5", "updates": "0.2", "threads": "1"}
    given |= {"batches": "1", "matmul_precision": "medium"}
    given |= dict(argument.split("=", 1) for argument in arguments)
    task, n, threads = given["task"], int(given["n"]), int(given["threads"])
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore")
    gymnasium.register_envs(gymnasium_robotics)
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision(given["matmul_precision"])
    cases = {}
    for name, updates in {"collect": 0.0, "train": float(given["updates"])}.items():
        batches = int(given["batches"])
        cases[name] = loop(batched(task, n, threads), updates, batches)
        cases[f"{name}, gymnasium-robotics"] = loop(serial(task, n), updates, batches)
    rates = compare(cases, runs=int(given["runs"]))
    for name, values in rates.items():
        other = f"{name}, gymnasium-robotics"
        against = {other: rates[other]} if other in rates else {}
        context = {"task": task, "n": n, "threads": threads, "seed": 0, "updates": given["updates"]}
        context["matmul_precision"] = given["matmul_precision"]
        report("fetch_training", name, values, against=against, **context)


if __name__ == "__main__":
    main(*sys.argv[1:])
