"""A block that rests on a plane: its measured height is noisier than contact allows."""

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim import diagnose
from torchrl_bayessim.diagnosis.contacts import likelier, resting, settled
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

BLOCK = """
<mujoco><option timestep=".001" integrator="implicitfast"/><worldbody>
  <geom type="plane" size="5 5 .1" friction=".4"/>
  <body name="block" pos="0 0 .05"><joint name="x" type="slide" axis="1 0 0" damping=".2"/>
    <joint name="z" type="slide" axis="0 0 1"/>
    <geom type="box" size=".05 .05 .05" mass="1" friction=".4"/></body>
</worldbody><actuator><motor name="push" joint="x" ctrlrange="-12 12"/></actuator></mujoco>
"""
NOISE = np.array([5e-4, 5e-4, 0.01, 0.01])  # m, m/s
EFFECTS = "contact_friction", "coulomb_friction", "action_gain", "sensor_dropout"


@cache
def system():
    task = Task(model=mujoco.MjModel.from_xml_string(BLOCK), frame_skip=10)
    names = "body_mass[block]", "dof_damping[x]"
    return System(
        task=task,
        columns=Columns(
            "t", {"x": ("qx",), "z": ("qz",)}, {"x": ("vx",), "z": ("vz",)}, {"push": "u"}
        ),
        physics=MujocoPhysics(*names),
        prior=BoxPrior({names[0]: (0.7, 1.4), names[1]: (0.05, 0.6)}),
    )


def recorded(run, *, friction=0.4, rows=120):
    """Return a log, and the states as they were."""
    rng = np.random.default_rng(run)
    model = mujoco.MjModel.from_xml_string(BLOCK)
    model.geom_friction[:, 0] = friction
    data, t = mujoco.MjData(model), 0.01 * np.arange(rows)
    frequency, phase = rng.uniform(0.2, 2.5, (2, 3, 1))
    size = rng.normal(size=(3, 1))
    u = np.clip(5 * (size * np.sin(2 * np.pi * frequency * t + 6 * phase)).sum(0), -12, 12)
    states = np.empty((rows, 4))
    for k in range(rows):
        states[k] = np.r_[data.qpos, data.qvel]
        data.ctrl[:] = u[k]
        mujoco.mj_step(model, data, 10)
    measured = torch.from_numpy(states + NOISE * rng.normal(size=states.shape))
    log = Log(
        name=f"run {run}",
        time=torch.from_numpy(t),
        qpos=measured[:, :2],
        qvel=measured[:, 2:],
        ctrl=torch.from_numpy(u)[:, None],
        velocity_gain=torch.zeros(2).double(),
        measured=torch.ones(4, dtype=torch.bool),
    )
    return log, states


def test_starts_in_contact_have_the_depth_that_the_simulator_has():
    runs = [recorded(run) for run in range(2)]
    logs = [log for log, _ in runs]
    theta = np.array([1.0, 0.2])
    found = settled(Predictor(system()), logs, theta=theta, noise=NOISE)
    before, after = [], []
    for log, (_, states) in zip(found, runs, strict=True):
        assert log.touching is not None
        step = log.touching.step
        wrong = log.qpos[:, 1].numpy() - states[:, 1]
        before.append(wrong[20:])
        after.append((wrong + step[:, 1])[20:])
        assert not step[:, [0, 2]].any()  # along the plane nothing is known better
    assert np.sqrt(np.mean(np.square(after))) < 0.5 * np.sqrt(np.mean(np.square(before)))


def test_a_filter_is_believed_only_where_it_makes_predictions_likelier():
    logs = [recorded(run)[0] for run in range(3)]
    known = {"theta": np.array([1.0, 0.2]), "noise": NOISE}
    predictor = Predictor(system())
    right = settled(predictor, logs, **known)
    assert likelier(predictor, logs, right, **known)
    assert not likelier(predictor, right, logs, **known)
    thrown = np.array([0.0, 0.0, 0.0, 0.5])  # m/s
    wrong = [
        replace(log, touching=log.touching._replace(step=log.touching.step + thrown))
        for log in right
    ]
    assert not likelier(predictor, logs, wrong, **known)


@pytest.mark.slow
def test_a_mass_and_an_armature_are_not_taken_for_friction_of_the_contact():
    logs = [recorded(70 + k, friction=0.28, rows=250)[0] for k in range(5)]
    effects = "contact_friction", "armature"
    report = diagnose(system(), None, logs, effects=effects)
    assert report.effects[0].name == "contact_friction"
    assert report.effects[0].strength == pytest.approx(-0.3, abs=0.1)
    assert report.where["channel"]["contact"] > 0.5
    assert sum(joint["share"] for joint in report.where["joints"]) == pytest.approx(1.0)


def test_what_rests_is_told_from_what_slides_and_from_what_flies():
    log, _ = recorded(0)
    still = resting(Predictor(system()), [log], noise=NOISE)
    assert still.tolist() == [False, True, False, True]  # x, z, and their velocities
    log.qpos[:, 1] += 1.0
    assert not resting(Predictor(system()), [log], noise=NOISE).any()


def test_a_robot_in_the_air_starts_where_it_was_measured():
    log, _ = recorded(0)
    log.qpos[:, 1] += 1.0
    assert settled(Predictor(system()), [log], theta=np.array([1.0, 0.2]), noise=NOISE) == [log]


def test_a_block_at_rest_on_a_plane_lacks_nothing():
    report = diagnose(system(), None, [recorded(k)[0] for k in range(5)], effects=EFFECTS)
    assert report.verdict == "none"


@pytest.mark.parametrize("first", [0, pytest.param(10, marks=pytest.mark.slow)])
def test_friction_of_a_contact_is_not_excluded(first):
    logs = [recorded(first + k, friction=0.55)[0] for k in range(8)]
    report = diagnose(system(), None, logs, effects=EFFECTS)
    assert report.verdict in {"named", "named_partial", "ambiguous"}
    assert "contact_friction" in report.confusion_set
