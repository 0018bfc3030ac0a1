"""A cart on a rail, driven by a motor and by whatever else acts on it."""

import mujoco
import numpy as np
import torch
from test_diagnose import commands

from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

CART = """
<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="2"/>
    <geom size=".05" mass="1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><motor name="drive" joint="rail" ctrlrange="-4 4"/></actuator></mujoco>
"""
BOUNDS = {"body_mass[cart]": (0.7, 1.5)}


def cart():
    """Return the simulator, which knows of nothing but the motor."""
    task = Task(model=mujoco.MjModel.from_xml_string(CART), frame_skip=5)
    return System(task=task, physics=MujocoPhysics(*BOUNDS), prior=BoxPrior(BOUNDS))


def ride(rng, steps, force, *, noise, finer=1, scale=1.0):
    """Return a run on which ``force(time, position)`` acts, with so much finer time steps.

    Commands are ``scale`` times the usual ones.
    """
    model = mujoco.MjModel.from_xml_string(CART)
    model.opt.timestep /= finer
    data = mujoco.MjData(model)
    u, rows = scale * commands(rng, steps), []
    for k in range(steps):
        rows.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = u[k]
        for _ in range(5 * finer):
            data.qfrc_applied[0] = force(data.time, data.qpos[0])
            mujoco.mj_step(model, data)
    state = torch.from_numpy(np.array(rows) + rng.normal(size=(steps, 2)) * noise)
    return Log(
        name="ride",
        time=0.01 * torch.arange(steps).double(),
        qpos=state[:, :1],
        qvel=state[:, 1:],
        ctrl=torch.from_numpy(u[:, None].copy()),
        velocity_gain=torch.zeros(1).double(),
        measured=torch.ones(2, dtype=torch.bool),
    )
