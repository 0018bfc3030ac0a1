"""How does throughput grow with the number of environments and of threads, and memory with both?

Closed loop without TorchRL's collector (``env.step`` with random actions), per-environment mass and
friction. Memory is what an environment adds to the process, by the resident set of a fresh process
with few and with many environments. Everything is drawn with seed 0. Prints one JSON line per
figure::

    python recipes/benchmarks/batched_mujoco_scaling.py [steps=20] [runs=3]
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import torch
from measuring import compare, options, report

from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv

_RESIDENT = """
import sys, numpy as np
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
env = BatchedMujocoEnv(sys.argv[1], int(sys.argv[2]), threads=2)
for body in range(1, env.task.model.nbody):
    env.models.write("body_mass", (body,), np.ones(env.num_envs))
env.models.refresh()
env.step(env.rand_action(env.reset()))
print(next(l for l in open("/proc/self/status") if l.startswith("VmRSS")).split()[1])
"""


def stepping(task: str, n: int, threads: int, steps: int) -> Callable[[], int]:
    """Return a case: so many steps with random actions from a reset, in environments that vary."""
    env = BatchedMujocoEnv(task, n, threads=threads)
    rng = np.random.default_rng(0)
    env.models.write("body_mass", (1,), env.task.model.body_mass[1] * rng.uniform(0.8, 1.2, n))
    env.models.write("geom_friction", (0, 0), rng.uniform(0.5, 2.0, n))
    env.models.refresh()
    actions = [env.action_spec.rand() for _ in range(steps)]

    def case() -> int:
        td = env.reset()
        for action in actions:
            td = env.step(td.set("action", action))["next"].exclude("reward")
        return steps * n

    return case


def resident(task: str, n: int) -> int:
    """Return the resident set of a process with ``n`` environments, in kB."""
    command = [sys.executable, "-c", _RESIDENT, task, str(n)]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def main(*arguments: str) -> None:
    """Measure over N, over threads, and memory."""
    given = options(list(arguments), steps=20, runs=3)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    cores = len(os.sched_getaffinity(0))
    task, steps = "Hopper-v5", given["steps"]
    sizes = {f"N={n}": stepping(task, n, cores, steps) for n in (1, 4, 16, 64, 256, 1024, 4096)}
    rates = compare(sizes, runs=given["runs"])
    for case, values in rates.items():
        against = {"N=256": rates["N=256"]}
        report(
            "batched_mujoco_scaling",
            f"{task} {case}",
            values,
            against=against,
            seed=0,
            threads=cores,
        )
    teams = {f"threads={k}": stepping(task, 256, k, steps) for k in sorted({1, 2, cores})}
    rates = compare(teams, runs=given["runs"])
    for case, values in rates.items():
        against, k = {"threads=1": rates["threads=1"]}, int(case.split("=")[1])
        label = f"{task} N=256 {case}"
        report("batched_mujoco_scaling", label, values, against=against, seed=0, threads=k)
    for name in ("Hopper-v5", "Humanoid-v5", "FetchPush-v4"):
        each = [
            (resident(name, 4096) - resident(name, 16)) / (4096 - 16) for _ in range(given["runs"])
        ]
        label = f"{name} memory per environment"
        report("batched_mujoco_scaling", label, each, unit="kB", seed=0, threads=2)


if __name__ == "__main__":
    main(*sys.argv[1:])
