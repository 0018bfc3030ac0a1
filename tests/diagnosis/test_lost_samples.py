"""Samples that were lost are interpolated, and what they hid is found beside them."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from test_diagnose import ARM, logs, system
from test_lost_values import TWO, run_of_two, shown_again

from torchrl_bayessim.diagnosis import holds
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.lost_samples import _interpolated
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.logs.velocity import Windows, velocity


def wave(*, estimated):
    """A log of a smooth motion whose every tenth angle is the last one."""
    time = 0.01 * np.arange(200)
    angle, speed = np.sin(5 * time), 5 * np.cos(5 * time)
    lost = np.zeros(200, dtype=bool)
    lost[5::10] = True
    shown = np.where(lost, np.r_[angle[:1], angle[:-1]], angle)
    if estimated:
        speed = velocity(Windows(time), shown)[0]
    log = Log(
        name="wave",
        time=torch.from_numpy(time),
        qpos=torch.from_numpy(shown[:, None].copy()),
        qvel=torch.from_numpy(speed[:, None].copy()),
        ctrl=torch.zeros(200, 1, dtype=torch.float64),
        velocity_gain=torch.full((1,), 30.0 if estimated else 0.0, dtype=torch.float64),
        measured=torch.tensor([True, not estimated]),
    )
    return log, angle, lost


@pytest.mark.parametrize("estimated", [False, True])
def test_lost_angles_are_interpolated_and_velocities_estimated_from_them_again(estimated):
    log, angle, lost = wave(estimated=estimated)
    found = _interpolated(log, lost, 0)
    assert np.abs(log.qpos[:, 0].numpy() - angle).max() > 0.04
    assert np.abs(found.qpos[:, 0].numpy() - angle).max() < 1e-3
    assert torch.equal(found.qpos[~lost], log.qpos[~lost])
    inner = slice(20, -20)
    right = 5 * np.cos(5 * log.time.numpy())[inner]
    before, after = (np.abs(x.qvel[inner, 0].numpy() - right).max() for x in (log, found))
    if estimated:
        assert after < 0.2 * before
        assert torch.equal(found.qvel[0], log.qvel[0])  # the window has no rows before
    else:
        assert torch.equal(found.qvel, log.qvel)


def test_lost_velocities_are_interpolated():
    log, _, lost = wave(estimated=False)
    spoilt = log.qvel.clone()
    spoilt[lost] = 9.0
    found = _interpolated(replace(log, qvel=spoilt), lost, 1)
    assert (found.qvel - log.qvel).abs().max() < 0.03
    assert torch.equal(found.qpos, log.qpos)


def test_logs_of_which_nothing_or_nearly_everything_is_lost_stay():
    log, _, lost = wave(estimated=False)
    assert _interpolated(log, np.zeros_like(lost), 0) is log
    assert _interpolated(log, ~np.zeros_like(lost), 0) is log


def second_angle_shown_again(log, share, rng):
    angles = log.qpos.clone()
    for k in range(1, len(angles)):
        if rng.random() < share:
            angles[k, 1] = angles[k - 1, 1]
    return replace(log, qpos=angles + torch.from_numpy(rng.normal(scale=2e-4, size=angles.shape)))


NOTE = {True: "not to have been renewed", False: "taken to have been lost, and interpolated"}


@pytest.mark.parametrize("by_velocities", [True, False])
def test_a_gain_that_lost_samples_hide_is_found_beside_them(by_velocities, monkeypatch):
    """Three per cent of a command do less than an angle that is a step late, now and then."""
    if not by_velocities:
        monkeypatch.setattr(holds, "held_in_noise", lambda *_: None)
    rng = np.random.default_rng(8)
    gain = np.array([1.03, 1.0])
    data = [run_of_two(rng, f"run{i}", share=0.0, through=lambda u: u * gain) for i in range(6)]
    data = [second_angle_shown_again(log, 0.12, rng) for log in data]
    robot = System(task=Task(model=mujoco.MjModel.from_xml_string(TWO), frame_skip=1))
    some = "sensor_dropout", "action_gain", "coulomb_friction", "action_lag"
    report = diagnose(robot, None, data, effects=some)
    found = {effect.name: effect for effect in report.effects}
    assert set(found) == {"action_gain", "sensor_dropout"}
    assert (found["action_gain"].where, found["sensor_dropout"].where) == ("one", "second position")
    assert found["action_gain"].strength == pytest.approx(0.03, abs=0.01)
    assert found["sensor_dropout"].strength == pytest.approx(0.12, rel=0.3)
    (note,) = (alarm for alarm in report.alarms if NOTE[by_velocities] in alarm)
    assert re.search(r"^\d+ of 900 samples", note)
    assert report.gap.with_effects < 1.3 < report.gap.refit


def late(u, k):
    """Return the command behind a filter of the first order, of three control steps."""
    weights = 0.25 * 0.75 ** np.arange(k + 1)
    return float(weights @ u[k::-1])


def test_samples_are_lost_beside_a_slow_drive():
    rng = np.random.default_rng(8)
    data = [shown_again(log, 0.12, rng) for log in logs(8, act=late)]
    some = "sensor_dropout", "action_lag", "action_delay", "coulomb_friction", "packet_drop"
    report = diagnose(system(), None, data, effects=some)
    found = {effect.name: effect for effect in report.effects}
    assert set(found) == {"action_lag", "sensor_dropout"}
    assert found["sensor_dropout"].strength == pytest.approx(0.12, rel=0.3)
    report = diagnose(system(), None, logs(8, act=late), effects=some)
    assert [effect.name for effect in report.effects] == ["action_lag"]


def test_no_sample_is_replaced_where_losses_are_all_there_is(monkeypatch):
    monkeypatch.setattr(holds, "held_in_noise", lambda *_: None)
    rng = np.random.default_rng(8)
    data = [run_of_two(rng, f"run{i}", share=0.0) for i in range(6)]
    data = [second_angle_shown_again(log, 0.12, rng) for log in data]
    robot = System(task=Task(model=mujoco.MjModel.from_xml_string(TWO), frame_skip=1))
    some = "sensor_dropout", "action_gain", "coulomb_friction", "action_lag"
    report = diagnose(robot, None, data, effects=some)
    assert [effect.name for effect in report.effects] == ["sensor_dropout"]
    assert not any("interpolated" in alarm for alarm in report.alarms)


def test_samples_of_a_robot_that_nothing_drives_may_be_lost():
    """No commands can be; and none are decided on."""
    robot = system(ARM[: ARM.index("<actuator>")] + "</mujoco>")
    rng = np.random.default_rng(4)
    data = [shown_again(log, 0.1, rng) for log in logs(6, act=lambda u, k: 0.0)]
    data = [replace(log, ctrl=torch.zeros(len(log), 0, dtype=torch.float64)) for log in data]
    report = diagnose(robot, None, data, effects=("sensor_dropout", "coulomb_friction"))
    assert [effect.name for effect in report.effects] == ["sensor_dropout"]
