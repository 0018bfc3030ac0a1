"""Resampled logs follow the motion, wherever its rows are."""

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_bayessim.logs import velocity as module
from torchrl_bayessim.logs.record import Record, record_of
from torchrl_bayessim.logs.resampling import resample
from torchrl_bayessim.logs.tables import Table
from torchrl_bayessim.logs.velocity import Windows, angular_velocity, velocity


def swing(time, *, speed=True):
    """A sine and its derivative, with a ramp as action."""
    qvel = 3 * np.cos(3 * time) if speed else np.full(len(time), np.nan)
    return Record(
        name="swing.csv",
        time=time,
        qpos=np.sin(3 * time)[:, None],
        qvel=qvel[:, None],
        ctrl=time[:, None].copy(),
    )


def test_a_record_on_the_grid_is_taken_as_it_is(pendulum):
    record = swing(0.01 * np.arange(50))
    (log,) = resample(record, pendulum)
    np.testing.assert_array_equal(log.qpos, record.qpos)
    np.testing.assert_array_equal(log.ctrl, record.ctrl)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.002, 0.02), st.floats(0, 0.4), st.integers(0, 1000))
def test_states_follow_the_motion_at_any_rate(pendulum, dt, jitter, seed):
    rng = np.random.default_rng(seed)
    time = 5.0 + dt * (np.arange(200) + jitter * rng.random(200))
    (log,) = resample(swing(time), pendulum)
    at = log.time.numpy()
    assert at[0] == time[0]
    assert at[-1] <= time[-1] + 2e-4
    np.testing.assert_allclose(np.diff(at), 0.01)
    np.testing.assert_allclose(log.qpos[:, 0], np.sin(3 * at), atol=7e-4)  # on the grid to 2 %
    np.testing.assert_allclose(log.qvel[:, 0], 3 * np.cos(3 * at), atol=3e-2)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.001, 0.03))
def test_the_impulse_of_the_actions_is_kept(pendulum, dt):
    record = swing(dt * np.arange(100))
    (log,) = resample(record, pendulum)
    covered = log.time.numpy()[-1] + 0.01
    ends = np.append(record.time, record.time[-1] + max(dt, 0.02))
    held = np.diff(np.clip(ends, None, covered))
    assert (log.ctrl[:, 0] * 0.01).sum() == pytest.approx((record.ctrl[:, 0] * held).sum())


def test_gaps_split_and_are_not_filled(pendulum):
    time = np.concatenate([0.01 * np.arange(20), 1.0 + 0.01 * np.arange(20)])
    logs = resample(swing(time), pendulum)
    assert [(log.first_row, len(log)) for log in logs] == [(0, 20), (20, 20)]
    small = np.delete(0.01 * np.arange(40), [10, 11])
    assert len(resample(swing(small), pendulum)) == 1


def test_parts_can_be_left_out(pendulum):
    logs = resample(swing(0.01 * np.arange(30)), pendulum, leave_out=[(10, 12)])
    assert [log.name for log in logs] == ["swing.csv rows 0 to 9", "swing.csv rows 13 to 29"]
    with pytest.raises(ValueError, match=r"rows of swing\.csv that can be used"):
        resample(swing(0.01 * np.arange(30)), pendulum, leave_out=[(0, 29)])


@pytest.mark.parametrize("period", [20, 30, 60])
def test_smooth_motion_keeps_the_window_that_noise_asks_for(period, monkeypatch):
    rows = np.arange(120)
    windows = Windows(0.05 * rows)
    rng = np.random.default_rng(0)
    positions = [np.sin(2 * np.pi * rows / period) + 0.02 * rng.normal(size=120) for _ in range(20)]
    positions += [np.round(rows / 4.3), np.round(20 * positions[0]) / 20]  # encoders
    positions += [np.repeat(positions[0][::2], 2)]  # every other sample held
    found = [velocity(windows, position)[2] for position in positions]
    monkeypatch.setattr(module, "_swings", lambda *_: False)
    assert found == [velocity(windows, position)[2] for position in positions]


