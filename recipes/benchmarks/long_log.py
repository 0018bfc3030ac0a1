"""What does a log of ten million rows take, in seconds and in memory?

Writes a CSV file of a one-joint arm at 100 Hz (28 hours; a motion of 400 rows over and over), and
reads it, checks it and cuts it to logs at the control step, in one process with one thread. Prints
one JSON line per stage, its peak memory in the context::

    python recipes/benchmarks/long_log.py [rows=10000000]
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from arm import ARM
from measuring import options, report
from threadpoolctl import threadpool_limits

from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.read import read_records
from torchrl_bayessim.logs.sanity import check, usable_logs
from torchrl_bayessim.logs.system import System

PERIOD = 400  # rows


def system() -> System:
    """Return the arm at 100 Hz."""
    task = Task(model=mujoco.MjModel.from_xml_string(ARM), frame_skip=2)
    return System(
        task=task, columns=Columns("t", {"hinge": ("q",)}, {"hinge": ("qd",)}, {"motor": "tau"})
    )


def motion() -> np.ndarray:
    """Return a period of q, qd and of the torque that it takes, with noise."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data, noise = mujoco.MjData(model), np.random.default_rng(0)
    turn = 2 * np.pi / PERIOD
    rate = turn / 0.01
    rows = []
    for k in range(PERIOD):
        data.qpos[0] = 0.5 * np.sin(turn * k) + 0.2 * np.sin(5 * turn * k)
        data.qvel[0] = rate * (0.5 * np.cos(turn * k) + np.cos(5 * turn * k))
        data.qacc[0] = -(rate**2) * (0.5 * np.sin(turn * k) + 5 * np.sin(5 * turn * k))
        mujoco.mj_inverse(model, data)
        scatter = noise.standard_normal(2) * (0.001, 0.02)
        rows.append([*(data.qpos + scatter[0]), *(data.qvel + scatter[1]), *data.qfrc_inverse])
    return np.array(rows)


def write(path: Path, rows: int) -> None:
    """Write the motion over and over, period by period."""
    lines = [",".join(f"{value:.6f}" for value in row) for row in motion()]
    with path.open("w") as file:
        file.write("t,q,qd,tau\n")
        for start in range(0, rows, PERIOD):
            part = lines[: rows - start]
            file.writelines(f"{0.01 * (start + i):.2f},{line}\n" for i, line in enumerate(part))


def timed(stage: str, job: Callable[[], Any], rows: int) -> Any:
    """Run a stage once, and print its time and the most memory so far."""
    begun = time.perf_counter()
    result = job()
    seconds = time.perf_counter() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    told = {"unit": "s", "seed": 0, "threads": 1, "rows": rows, "peak_gib": round(peak, 2)}
    report("long_log", stage, [seconds], **told)
    return result


def main(*arguments: str) -> None:
    """Measure the stages in turn."""
    rows = options(list(arguments), rows=10_000_000)["rows"]
    torch.set_num_threads(1)
    arm = system()
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        path = Path(folder, "log.csv")
        timed("write", lambda: write(path, rows), rows)
        records = timed("read", lambda: read_records(path, arm), rows)
        findings = timed("check", lambda: check(records, arm), rows)
        logs = timed("cut", lambda: usable_logs(records, arm, findings), rows)
    print("\n".join(map(str, findings)), f"\n{sum(map(len, logs))} rows in {len(logs)} log(s)")


if __name__ == "__main__":
    main(*sys.argv[1:])
