"""What does domain randomisation cost on Hopper?

Frames per second of a collector with the two transforms (a mass and two frictions drawn, written,
read back at every reset), over the same collector without them, with episodes of 100 steps:
``GymEnv``, ``SerialEnv`` of four bare simulators and of four that have another transform beside
them already, and ``BatchedMujocoEnv`` of 64. ``plain`` has neither of the two, ``idle`` transforms
that do nothing in their places: what a step costs more with any transform there is TorchRL's.
Prints one JSON line per case::

    python recipes/benchmarks/reset_overhead.py [runs=7] [steps=100] [frames=4000]
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from measuring import compare, options, report
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    EnvBase,
    GymEnv,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
)

from torchrl_bayessim import ApplyPhysics, BoxPrior, DomainRandomizer, MujocoPhysics
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.envs.tasks.catalogue import known_task

PRIOR = BoxPrior({"mass": (2.0, 6.0), "friction": (0.4, 2.0)})


def apply() -> ApplyPhysics:
    """Return the transform beside the simulator."""
    return ApplyPhysics(
        MujocoPhysics(
            mass="body_mass[torso]",
            friction=("geom_friction[floor,0]", "geom_friction[foot_geom,0]"),
        )
    )


def hopper() -> EnvBase:
    """Return a Hopper that does not fall, so that every episode has the same length."""
    return GymEnv("Hopper-v5", terminate_when_unhealthy=False)


class Idle(Transform):
    """A transform that does nothing: what TorchRL takes for any transform at all."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        del tensordict
        return next_tensordict


def single(case: str, *, steps: int) -> EnvBase:
    """Return one environment."""
    beside: list[Transform] = {
        "plain": [],
        "idle": [Idle(), Idle()],
        "randomized": [apply(), DomainRandomizer(PRIOR)],
    }[case]
    return TransformedEnv(hopper(), Compose(*beside, StepCounter(steps), DoubleToFloat()))


def bare(case: str, *, steps: int) -> EnvBase:
    """Return four environments, with the randomizer outside."""
    beside = {"plain": None, "idle": Idle, "randomized": apply}[case]
    make = hopper if beside is None else lambda: TransformedEnv(hopper(), beside())
    return _outside(SerialEnv(4, make), case, StepCounter(steps), DoubleToFloat())


def transformed(case: str, *, steps: int) -> EnvBase:
    """Return four environments that have a transform of their own already."""
    beside = {"plain": list, "idle": lambda: [Idle()], "randomized": lambda: [apply()]}[case]
    make = lambda: TransformedEnv(hopper(), Compose(*beside(), DoubleToFloat()))
    return _outside(SerialEnv(4, make), case, StepCounter(steps))


def _outside(env: EnvBase, case: str, *others: Transform) -> EnvBase:
    first: dict[str, list[Transform]] = {
        "plain": [],
        "idle": [Idle()],
        "randomized": [DomainRandomizer(PRIOR)],
    }
    return TransformedEnv(env, Compose(*first[case], *others))


def batched(case: str, *, steps: int) -> EnvBase:
    """Return 64 environments that step in one native call."""
    env = BatchedMujocoEnv(_standing(), 64, threads=1)
    beside: list[Transform] = {
        "plain": [],
        "idle": [Idle(), Idle()],
        "randomized": [apply(), DomainRandomizer(PRIOR)],
    }[case]
    return TransformedEnv(env, Compose(*beside, StepCounter(steps)))


def _standing() -> Task:
    return replace(known_task("Hopper-v5"), termination=None)


def collect(collector: Collector, frames: int) -> int:
    """Collect at least ``frames`` frames."""
    count = 0
    while count < frames:
        count += collector.next().numel()
    return count


def main(*arguments: str) -> None:
    """Measure every kind of environment, with and without randomisation."""
    given = options(list(arguments), runs=7, steps=100, frames=4000)
    torch.set_num_threads(1)
    torch.manual_seed(0)  # of the random policy
    kinds = {
        "GymEnv": single,
        "SerialEnv": bare,
        "SerialEnv, transformed": transformed,
        "BatchedMujocoEnv": batched,
    }
    for name, make in kinds.items():
        cases: dict[str, Callable[[], int]] = {}
        for case in ("plain", "idle", "randomized"):
            env = make(case, steps=given["steps"])
            rows = max(1, env.batch_size.numel())
            collector = Collector(env, frames_per_batch=rows * 200, total_frames=-1)
            frames = given["frames"] * (5 if rows == 64 else 1)
            cases[case] = partial(collect, collector, frames)
        rates = compare(cases, runs=given["runs"])
        for case, values in rates.items():
            others = {other: rates[other] for other in ("plain", "idle") if other != case}
            against = others if case == "randomized" else None
            label = f"{name} {case}"
            context = {"steps": given["steps"], "seed": 0, "threads": 1}
            report("reset_overhead", label, values, against=against, **context)


if __name__ == "__main__":
    main(*sys.argv[1:])
