"""Frames per second of the batched classic-control environments against `GymEnv`.

Random policy, auto-resets, both through the collector of TorchRL; one thread. Prints one JSON line
per system and batch size::

    python recipes/benchmarks/classic_control.py [seconds=1] [runs=3]
"""

from __future__ import annotations

import json
import platform
import statistics
import sys
import time

import gymnasium
import torch
import torchrl
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


def frames_per_second(env: EnvBase, *, steps: int, seconds: float, runs: int) -> list[float]:
    """Return one figure per run, after a warm-up batch."""
    frames = steps * env.batch_size.numel()
    collector = Collector(
        env, None, frames_per_batch=frames, total_frames=-1, auto_register_policy_transforms=True
    )
    batches = iter(collector)
    next(batches)
    figures = []
    for _ in range(runs):
        start, collected = time.perf_counter(), 0
        while (elapsed := time.perf_counter() - start) < seconds:
            next(batches)
            collected += frames
        figures.append(collected / elapsed)
    collector.shutdown()
    return figures


def main(*arguments: str) -> None:
    """Measure every system at several batch sizes."""
    options = {"seconds": "1", "runs": "3"} | dict(a.split("=", 1) for a in arguments)
    timing = {"seconds": float(options["seconds"]), "runs": int(options["runs"])}
    torch.set_num_threads(1)
    torch.manual_seed(0)  # the random policy's
    provenance = {
        "seed": 0,
        "threads": 1,
        "torch": torch.__version__,
        "torchrl": torchrl.__version__,
        "gymnasium": gymnasium.__version__,
        "machine": platform.processor() or platform.machine(),
    }
    for name, (system, max_steps) in SYSTEMS.items():
        gym = statistics.median(frames_per_second(GymEnv(name), steps=200, **timing))
        for n in (1, 64, 1024, 4096):
            env = system(n, max_steps=max_steps)
            figures = frames_per_second(env, steps=50, **timing)
            median = statistics.median(figures)
            line = {
                "benchmark": "classic_control",
                "case": f"{name} N={n}",
                "value": round(median),
                "unit": "frames/s",
                "median": round(median),
                "min": round(min(figures)),
                "max": round(max(figures)),
                "runs": len(figures),
                "against": {"GymEnv": round(median / gym, 1)},
            }
            print(json.dumps(line | {"GymEnv frames/s": round(gym)} | provenance), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
