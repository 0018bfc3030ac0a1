"""Logs of HalfCheetah, whose noise is known."""

import copy

import mujoco
import numpy as np
import torch

from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System


def cheetah(
    *, noise=None, stiffness=0.0, amplitude=0.5, lost=0.0, late=0.0, shaken=0.0, runs=4, seed=0
):
    """Return HalfCheetah, logs of one with a spring more, and the logs' noise.

    Or of one that loses commands of its back shin, whose are late by up to a part of a step each,
    or whose back foot is shaken, at four hertz.
    """
    task = known_task("HalfCheetah-v5")
    model, rng, logs = copy.copy(task.model), np.random.default_rng(seed), []
    model.jnt_stiffness[model.joint("bthigh").id] += stiffness
    true = np.repeat([0.002, 0.02], model.nv)
    for i in range(runs):
        data, rows = mujoco.MjData(model), []
        commands = amplitude * rng.uniform(-1, 1, (80, model.nu))
        for u in commands:
            rows.append(np.r_[data.qpos, data.qvel] + true * rng.standard_normal(2 * model.nv))
            held, before = data.ctrl[1], commands[max(len(rows) - 2, 0), 1]
            data.ctrl[:] = u
            if late:
                data.ctrl[1] += rng.uniform(0.0, late) * (before - u[1])
            if lost and rng.random() < lost:
                data.ctrl[1] = held
            for _ in range(task.frame_skip):
                data.qfrc_applied[5] = shaken * np.sin(2 * np.pi * 4.0 * data.time + 1.0)
                mujoco.mj_step(model, data)
        state = torch.from_numpy(np.array(rows))
        logs.append(
            Log(
                name=f"run{i}",
                time=task.dt * torch.arange(80).double(),
                qpos=state[:, : model.nq],
                qvel=state[:, model.nq :],
                ctrl=torch.from_numpy(commands),
                velocity_gain=torch.zeros(model.nv).double(),
                measured=torch.ones(2 * model.nv, dtype=torch.bool),
            )
        )
    given = {} if noise is None else dict(zip(System(task=task).robot.channels, noise, strict=True))
    return System(task=task, noise=given), logs, true
