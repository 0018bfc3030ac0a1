"""Orientations and angular velocities that do not belong together are named, others are not."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.record import Record
from torchrl_bayessim.logs.rotations import check_rotations
from torchrl_bayessim.logs.sanity import check, refuse_spoilt
from torchrl_bayessim.logs.system import System

TOSS = """
<mujoco>
  <option timestep="0.001"/>
  <worldbody>
    <geom type="plane" size="9 9 1"/>
    <body pos="0 0 {height}"><freejoint name="free"/>
      <geom type="box" size=".03 .05 .08" mass=".4"/></body>
  </worldbody>
</mujoco>
"""
NOISE = 1e-3, 0.02


def system(height=1.0):
    model = mujoco.MjModel.from_xml_string(TOSS.format(height=height))
    return System(task=Task(model=model, frame_skip=10))


def toss(robot, seed, *, spin=8.0, noise=NOISE, rows=120):
    """Return a record of a box that is thrown, and may hit the ground."""
    generator = np.random.default_rng(seed)
    model = robot.task.model
    data = mujoco.MjData(model)
    data.qvel[:3], data.qvel[3:] = generator.normal(0, 1, 3), generator.normal(0, spin, 3)
    data.qpos[3:] = Rotation.random(rng=generator).as_quat(scalar_first=True)
    qpos, qvel = [], []
    for _ in range(rows):
        qpos.append(data.qpos + noise[0] * generator.standard_normal(7))
        qvel.append(data.qvel + noise[1] * generator.standard_normal(6))
        mujoco.mj_step(model, data, 10)
    qpos = np.array(qpos)
    qpos[:, 3:] /= np.linalg.norm(qpos[:, 3:], axis=1, keepdims=True)
    time, ctrl = 0.01 * np.arange(rows), np.zeros((rows, 0))
    return Record(name=f"{seed}.csv", time=time, qpos=qpos, qvel=np.array(qvel), ctrl=ctrl)


def scaled(*factors):
    return lambda r: replace(r, qvel=r.qvel * np.array([1, 1, 1, *factors]))


def in_the_world(record):
    at = Rotation.from_quat(record.qpos[:, 3:], scalar_first=True)
    qvel = np.concatenate([record.qvel[:, :3], at.apply(record.qvel[:, 3:])], 1)
    return replace(record, qvel=qvel)


SPOILT = {
    "w last": (lambda r: replace(r, qpos=r.qpos[:, [0, 1, 2, 4, 5, 6, 3]]), "w, x, y, z"),
    "inverse": (lambda r: replace(r, qpos=r.qpos * [1, 1, 1, 1, -1, -1, -1]), "frame of the body"),
    "in the world": (in_the_world, "frame of the body"),
    "degrees": (scaled(57.3, 57.3, 57.3), "velocities are in degrees"),
    "revolutions": (scaled(1 / 6.28, 1 / 6.28, 1 / 6.28), "velocities are in revolutions"),
    "opposite sign": (scaled(-1, -1, -1), "opposite sign"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_what_does_not_turn_as_it_says_is_refused(name):
    spoil, said = SPOILT[name]
    robot = system()
    records = [spoil(toss(robot, seed)) for seed in range(4)]
    with pytest.raises(ValueError, match=f"free rotation: .*{said}"):
        refuse_spoilt(check(records, robot))


@pytest.mark.parametrize("height", [0.1, 0.3, 50.0])
@pytest.mark.parametrize("spin", [0.05, 1.0, 20.0])
@pytest.mark.parametrize("noise", [(0.0, 0.0), NOISE, (1e-2, 0.2)])
def test_clean_tosses_pass_through_impacts_and_noise(height, spin, noise):
    robot = system(height)
    records = [toss(robot, seed, spin=spin, noise=noise) for seed in range(3)]
    assert [f for record in records for f in check_rotations(record, robot)] == []


def test_late_velocities_gaps_and_missing_rows_pass():
    robot = system(50.0)
    record = toss(robot, 0)
    late = replace(record, qvel=np.roll(record.qvel, 3, axis=0))
    gap = replace(record, time=record.time + np.where(np.arange(120) > 60, 2.0, 0.0))
    qpos = record.qpos.copy()
    qpos[30:40] = np.nan
    for one in late, gap, replace(record, qpos=qpos), toss(robot, 0, rows=12):
        assert list(check_rotations(one, robot)) == []


def test_what_stands_still_or_was_not_measured_passes():
    robot = system()
    record = toss(robot, 0)
    still = replace(record, qpos=np.tile(record.qpos[:1], (120, 1)), qvel=0 * record.qvel)
    assert list(check_rotations(still, robot)) == []
    columns = Columns("time", robot.columns.qpos)
    unmeasured = replace(record, qvel=0 * record.qvel)
    assert list(check_rotations(unmeasured, System(task=robot.task, columns=columns))) == []
