"""Friction at two joints, at one of which it stands for another cause."""

from functools import partial

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.diagnosis.model import LIKELY, judged_fits
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.diagnosis.search import Search
from torchrl_bayessim.diagnosis.selection import select
from torchrl_bayessim.diagnosis.weaker_places import without_weaker_places
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

TWO = """
<mujoco><option timestep="0.0025" integrator="RK4" gravity="0 0 0"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.3"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" contype="0" conaffinity="0"/>
  <body name="lower" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" contype="0" conaffinity="0"/>
</body></body></worldbody>
<actuator><motor name="first" joint="shoulder" ctrlrange="-5 5"/>
<motor name="second" joint="elbow" ctrlrange="-5 5"/></actuator></mujoco>
"""
BOUNDS = {"dof_damping[shoulder]": (0.1, 0.6)}
NOISE = np.array([0.001, 0.001, 0.01, 0.01])


def run(rng, friction, gain, *, steps=150):
    """Return a log of an arm with dry friction, N m by joint, and a gain of its first motor."""
    model = mujoco.MjModel.from_xml_string(TWO)
    model.opt.timestep /= 4
    data, rows = mujoco.MjData(model), []
    time = 0.02 * np.arange(steps)
    waves = [rng.normal(size=2) * np.sin(np.outer(time, rng.uniform(2, 12, 2))) for _ in range(4)]
    control = np.clip(0.8 * sum(waves), -5, 5)
    for u in control:
        rows.append(np.r_[data.qpos, data.qvel])
        data.ctrl[:] = u * [gain, 1.0]
        for _ in range(32):
            data.qfrc_applied[:] = -np.asarray(friction) * np.tanh(data.qvel / 0.002)
            mujoco.mj_step(model, data)
    state = torch.from_numpy(np.array(rows) + rng.normal(size=(steps, 4)) * NOISE)
    return Log(
        name=f"run{rng.integers(1000)}", time=torch.from_numpy(time),
        ctrl=torch.from_numpy(control),
        qpos=state[:, :2].clone(), qvel=state[:, 2:].clone(),
        velocity_gain=torch.zeros(2).double(), measured=torch.ones(4, dtype=torch.bool),
    )  # fmt: skip


NAMES = "coulomb_friction", "action_gain", "parallel_spring", "constant_force"


def robot_and_logs(friction, gain):
    rng = np.random.default_rng(0)
    task = Task(model=mujoco.MjModel.from_xml_string(TWO), frame_skip=8)
    system = System(task=task, physics=MujocoPhysics(*BOUNDS), prior=BoxPrior(BOUNDS))
    return system, [run(rng, friction, gain) for _ in range(6)]


def fitted(friction, gain):
    """Return sets of segments, units, and a model with friction at both joints."""
    system, logs = robot_and_logs(friction, gain)
    prepared = prepare(system, logs, [], generator=np.random.default_rng(0))
    sets = prepared.sets["train"], prepared.sets["validation"]
    units = units_of([effect(name) for name in NAMES], system.robot)
    dry = [u for u in units if u.name == "coulomb_friction" and u.where in {"shoulder", "elbow"}]
    both = dict.fromkeys(dry, 0.1)
    return sets, units, judged_fits(*sets, [Point(prepared.nominal.point.z, both)])[0]


TRUE = {("coulomb_friction", "elbow"), ("action_gain", "first")}


def test_a_gain_stands_in_for_friction_at_the_joint_where_it_has_little_to_do():
    sets, units, best = fitted([0.0, 0.3], 0.97)
    assert {unit.name for unit in best.units} == {"coulomb_friction"}
    found = without_weaker_places(sets, best, units, units)
    assert {(u.name, u.where) for u in found.units} == TRUE
    assert best.deviances().sum() - found.deviances().sum() > LIKELY
    strengths = {unit.name: s for unit, s in found.fit.point.strengths.items()}
    assert strengths["action_gain"] == pytest.approx(-0.03, abs=0.01)


@pytest.mark.parametrize("friction", [[0.2, 0.3], [0.02, 0.3]])
def test_friction_that_is_at_both_joints_stays(friction):
    sets, units, best = fitted(friction, 1.0)
    assert without_weaker_places(sets, best, units, units) is best


def test_a_search_looks_at_weaker_places_unless_what_varies_is_noise(monkeypatch):
    sets, units, both = fitted([0.0, 0.3], 0.97)
    start = judged_fits(*sets, [Point(both.fit.point.z, {})])[0]
    monkeypatch.setattr(Search, "best", lambda self: self.screens.append(None) or both)
    monkeypatch.setattr("torchrl_bayessim.diagnosis.selection.alternatives", lambda *_, **__: {})
    chosen = partial(select, *sets, start.fit, units, pairs=False)
    found = chosen(generator=np.random.default_rng(0)).best
    assert {(u.name, u.where) for u in found.units} == TRUE
    assert chosen(generator=np.random.default_rng(0), varied=True).best is both
