"""Velocities estimated from positions are doubted where the robot is too fast for them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.fast_motion import FastMotion
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.velocity_errors import with_velocity_errors
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.record import Record
from torchrl_bayessim.logs.resampling import resample
from torchrl_bayessim.logs.system import System

ARM = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="link"><joint name="hinge" axis="0 1 0" damping=".05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1"/></body>
</worldbody><actuator><motor name="motor" joint="hinge" ctrlrange="-20 20"/></actuator></mujoco>
"""
DT, ROWS, NOISE = 0.05, 160, 1e-3


def system():
    model = mujoco.MjModel.from_xml_string(ARM)
    columns = Columns("t", {"hinge": ("q",)}, {}, {"motor": "u"})
    return System(task=Task(model=model, frame_skip=10), columns=columns)


def driven(seed, *, hertz, torque):
    """Return the log of an arm without sensors of velocity, and its velocities."""
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(ARM)
    data, rows = mujoco.MjData(model), []
    phase = rng.uniform(0, 6)
    for k in range(ROWS):
        u = torque * np.sign(np.sin(2 * np.pi * hertz * DT * k + phase))
        rows.append((DT * k, data.qpos[0] + NOISE * rng.standard_normal(), data.qvel[0], u))
        data.ctrl[:] = u
        mujoco.mj_step(model, data, 10)
    time, angle, speed, u = np.array(rows).T
    none = np.full((ROWS, 1), np.nan)
    record = Record(name=f"run{seed}", time=time, qpos=angle[:, None], qvel=none, ctrl=u[:, None])
    (log,) = resample(record, system())
    return log, speed[log.first_row : log.first_row + len(log)]


def error_of(log):
    (after,) = with_velocity_errors(Predictor(system()), [log], np.zeros(0))
    assert after.velocity_error is not None
    return float(after.velocity_error[0])


@pytest.mark.parametrize(("hertz", "torque"), [(0.3, 0.3), (9.5, 15.0)])
def test_the_error_is_that_of_the_estimate(hertz, torque):
    log, speed = driven(0, hertz=hertz, torque=torque)
    error = error_of(log)
    wrong = float(np.median(np.abs(log.qvel[:, 0].numpy() - speed)))
    noise = 3 * NOISE * float(log.velocity_gain[0])
    said = max(error, noise)
    assert 0.5 * wrong < said < 6 * wrong
    assert (error > noise) == (hertz > 1)


def test_measured_velocities_are_not_doubted():
    log, _ = driven(0, hertz=9.5, torque=15.0)
    measured = replace(log, velocity_gain=torch.zeros(1).double())
    (after,) = with_velocity_errors(Predictor(system()), [measured], np.zeros(0))
    assert after is measured


def test_what_is_faster_than_its_sampling_the_simulator_tells():
    """A torque that turns in every row: the arm swings forth and back in between."""
    effects = ["coulomb_friction", "action_gain"]
    logs = [driven(seed, hertz=9.5, torque=15.0)[0] for seed in range(6)]
    report = diagnose(system(), None, logs, effects=effects)
    assert report.verdict == "none"
    assert any("too fast for 20 rows a second" in alarm for alarm in report.alarms)
    for gain in (-0.1, -0.3):  # commands larger than what arrives
        weak = [replace(log, ctrl=log.ctrl / (1 + gain)) for log in logs]
        report = diagnose(system(), None, weak, effects=effects)
        assert [effect.name for effect in report.effects] == ["action_gain"]
        assert report.effects[0].strength == pytest.approx(gain, abs=0.02)


def test_what_neither_tells_is_not_testable(monkeypatch):
    monkeypatch.setattr(FastMotion, "estimated", lambda self, predictor, logs, **_: list(logs))
    effects = ["coulomb_friction", "action_gain"]
    logs = [driven(seed, hertz=9.5, torque=15.0)[0] for seed in range(6)]
    report = diagnose(system(), None, logs, effects=effects)
    assert report.verdict == "not_testable"
    assert "sample faster" in report.summary
    assert any("too fast for velocities" in alarm for alarm in report.alarms)
    calm = [driven(seed, hertz=0.3, torque=0.3)[0] for seed in range(6)]
    report = diagnose(system(), None, calm, effects=effects)
    assert report.verdict == "none"
