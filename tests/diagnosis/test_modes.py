"""What is predicted: segments, whole trajectories, statistics. The same answers are known."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from one_joint_arm import FRICTION, describe, motion, save
from one_joint_arm import diagnose as by_recipe

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.modes import Trajectories
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

DOUBLE = """
<mujoco><option timestep=".005"/><worldbody>
  <body><joint name="shoulder" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1" contype="0"/>
    <body pos="0 0 -.4"><joint name="elbow" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5" contype="0"/></body></body>
</worldbody></mujoco>
"""
FEW = ["coulomb_friction", "viscous_friction", "action_bias", "action_gain"]


def arm(folder):
    describe(folder)
    return System.load(folder / "robot.yaml")


def logged(seed, **cause):
    rows = torch.tensor(motion(seed, **cause), dtype=torch.float64)
    return Log(
        name=f"run{seed}",
        time=rows[:, 0],
        qpos=rows[:, 1:2],
        qvel=rows[:, 2:3],
        ctrl=rows[:, 3:],
        velocity_gain=torch.zeros(1).double(),
        measured=torch.ones(2, dtype=torch.bool),
    )


def test_whole_trajectories_of_a_simulator_that_is_right_leave_noise(tmp_path):
    logs = [logged(seed) for seed in range(6)]
    report = diagnose(arm(tmp_path), None, logs, effects=FEW, mode="trajectories")
    assert report.verdict == "none"
    assert report.gap.horizon_steps == len(logs[0]) - 1
    assert report.gap.refit == pytest.approx(1.0, abs=0.2)


def test_friction_is_named_from_whole_trajectories(tmp_path):
    logs = [logged(seed, friction=FRICTION) for seed in range(6)]
    report = diagnose(arm(tmp_path), None, logs, effects=FEW, mode="trajectories")
    assert report.confusion_set == ("coulomb_friction",)
    assert report.effects[0].strength == pytest.approx(FRICTION, rel=0.1)
    assert report.audit["mode"] == "trajectories"


def test_trajectories_are_shorter_where_they_are_chaotic():
    model = mujoco.MjModel.from_xml_string(DOUBLE)
    predictor = Predictor(System(task=Task(model=model, frame_skip=4)))
    logs = []
    for angle in (2.8, 3.0):
        data, rows = mujoco.MjData(model), []
        data.qpos[:] = angle, 0.1
        for _ in range(401):
            rows.append((*data.qpos, *data.qvel))
            mujoco.mj_step(model, data, 4)
        states = torch.tensor(rows, dtype=torch.float64)
        logs.append(
            Log(
                name="thrown",
                time=0.02 * torch.arange(401).double(),
                qpos=states[:, :2],
                qvel=states[:, 2:],
                ctrl=torch.zeros(401, 0).double(),
                velocity_gain=torch.zeros(2).double(),
                measured=torch.ones(4, dtype=torch.bool),
            )
        )
    given = {"units": [], "noise": np.full(4, 0.003), "history": 8}
    steps = Trajectories().horizon(predictor, {"train": logs}, **given)
    assert 24 <= steps <= 200
    quiet = {**given, "noise": np.full(4, 1e-6)}
    assert Trajectories().horizon(predictor, {"train": logs}, **quiet) > steps


def unsynchronised(seed, late=5, **cause):
    """Return a log whose sensors show what was so many rows ago."""
    log = logged(seed, rows=300 + late, **cause)
    states = {name: getattr(log, name)[:-late] for name in ("qpos", "qvel")}
    return replace(log, time=log.time[:-late], ctrl=log.ctrl[late:], **states)


def test_clocks_that_are_apart_are_no_cause_where_statistics_are_compared(tmp_path):
    logs = [unsynchronised(seed) for seed in range(5)]
    report = diagnose(arm(tmp_path), None, logs, effects=FEW, mode="summaries")
    assert report.verdict == "none"
    assert report.gap.refit < 1.5
    by_rows = diagnose(arm(tmp_path), None, logs, effects=FEW)
    assert by_rows.verdict != "none"


def test_friction_is_named_though_clocks_are_apart(tmp_path):
    logs = [unsynchronised(seed, friction=FRICTION) for seed in range(5)]
    report = diagnose(arm(tmp_path), None, logs, effects=FEW, mode="summaries")
    assert report.effects[0].name == "coulomb_friction"
    assert report.effects[0].strength == pytest.approx(FRICTION, rel=0.2)
    assert "delays are not looked for" in report.alarms[0]


def test_the_recipe_takes_a_mode(tmp_path):
    describe(tmp_path)
    for seed in range(4):
        save(tmp_path / "logs" / f"run{seed}.csv", motion(seed))
    by_recipe(tmp_path, "mode=trajectories", "horizon=0")
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["audit"]["mode"] == "trajectories"
    assert report["gap"]["horizon_steps"] == len(motion(0)) - 1


def test_there_is_no_other_mode(tmp_path):
    with pytest.raises(ValueError, match=r"expected a mode of the diagnosis, got 'whole'"):
        diagnose(arm(tmp_path), None, [logged(0)], mode="whole")
