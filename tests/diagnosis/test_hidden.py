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
ROWS = 160
COLUMNS = Columns("t", {"shoulder": ("q",)}, {"shoulder": ("v",)}, {"motor": "u"})
FEW = ["coulomb_friction", "viscous_friction", "action_gain", "constant_force"]


def recorded(mass, noise=0.003, friction=(0.0, 0.0)):
    """Return a system of which the elbow is not logged, and runs of it."""
    model = mujoco.MjModel.from_xml_string(TWO.format(mass=mass))
    real = mujoco.MjModel.from_xml_string(TWO.format(mass=mass))
    real.dof_frictionloss[:] = friction
    rng, logs = np.random.default_rng(0), []
    for i in range(4):
        data, rows = mujoco.MjData(real), []
        wave = rng.uniform(1, 4) * np.sin(0.02 * rng.uniform(1, 6) * np.arange(ROWS))
        data.qpos[1] = rng.normal(scale=0.3)
        for u in wave:
            rows.append((*data.qpos, *data.qvel))
            data.ctrl[:] = u
            mujoco.mj_step(real, data, 4)
        state = torch.tensor(np.array(rows)) + noise * torch.from_numpy(rng.normal(size=(ROWS, 4)))
        state[:, [1, 3]] = 0.0
        logs.append(
            Log(
                name=f"run{i}",
                time=0.02 * torch.arange(ROWS).double(),
                qpos=state[:, :2],
                qvel=state[:, 2:],
                ctrl=torch.from_numpy(wave)[:, None],
                velocity_gain=torch.zeros(2).double(),
                measured=torch.tensor([True, False, True, False]),
            )
        )
    return System(task=Task(model=model, frame_skip=4), columns=COLUMNS), logs


def test_a_simulator_that_is_right_needs_nothing_though_a_joint_was_not_logged():
    system, logs = recorded(mass=0.5)
    report = diagnose(system, None, logs, effects=FEW)
    assert report.verdict == "none"
    assert report.gap.raw < 1.5
    assert "elbow was not logged" in report.alarms[0]
    assert report.audit["mode"] == "trajectories"


def test_friction_of_a_joint_that_was_not_logged_is_named():
    system, logs = recorded(mass=0.5, friction=(0.0, 0.05))
    report = diagnose(system, None, logs, effects=FEW)
    assert (report.effects[0].name, report.effects[0].where) == ("coulomb_friction", "elbow")
    assert report.effects[0].strength == pytest.approx(0.05, rel=0.2)
    assert report.gap.explained_fraction > 0.8


def test_a_joint_of_which_the_measurements_say_too_little_must_be_logged():
    system, logs = recorded(mass=0.005, noise=0.001)
    with pytest.raises(ValueError, match=r"say what elbow did .* leave it open.*log the position"):
        diagnose(system, None, logs, effects=["coulomb_friction"])


def test_a_joint_that_moves_nothing_measured_need_not_be():
    system, logs = recorded(mass=1e-5)
    report = diagnose(system, None, logs, effects=["coulomb_friction"])
    assert report.verdict == "none"