@pytest.mark.parametrize("period", [2, 3])
def test_motion_that_turns_from_row_to_row_loses_no_rows_at_its_ends(period):
    rng = np.random.default_rng(0)
    rows = np.arange(78)
    swinging = np.cos(2 * np.pi * rows / period + 0.3) + 0.01 * rng.normal(size=78)
    still = 0.01 * rng.normal(size=78)
    windows = Windows(0.05 * rows)
    assert velocity(windows, swinging)[2] <= 3
    assert velocity(windows, still)[2] >= 13
    assert velocity(windows, swinging + 300 * still)[2] >= 13  # much more noise


@pytest.mark.parametrize("dt", [0.004, 0.01])
def test_velocities_are_estimated_with_their_gain(pendulum_without_velocity, dt):
    rng = np.random.default_rng(0)
    errors, gains = [], []
    for _ in range(20):
        record = swing(dt * np.arange(400), speed=False)
        record.qpos[:] += 1e-3 * rng.normal(size=record.qpos.shape)
        (log,) = resample(record, pendulum_without_velocity)
        errors.append((log.qvel[:, 0] - 3 * torch.cos(3 * log.time)).square().mean().sqrt())
        gains.append(float(log.velocity_gain[0]))
        assert log.measured.tolist() == [True, False]
    assert np.mean(errors) == pytest.approx(1e-3 * np.mean(gains), rel=0.15)


def test_the_window_is_short_where_noise_is_not_the_problem():
    time = 0.01 * np.arange(200)
    rng = np.random.default_rng(0)
    *_, clean = velocity(Windows(time), np.sin(20 * time))
    *_, noisy = velocity(Windows(time), np.sin(2 * time) + 0.01 * rng.normal(size=200))
    assert clean < noisy


def tumbling(model, dt, steps):
    """A box thrown in the air: times, poses, velocities."""
    data = mujoco.MjData(model)
    data.qvel[:] = [0.3, 0.2, 1.0, 2.0, -3.0, 1.0]
    rows = []
    for _ in range(steps):
        rows.append((data.time, data.qpos.copy(), data.qvel.copy()))
        mujoco.mj_step(model, data, round(dt / model.opt.timestep))
    return (np.array(column) for column in zip(*rows, strict=True))


def test_rotations_follow_the_motion(box):
    model = box.task.model
    time, qpos, qvel = tumbling(model, 0.014, 40)
    fine_time, fine, speed = tumbling(model, 0.002, 280)
    record = Record(name="toss", time=time, qpos=qpos, qvel=qvel, ctrl=np.zeros((40, 0)))
    (log,) = resample(record, box)
    rows = np.rint(log.time.numpy() / 0.002).astype(int)
    np.testing.assert_allclose(fine_time[rows], log.time, atol=1e-9)
    difference = np.zeros(6)
    for a, b in zip(fine[rows], log.qpos.numpy(), strict=True):
        mujoco.mj_differentiatePos(model, difference, 1.0, a, b)
        assert np.abs(difference).max() < 1e-3
    np.testing.assert_allclose(log.qvel, speed[rows], atol=0.03)
    estimated, gain, _ = angular_velocity(Windows(fine_time), fine[:, 3:])
    assert np.abs(estimated - speed[:, 3:]).max() < 1e-2
    assert gain > 0


def test_a_table_without_rows_is_no_record(pendulum):
    empty = {name: np.zeros(0) for name in pendulum.columns.used()}
    with pytest.raises(ValueError, match=r"rows in log\.parquet, got 0"):
        record_of(Table("log.parquet", empty), pendulum)


def test_quaternions_do_not_change_sign(box):
    time, qpos, qvel = tumbling(box.task.model, 0.01, 60)
    flipped = qpos.copy()
    flipped[10:20, 3:] *= -1.001
    names = box.columns.used()[1:]
    columns = dict(zip(names, np.concatenate([flipped, qvel], 1).T, strict=True))
    record = record_of(Table("toss", {"time": time, **columns}), box)
    np.testing.assert_allclose(record.qpos, qpos, atol=1e-6)
    columns["free qw"] = columns["free qw"] + 5
    with pytest.raises(ValueError, match="unit quaternions w, x, y, z of 'free' in toss"):
        record_of(Table("toss", {"time": time, **columns}), box)
