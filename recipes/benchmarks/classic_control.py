"""Frames per second of the batched classic-control environments against `GymEnv`.

Random policy, auto-resets, both through the collector of TorchRL; one thread. Cases take turns.
Prints one JSON line per system and batch size::

    python recipes/benchmarks/classic_control.py [frames=2000] [runs=5]
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import torch
from measuring import compare, options, report
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, GymEnv

from torchrl_bayessim.envs.classic_control.acrobot import AcrobotEnv
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.classic_control.mountain_car import (
    MountainCarContinuousEnv,
    MountainCarEnv,
)
from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv

SYSTEMS = {
    "CartPole-v1": (CartPoleEnv, 500),
    "Pendulum-v1": (PendulumEnv, 200),
    "MountainCar-v0": (MountainCarEnv, 200),
    "MountainCarContinuous-v0": (MountainCarContinuousEnv, 999),
    "Acrobot-v1": (AcrobotEnv, 500),
}
STEPS = 50  # of every environment in a batch


def collecting(env: EnvBase, frames: int) -> Callable[[], int]:
    """Return a case: batches of ``STEPS`` per environment, at least ``frames`` in all."""
    size = STEPS * (env.batch_size.numel() or 1)
    collector = Collector(
        env, None, frames_per_batch=size, total_frames=-1, auto_register_policy_transforms=True
    )
    batches = iter(collector)

    def case() -> int:
        count = 0
        while count < frames:
            count += next(batches).numel()
        return count

    return case


def main(*arguments: str) -> None:
    """Measure every system at several batch sizes."""
    given = options(list(arguments), frames=2000, runs=5)
    torch.set_num_threads(1)
    torch.manual_seed(0)  # of the random policy
    for name, (system, max_steps) in SYSTEMS.items():
        envs = {"GymEnv": GymEnv(name)}
        envs |= {f"N={n}": system(n, max_steps=max_steps) for n in (1, 64, 1024, 4096)}
        more = {"N=1024": 100, "N=4096": 100, "N=64": 10}
        cases = {
            case: collecting(env, given["frames"] * more.get(case, 1)) for case, env in envs.items()
        }
        rates = compare(cases, runs=given["runs"])
        for case, values in rates.items():
            against = {"GymEnv": rates["GymEnv"]}
            label = f"{name} {case}"
            report("classic_control", label, values, against=against, seed=0, threads=1)


if __name__ == "__main__":
    main(*sys.argv[1:])
