"""Friction at two joints, at one of which it stands for another cause."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.diagnosis.model import LIKELY, judged_fits
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.diagnosis.weaker_places import at_weaker_places
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


def fitted(friction, gain):
    """Return sets of segments, units, and a model with friction at both joints."""
    rng = np.random.default_rng(0)
    task = Task(model=mujoco.MjModel.from_xml_string(TWO), frame_skip=8)
    system = System(task=task, physics=MujocoPhysics(*BOUNDS), prior=BoxPrior(BOUNDS))
    logs = [run(rng, friction, gain) for _ in range(6)]
    prepared = prepare(system, logs, [], generator=rng)
    sets = prepared.sets["train"], prepared.sets["validation"]
    names = "coulomb_friction", "action_gain", "parallel_spring", "constant_force"
    units = units_of([effect(name) for name in names], system.robot)
    both = {
        u: 0.1 for u in units if u.name == "coulomb_friction" and u.where in system.robot.joints
    }
    assert len(both) == 2
    return sets, units, judged_fits(*sets, [Point(prepared.nominal.point.z, both)])[0]


def test_a_gain_stands_in_for_friction_at_the_joint_where_it_has_little_to_do():
    sets, units, best = fitted([0.0, 0.3], 0.97)
    found = at_weaker_places(sets, best, units)
    first, *others = sorted(found, key=lambda m: m.deviances().sum())
    assert {(u.name, u.where) for u in first.units} == {
        ("coulomb_friction", "elbow"), ("action_gain", "first"),
    }  # fmt: skip
    assert best.deviances().sum() - first.deviances().sum() > LIKELY
    strengths = {unit.name: s for unit, s in first.fit.point.strengths.items()}
    assert strengths["action_gain"] == pytest.approx(-0.03, abs=0.01)
    assert all(len(model.units) == 2 for model in others)


def test_friction_that_is_at_both_joints_is_not_touched():
    sets, units, best = fitted([0.2, 0.3], 1.0)
    assert at_weaker_places(sets, best, units) == []
