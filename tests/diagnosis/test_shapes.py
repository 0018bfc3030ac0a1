"""Forces that come again along a rail: their distance and phase are read off the missing force."""

import mujoco
import numpy as np
import pytest
import torch
from test_diagnose import commands

from torchrl_bayessim.diagnosis.diagnose import diagnose
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
SOME = ("cogging", "constant_force", "coulomb_friction", "parallel_spring", "periodic_disturbance")


def ride(rng, steps, rate, force):
    """Return a run of a cart that magnets along the rail pull to and fro."""
    model = mujoco.MjModel.from_xml_string(CART)
    model.opt.timestep /= 4
    data = mujoco.MjData(model)
    u, rows = commands(rng, steps), []
    for k in range(steps):
        rows.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = u[k]
        for _ in range(20):
            data.qfrc_applied[0] = force * np.sin(rate * data.qpos[0] + 1.0)
            mujoco.mj_step(model, data)
    state = torch.from_numpy(np.array(rows) + rng.normal(size=(steps, 2)) * [0.0005, 0.01])
    return Log(
        name="ride",
        time=0.01 * torch.arange(steps).double(),
        qpos=state[:, :1],
        qvel=state[:, 1:],
        ctrl=torch.from_numpy(u[:, None].copy()),
        velocity_gain=torch.zeros(1).double(),
        measured=torch.ones(2, dtype=torch.bool),
    )


def test_magnets_along_a_rail_are_found_at_their_distance():
    task = Task(model=mujoco.MjModel.from_xml_string(CART), frame_skip=5)
    system = System(task=task, physics=MujocoPhysics(*BOUNDS), prior=BoxPrior(BOUNDS))
    rng = np.random.default_rng(1)
    logs = [ride(rng, 200, rate=31.0, force=0.4) for _ in range(6)]  # every 20 cm
    report = diagnose(system, None, logs, effects=SOME)
    assert [effect.name for effect in report.effects] == ["cogging"]
    assert report.effects[0].strength == pytest.approx(0.4, rel=0.1)
    assert report.effects[0].where == "rail"
    (found,) = report.strengths
    assert found.number == pytest.approx(31.0, rel=0.02)
