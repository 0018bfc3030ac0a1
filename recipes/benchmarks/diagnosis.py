"""How long does one diagnosis take: of a one-joint arm, of Hopper, of legs with twelve joints?

Each from logs of its own simulator (``none``), and of one with friction that it lacks
(``friction``): dry friction at the arm's joint and at three of the legs, viscous friction at
Hopper's knee. All effects of the catalogue are considered. The first run, in which functions are
compiled, is not counted. Prints one JSON line per case, with seconds of wall and of processor time
and the simulator's time steps::

    python recipes/benchmarks/diagnosis.py [runs=3] [legs=1]
"""

from __future__ import annotations

import copy
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import torch
from arm import ARM
from log_columns import by_columns
from measuring import options, report

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.read import read_logs
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

LEGS = Path(__file__).parent.parent / "systems" / "unitree_go2_legs" / "system.yaml"
NOISE = (0.001, 0.02)  # rad or m, and per second
FRICTION: Mapping[str, tuple[str, Mapping[str, float]]] = {
    "arm": ("dof_frictionloss", {"hinge": 0.1}),
    "hopper": ("dof_damping", {"leg_joint": 1.0}),
    "legs": ("dof_frictionloss", dict.fromkeys(("FL_thigh", "FR_thigh", "RL_thigh"), 0.4)),
}


def systems() -> dict[str, tuple[System, int, int, float]]:
    """Return each system, the number of its logs, their rows, and the size of its commands."""
    arm = System(
        task=Task(model=mujoco.MjModel.from_xml_string(ARM), frame_skip=2),
        physics=MujocoPhysics("body_mass[link]"),
        prior=BoxPrior({"body_mass[link]": (0.3, 0.8)}),
    )
    hopper = System(
        task=known_task("Hopper-v5"),
        physics=MujocoPhysics("body_mass[torso]", "geom_friction[floor,0]"),
        prior=BoxPrior({"body_mass[torso]": (2.0, 6.0), "geom_friction[floor,0]": (0.3, 1.5)}),
    )
    return {
        "arm": (arm, 6, 300, 0.6),
        "hopper": (hopper, 6, 150, 0.7),
        "legs": (System.load(LEGS), 6, 500, 0.25),
    }


def recorded(
    system: System, *, robot: mujoco.MjModel, runs: int, rows: int, amplitude: float
) -> list[Log]:
    """Return logs of the robot under sums of sines around the commands that hold it."""
    task, logs = system.task, []
    for run in range(runs):
        rng = np.random.default_rng(run)
        data = mujoco.MjData(robot)
        held = data.qpos[-robot.nu :] * (robot.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)
        t = task.dt * np.arange(rows)[:, None]
        frequency, phase = rng.uniform(0.3, 2.5, (2, 4, 1, robot.nu))
        waves = np.sin(2 * np.pi * frequency * t + 6 * phase).sum(0)
        commands = held + amplitude * waves
        state = np.empty((rows, robot.nq + robot.nv))
        for k, command in enumerate(commands):
            state[k] = np.r_[data.qpos, data.qvel]
            data.ctrl[:] = command
            mujoco.mj_step(robot, data, task.frame_skip)
        state += rng.standard_normal(state.shape) * np.repeat(NOISE, (robot.nq, robot.nv))
        table = by_columns(system, torch.from_numpy(state), torch.from_numpy(commands))
        table[system.columns.time or "time"] = torch.from_numpy(t[:, 0].copy())
        logs += read_logs(table, system)
    return logs


def with_friction(system: System, name: str) -> mujoco.MjModel:
    """Return the robot: its simulator with friction."""
    robot = copy.copy(system.task.model)
    field, strengths = FRICTION[name]
    for joint, strength in strengths.items():
        getattr(robot, field)[robot.joint(joint).dofadr[0]] += strength
    return robot


def main(*arguments: str) -> None:
    """Time one diagnosis of each system, without and with friction that it lacks."""
    given = options(list(arguments), optional=["legs"], runs=3, legs=1)
    torch.set_num_threads(1)
    for name, (system, runs, rows, amplitude) in systems().items():
        if name == "legs" and not given["legs"]:
            continue
        for case in ("none", "friction"):
            robot = system.task.model if case == "none" else with_friction(system, name)
            logs = recorded(system, robot=robot, runs=runs, rows=rows, amplitude=amplitude)
            found = diagnose(system, None, logs)
            seconds, begun = [], time.process_time()
            for _ in range(given["runs"]):
                start = time.perf_counter()
                found = diagnose(system, None, logs)
                seconds.append(time.perf_counter() - start)
            spent = (time.process_time() - begun) / given["runs"]
            report(
                "diagnosis",
                f"{name}, {case}",
                seconds,
                unit="s",
                seed=0,
                threads=1,
                processor_seconds=round(spent, 2),
                logs=len(logs),
                rows=rows,
                time_steps=found.audit["simulator_steps"],
                verdict=found.verdict,
                effects=[f"{effect.name} at {effect.where}" for effect in found.effects],
            )


if __name__ == "__main__":
    main(*sys.argv[1:])
