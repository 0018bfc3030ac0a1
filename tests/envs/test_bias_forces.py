"""Gravity and inertial forces of the state that a simulation is in, against MuJoCo and by hand."""

import math

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.envs.additions import rollout_with, steps_with
from torchrl_bayessim.envs.bias_forces import BeforeStep, BiasForces, bias_force
from torchrl_bayessim.envs.model_batch import ModelBatch
from torchrl_bayessim.envs.stepper import Stepper

# two links, of masses m at distances l from their joints: an elbow without an actuator
LINKS = """
<mujoco><option timestep="0.002"/><worldbody><body><joint name="shoulder" axis="0 1 0"/>
<geom type="sphere" size=".01" pos="0 0 -.5" mass="1"/>
<body pos="0 0 -.5"><joint name="elbow" axis="0 1 0"/>
<geom type="sphere" size=".01" pos="0 0 -.4" mass="0.5"/></body></body></worldbody>
<actuator><motor joint="shoulder"/></actuator></mujoco>
"""


def links():
    return mujoco.MjModel.from_xml_string(LINKS)


def moving():
    """Return three simulations of two links that swing, with masses of their own."""
    stepper = Stepper(links(), 3, threads=1)
    stepper.models.write("body_mass", (2,), np.array([0.5, 1.0, 2.0]))
    stepper["qpos"][:] = [[0.3, 0.5], [-0.7, 0.2], [1.1, -0.9]]
    stepper["qvel"][:] = [[1.0, -2.0], [0.0, 0.0], [3.0, 1.0]]
    return stepper


def test_each_simulation_has_the_forces_of_its_own_physics_and_state():
    stepper = moving()
    before, table = stepper.state.copy(), stepper.models.table.copy()
    bias = BiasForces(stepper)
    forces = bias()
    # m g l sin of the elbow's angle in the world, and m l · 0.5 ω² sin of the elbow's own
    for force, mass, q, v in zip(
        forces[:, 1], (0.5, 1.0, 2.0), stepper["qpos"], stepper["qvel"], strict=True
    ):
        weight = mass * 9.81 * 0.4 * math.sin(q.sum())
        assert float(force) == pytest.approx(weight + mass * 0.4 * 0.5 * v[0] ** 2 * math.sin(q[1]))
    np.testing.assert_array_equal(bias(np.array([2, 0])), forces[[2, 0]])
    np.testing.assert_array_equal(stepper.state, before)
    np.testing.assert_array_equal(stepper.models.table, table)


def test_they_follow_what_is_written_and_how_many_there_are():
    stepper = moving()
    bias = BiasForces(stepper)
    light = bias()
    stepper.models.write("opt.gravity", (2,), np.zeros(3))
    assert bias()[1].tolist() == [0.0, 0.0]  # it stands
    assert light[1].abs().min() > 1.0
    stepper.resize(4)
    assert bias().shape == (4, 2)
    heavy = ModelBatch(links(), 4)
    heavy.write("body_mass", (2,), np.full(4, 3.0))
    stepper.use(heavy)
    stepper["qpos"][:, 1] = math.pi / 2
    np.testing.assert_allclose(bias()[:, 1], 3.0 * 9.81 * 0.4)


def test_asking_changes_nothing_of_what_follows():
    def ask(now):
        assert now.qfrc_bias.shape == now.qvel.shape
        return {}

    def ignore(now):
        return {}

    commands = np.random.default_rng(0).normal(size=(3, 20, 1))
    asked = rollout_with(moving(), [ask], commands, substeps=5)
    ignored = rollout_with(moving(), [ignore], commands, substeps=5)
    np.testing.assert_array_equal(asked, ignored)


def test_one_simulation_and_many_are_given_the_same():
    """What is added is a brake of the elbow that grows with its load."""

    def brake(now):
        load = torch.zeros_like(now.qvel)
        load[..., 1] = 0.3 * now.qfrc_bias[..., 1].abs()
        return {"dof_damping": load}

    stepper = moving()
    outputs = rollout_with(stepper, [brake], np.full((3, 40, 1), 0.4), substeps=5)
    model = stepper.models.copy_of(2)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = [1.1, -0.9], [3.0, 1.0], 0.4
    plain = mujoco.MjData(model)
    plain.qpos[:], plain.qvel[:], plain.ctrl[:] = data.qpos, data.qvel, data.ctrl
    steps_with(model, data, [brake], count=200)
    mujoco.mj_step(model, plain, nstep=200)
    np.testing.assert_allclose(outputs[2, -1, :2], data.qpos, atol=1e-12)
    assert np.abs(data.qpos - plain.qpos).max() > 0.1
    expected = torch.from_numpy(data.qfrc_bias.copy())
    mujoco.mj_forward(model, data)
    now = bias_force(model, data)
    np.testing.assert_array_equal(now, data.qfrc_bias)
    assert not torch.equal(now, expected)  # that of the last time step's beginning


def test_it_is_computed_once_and_only_if_something_looks():
    asked = []

    def bias():
        asked.append(1)
        return torch.ones(2)

    now = BeforeStep(bias, qpos=torch.zeros(2))
    assert now.qpos.tolist() == [0.0, 0.0]
    assert not asked
    assert now.qfrc_bias.tolist() == now.qfrc_bias.tolist() == [1.0, 1.0]
    assert len(asked) == 1
    with pytest.raises(AttributeError, match="something that the task reads, got 'xpos'"):
        _ = now.xpos


def test_only_those_that_are_asked_for_are_computed():
    stepper = moving()
    bias = BiasForces(stepper)
    asked = []

    def of(rows=None):
        asked.append(rows)
        return bias(rows)

    now = BeforeStep(of, qpos=torch.zeros(3, 2))
    some = torch.tensor([True, False, True])
    found = now.bias_of(some)
    assert asked[0].tolist() == [0, 2]
    np.testing.assert_array_equal(found[some], bias()[some])
    assert found[1].tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(now.bias_of(torch.tensor([1, 0, 1])), found)
    asked.pop()
    # all of them are those that others have asked for, too
    np.testing.assert_array_equal(now.bias_of(torch.ones(3, dtype=torch.bool)), bias())
    np.testing.assert_array_equal(now.bias_of(some), now.qfrc_bias)
    assert len(asked) == 2

    alone = BeforeStep(lambda: torch.ones(2), qpos=torch.zeros(2))  # one simulation, no batch
    assert alone.bias_of(torch.tensor([True, False])).tolist() == [1.0, 1.0]
