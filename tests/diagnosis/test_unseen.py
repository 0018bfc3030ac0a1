"""Joints that were not logged."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

TWO = """
<mujoco><option timestep=".005"/><worldbody>
  <body><joint name="shoulder" axis="0 1 0" damping=".2"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1"/>
    <body pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="{mass}"/></body></body>
</worldbody><actuator><motor name="motor" joint="shoulder" ctrlrange="-5 5"/></actuator></mujoco>
"""
COLUMNS = Columns(time="t", qpos={"shoulder": "q"}, qvel={"shoulder": "v"}, ctrl={"motor": "u"})


def recorded(mass):
    """Return a system of which the elbow is not logged, and runs of it."""
    model = mujoco.MjModel.from_xml_string(TWO.format(mass=mass))
    rng, logs = np.random.default_rng(0), []
    for i in range(4):
        data, rows = mujoco.MjData(model), []
        wave = rng.uniform(1, 4) * np.sin(0.02 * rng.uniform(1, 6) * np.arange(100))
        for u in wave:
            rows.append((*data.qpos, *data.qvel))
            data.ctrl[:] = u
            mujoco.mj_step(model, data, 4)
        state = torch.tensor(np.array(rows)) + 0.003 * torch.from_numpy(rng.normal(size=(100, 4)))
        state[:, [1, 3]] = 0.0
        logs.append(
            Log(
                name=f"run{i}",
                time=0.02 * torch.arange(100).double(),
                qpos=state[:, :2],
                qvel=state[:, 2:],
                ctrl=torch.from_numpy(wave)[:, None],
                velocity_gain=torch.zeros(2).double(),
                measured=torch.tensor([True, False, True, False]),
            )
        )
    return System(task=Task(model=model, frame_skip=4), columns=COLUMNS), logs


def test_a_joint_that_moves_what_is_measured_must_be_logged():
    system, logs = recorded(mass=0.5)
    with pytest.raises(ValueError, match=r"expected positions of all joints .* 'none of elbow'"):
        diagnose(system, None, logs, effects=["coulomb_friction"])


def test_a_joint_that_moves_nothing_measured_need_not_be():
    system, logs = recorded(mass=1e-5)
    report = diagnose(system, None, logs, effects=["coulomb_friction"])
    assert report.verdict == "none"
