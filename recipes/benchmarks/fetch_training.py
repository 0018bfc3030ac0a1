"""How much faster does the Fetch loop train than the same loop on gymnasium-robotics stepping?

Both collect episodes with DDPG's exploring policy and TorchRL's collector, draw a new friction for
each episode, fill the hindsight replay buffer, and make as many gradient updates per frame; one
steps N environments natively, the other a ``SerialEnv`` of N gymnasium environments or, with
``processes=2``, a ``ParallelEnv`` of two halves. They take turns, so ratios are within a run. While
the native one steps in a thread of its own the learner makes its updates; Python simulators leave
it no time. ``collect`` is the loop without its updates, ``train`` the whole of it; environment
frames per second. Learner and N are those of the recipes' task; ``preset=wide`` has larger networks
and more updates, as in `fetch_tasks`::

    python recipes/benchmarks/fetch_training.py [task=fetch_push] [preset=wide] [runs=5]
        [updates=0.2] [n=16] [processes=2] [matmul_precision=medium]
"""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import gymnasium_robotics
import torch
from measuring import compare, options, report
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    EnvBase,
    GymEnv,
    ParallelEnv,
    SerialEnv,
    TransformedEnv,
)

from torchrl_bayessim import ApplyPhysics, DomainRandomizer, MujocoPhysics
from torchrl_bayessim.agents.ddpg import DDPG
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.errors import message
from torchrl_bayessim.overlapped import Overlapped
from torchrl_bayessim.randomness import isolated
from torchrl_bayessim.simulate import make_collector, next_batch

sys.path.append(str(Path(__file__).parent.parent))
from fetch_tasks import FETCH, FRICTION, PRESETS, GoalTask, as_preset
from recipe import MATMUL_PRECISIONS

STEPS = 50  # an episode
GYM = ", gymnasium-robotics"


def batched(task: GoalTask, n: int, threads: int) -> EnvBase:
    """Return n environments, stepped natively."""
    env = BatchedMujocoEnv(task.simulator_name, n, threads=threads)
    physics = ApplyPhysics(MujocoPhysics(friction=FRICTION))
    return TransformedEnv(env, Compose(physics, DomainRandomizer(task.prior)))


def one(simulator_name: str) -> EnvBase:
    """Return one gymnasium-robotics environment."""
    physics = ApplyPhysics(MujocoPhysics(friction=FRICTION))
    return TransformedEnv(GymEnv(simulator_name), Compose(physics, DoubleToFloat()))


def gym(task: GoalTask, n: int, processes: int) -> EnvBase:
    """Return n gymnasium-robotics environments, in this process or in so many others."""
    some = partial(SerialEnv, n // processes, partial(one, task.simulator_name))
    env = some() if processes == 1 else ParallelEnv(processes, some)
    return TransformedEnv(env, DomainRandomizer(task.prior))


def loop(env: EnvBase, learner: DDPG, batches: int) -> Callable[[], int]:
    """Return a case: ``batches`` batches of whole episodes, and the updates that go with them."""
    frames = env.batch_size.numel() * STEPS
    learning = Overlapped(learner)
    collector = make_collector(env, learner.policy, steps=STEPS)

    def case() -> int:
        for index in range(batches):
            with isolated(index):
                batch: Any = next_batch(collector, meanwhile=learning.meanwhile)
            batch = batch.reshape(-1, STEPS)  # also of environments that stand in two rows
            if learner.updates_per_frame:
                learning.update(batch, into={}, key=(index,))
            else:
                learner.buffer.extend(batch.select(*learner.kept_keys))
        return batches * frames

    return case


def main(*arguments: str) -> None:
    """Measure both loops in turn, without and with updates."""
    names = {"task": "fetch_push", "preset": "fast", "matmul_precision": "medium", "updates": ""}
    rest = [a for a in arguments if a.partition("=")[0] not in names]
    given = {**names, **dict(a.split("=", 1) for a in arguments if a not in rest)}
    counts = options(rest, optional=["n"], n=0, runs=5, threads=1, batches=1, processes=1)
    for name, available in {
        "task": FETCH,
        "preset": PRESETS,
        "matmul_precision": MATMUL_PRECISIONS,
    }.items():
        if given[name] not in available:
            raise SystemExit(message(f"{name}=", given[name], available=available))
    task = as_preset(FETCH[given["task"]], given["preset"])
    n, threads, batches = counts["n"] or task.environments, counts["threads"], counts["batches"]
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore")
    gymnasium.register_envs(gymnasium_robotics)
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision(given["matmul_precision"])
    asked = {"updates_per_frame": float(given["updates"])} if given["updates"] else {}
    gymnasiums = partial(gym, processes=counts["processes"])
    cases = {}
    for name, own in {"collect": {"updates_per_frame": 0.0}, "train": asked}.items():
        for kind, make in {"": partial(batched, threads=threads), GYM: gymnasiums}.items():
            env = make(task, n)
            learner = task.learner(env, **own)
            cases[name + kind] = loop(env, learner, batches)
    rates = compare(cases, runs=counts["runs"])
    for name, values in rates.items():
        other = name + GYM
        against = {other: rates[other]} if other in rates else {}
        context = {"task": task.simulator_name, "n": n, "threads": threads, "seed": 0}
        context |= {"algorithm": learner.name, "updates": learner.updates_per_frame}
        context |= {"hidden": learner.settings["hidden"], "batches": batches}
        context |= {"gym_processes": counts["processes"]}
        context |= {"preset": given["preset"], "matmul_precision": given["matmul_precision"]}
        report("fetch_training", name, values, against=against, **context)


if __name__ == "__main__":
    main(*sys.argv[1:])
