"""How fast are batched MuJoCo environments, against bare MuJoCo and against what TorchRL has?

Every environment has a mass and a friction of its own. Cases, which take turns so that ratios are
within a run:

* ``collector``: the task as it is, a small policy, auto-resets, TorchRL's own collector; to compare
  with ``GymEnv``, ``SerialEnv``, ``ParallelEnv`` (the same collector and policy);
* ``closed loop``: the same without terminations; to compare with ``mujoco.rollout``, which is given
  the same states, the actions that the policy took, one model per environment, and as many threads;
* ``open loop``: the same actions in one native call (``env.open_loop``);
* ``gymnasium``: some of the same actions, one process, without TorchRL.

``threads`` of a line are those of its case: one for ``gymnasium``, ``GymEnv`` and ``SerialEnv``
whatever was asked for, and the two processes of ``ParallelEnv(2)``.

Fetch has no case ``mujoco.rollout``, which cannot move a mocap body from where the gripper is.
Prints one JSON line per case::

    python recipes/benchmarks/batched_mujoco.py [task=Hopper-v5] [n=256] [steps=40] [runs=5]
"""

from __future__ import annotations

import dataclasses
import sys
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import torch
from measuring import compare, options, report
from mujoco import rollout
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import DoubleToFloat, EnvBase, GymEnv, ParallelEnv, SerialEnv, TransformedEnv

from torchrl_bayessim.envs.draws import Draws
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.envs.tasks.catalogue import known_task

gymnasium.register_envs(gymnasium_robotics)
warnings.filterwarnings("ignore", category=FutureWarning, module="torchrl")


def gym_env(task: str) -> EnvBase:
    """Return one environment as TorchRL wraps it, observations in single precision."""
    return TransformedEnv(GymEnv(task), DoubleToFloat())


def policy(env: EnvBase) -> TensorDictModule:
    """Return a small policy of the observation."""
    sizes = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    net = nn.Sequential(nn.Linear(sizes[0], 64), nn.Tanh(), nn.Linear(64, sizes[1]), nn.Tanh())
    return TensorDictModule(net, ["observation"], ["action"])


def endless(task: Task, n: int) -> Task:
    """Return the task without terminations, and with the same starts in every episode."""

    def reset(_: Draws) -> object:
        return task.reset(Draws(0, np.arange(n), np.zeros(n, dtype=np.int64)))

    return dataclasses.replace(task, termination=None, max_steps=None, reset=reset)


def vary(env: BatchedMujocoEnv) -> BatchedMujocoEnv:
    """Give every environment a mass and a friction of its own."""
    rng = np.random.default_rng(0)
    mass = env.task.model.body_mass[-1] * rng.uniform(0.8, 1.2, env.num_envs)
    env.models.write("body_mass", (env.task.model.nbody - 1,), mass)
    env.models.write("geom_friction", (0, 0), rng.uniform(0.5, 2.0, env.num_envs))
    env.models.refresh()
    return env


class Collecting:
    """A case: one batch of ``steps`` per environment from a collector; keeps its actions."""

    def __init__(self, env: EnvBase, steps: int, *, again: bool = False) -> None:
        self.frames = steps * env.batch_size.numel()
        self.env, self.actions = env, torch.empty(0)
        self.collector = Collector(
            env,
            policy(env),
            frames_per_batch=self.frames,
            total_frames=-1,
            reset_at_each_iter=again,
            trajs_per_batch=None,
        )
        self._batches = iter(self.collector)

    def __call__(self) -> int:
        """Collect a batch; return how many frames it has."""
        self.actions = next(self._batches)["action"]
        return self.frames


def gymnasium_alone(task: str, closed: Collecting, episodes: int) -> Callable[[], int]:
    """Return a case: some of the actions of ``closed`` again, by Gymnasium without TorchRL."""
    env = gymnasium.make(task).unwrapped

    def case() -> int:
        for row in closed.actions[:episodes].numpy():
            env.reset()
            for action in row:
                env.step(action)
        return episodes * closed.actions.shape[1]

    return case


def open_loop(closed: Collecting, threads: int) -> Callable[[], int]:
    """Return a case: the actions of ``closed`` again, in one native call."""
    env = vary(BatchedMujocoEnv(closed.env.task, closed.env.num_envs, threads=threads))

    def case() -> int:
        env.reset()
        env.open_loop(closed.actions)
        return closed.frames

    return case


def bare(closed: Collecting, threads: int) -> Callable[[], int]:
    """Return a case: the actions of ``closed`` again, by `mujoco.rollout`."""
    env = vary(BatchedMujocoEnv(closed.env.task, closed.env.num_envs))
    env.reset()
    models = [env.models.copy_of(i) for i in range(env.num_envs)]
    data = [mujoco.MjData(models[0]) for _ in range(threads)]
    pool = rollout.Rollout(nthread=threads)
    full = mujoco.mj_stateSize(models[0], int(mujoco.mjtState.mjSTATE_FULLPHYSICS))
    start = np.ascontiguousarray(env.stepper.state[:, :full])

    def case() -> int:
        held = np.repeat(closed.actions.double().numpy(), env.task.frame_skip, axis=1)
        pool.rollout(models, data, start, held)
        return closed.frames

    return case


def main(*arguments: str) -> None:
    """Measure every case in turn."""
    named = [argument for argument in arguments if argument.startswith("task=")]
    numbers = [argument for argument in arguments if argument not in named]
    given = options(numbers, n=256, steps=40, runs=5, threads=2)
    name = ("task=Hopper-v5", *named)[-1].removeprefix("task=")
    n, steps, runs, threads = (given[key] for key in ("n", "steps", "runs", "threads"))
    torch.set_num_threads(1)
    torch.manual_seed(0)
    batched = vary(BatchedMujocoEnv(name, n, threads=threads))
    closed = Collecting(
        vary(BatchedMujocoEnv(endless(known_task(name), n), n, threads=threads)), steps, again=True
    )
    others = {
        "GymEnv": gym_env(name),
        "SerialEnv(4)": SerialEnv(4, partial(gym_env, name)),
        "ParallelEnv(2)": ParallelEnv(2, partial(gym_env, name)),
    }
    cases = {"collector": Collecting(batched, steps), "closed loop": closed}
    cases |= {"open loop": open_loop(closed, threads)}
    if batched.task.drive.weld is None:
        cases["mujoco.rollout"] = bare(closed, threads)
    cases["gymnasium"] = gymnasium_alone(name, closed, episodes=8)
    cases |= {key: Collecting(env, 8 * steps // (env.numel() or 1)) for key, env in others.items()}
    with ExitStack() as stack:
        for case in cases.values():
            if isinstance(case, Collecting):
                stack.callback(case.collector.shutdown)
        rates = compare(cases, runs=runs)
    for key, values in rates.items():
        against = {other: rates[other] for other in rates if other != key}
        workers = {"gymnasium": 1, "GymEnv": 1, "SerialEnv(4)": 1, "ParallelEnv(2)": 2}
        context = {"task": name, "n": n, "threads": workers.get(key, threads), "seed": 0}
        report("batched_mujoco", key, values, against=against, **context)


if __name__ == "__main__":
    main(*sys.argv[1:])
