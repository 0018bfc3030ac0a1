"""What does it cost to give environments new physics at a reset?

Microseconds per environment: of writing one entry of the model, of recomputing what follows from a
mass (``mj_setConst``), and of both through `MujocoPhysics`; for all of N environments at once and
for one among them. Prints one JSON line per case::

    python recipes/benchmarks/physics_writes.py [n=256] [runs=7] [threads=1]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial

import torch
from measuring import options, report
from tensordict import TensorDict

from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.physics.mujoco import MujocoPhysics


def microseconds(call: Callable[[], object], *, environments: int, runs: int) -> list[float]:
    """Return the time of one call per environment."""
    call()
    figures = []
    for _ in range(runs):
        start = time.perf_counter()
        for _ in range(100):
            call()
        figures.append((time.perf_counter() - start) / 100 / environments * 1e6)
    return figures


def cases(env: BatchedMujocoEnv, count: int) -> dict[str, Callable[[], object]]:
    """Return ways to write the physics of the first ``count`` environments."""
    n = env.num_envs
    mask, theta = torch.arange(n) < count, 3.0 + torch.rand(n, 1, generator=_draws())
    rows, values = mask.numpy(), theta[:, 0].double().numpy()
    through = {"theta": theta, "mask": mask, "tensordict": TensorDict(batch_size=[n])}
    friction, mass = MujocoPhysics("geom_friction[floor,0]"), MujocoPhysics("body_mass[torso]")
    return {
        "write": partial(env.models.write, "body_mass", (1,), values, rows),
        "refresh": partial(env.models.refresh, rows),
        "MujocoPhysics friction": partial(friction.write, env, **through),
        "MujocoPhysics mass": partial(mass.write, env, **through),
    }


def _draws() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def main(*arguments: str) -> None:
    """Measure writes of the physics of Hopper and Humanoid."""
    given = options(list(arguments), n=256, runs=7, threads=1)
    torch.set_num_threads(1)
    for task in ("Hopper-v5", "Humanoid-v5"):
        env = BatchedMujocoEnv(task, given["n"], threads=given["threads"])
        for count in (given["n"], 1):
            for name, call in cases(env, count).items():
                figures = microseconds(call, environments=count, runs=given["runs"])
                context = {"seed": 0, "threads": given["threads"]}
                case = f"{task} {name}, {count} of {given['n']}"
                report("physics_writes", case, figures, unit="us/environment", **context)


if __name__ == "__main__":
    main(*sys.argv[1:])
