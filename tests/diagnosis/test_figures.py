"""What is drawn is what was found, and the whole of it is plain numbers."""

import json

import mujoco
import numpy as np
import pytest
import torch
from one_joint_arm import ARM, FRICTION

from torchrl_bayessim.diagnosis.divergence import divergence_alarms
from torchrl_bayessim.diagnosis.figures import figures
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.diagnosis.selection import select
from torchrl_bayessim.diagnosis.shrinkage import Shrinkage, shrinkage
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

NOISE = {"q": 0.001, "qd": 0.02}


def arm():
    model = mujoco.MjModel.from_xml_string(ARM)
    columns = Columns("t", {"hinge": ("q",)}, {"hinge": ("qd",)}, {"motor": "tau"})
    return System(
        task=Task(model=model, frame_skip=2),
        columns=columns,
        physics=MujocoPhysics("body_mass[link]"),
        prior=BoxPrior({"body_mass[link]": (0.3, 0.8)}),
        noise=NOISE,
    )


def logged(seed, rows=160):
    """Return a log of an arm with dry friction, driven by a sum of sines."""
    generator = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(ARM)
    model.dof_frictionloss[:] = FRICTION
    data = mujoco.MjData(model)
    frequency, phase = generator.uniform(0.5, 3.0, 4), generator.uniform(0.0, 6.0, 4)
    time = 0.01 * np.arange(rows)
    torque = 0.6 * np.sin(2 * np.pi * frequency * time[:, None] + phase).sum(1)
    state = np.empty((rows, 2))
    for k in range(rows):
        state[k] = data.qpos[0], data.qvel[0]
        data.ctrl[0] = torque[k]
        mujoco.mj_step(model, data, 2)
    state += generator.standard_normal(state.shape) * list(NOISE.values())
    columns = (torch.from_numpy(c) for c in (time, state[:, :1], state[:, 1:], torque[:, None]))
    return Log(
        name=f"run{seed}",
        **dict(zip(("time", "qpos", "qvel", "ctrl"), columns, strict=True)),
        velocity_gain=torch.zeros(1).double(),
        measured=torch.ones(2, dtype=torch.bool),
    )


@pytest.fixture(scope="module")
def searched():
    system = arm()
    units = units_of([effect("coulomb_friction"), effect("action_bias")], system.robot)
    generator = np.random.default_rng(0)
    logs = [logged(seed) for seed in range(4)]
    prepared = prepare(system, logs, units, generator=generator, horizon=20)
    train, judged = prepared.sets["train"], prepared.sets["validation"]
    return prepared, select(train, judged, prepared.nominal, units, generator=generator)


@pytest.fixture(scope="module")
def drawn(searched):
    prepared, selection = searched
    nominal, best = selection.nominal.fit.point, selection.best.fit.point
    points = [Point(np.zeros_like(nominal.z)), nominal, best]
    measured = shrinkage(prepared.sets["test"], points, np.random.default_rng(0))
    return figures(prepared, selection, measured)


def test_figures_are_in_units_of_the_floor(searched):
    """Covariances that allow for more than there is leave a perfect simulator less than 1."""
    prepared, selection = searched
    points = [Point(np.zeros_like(selection.best.fit.point.z)), selection.nominal.fit.point]
    points.append(selection.best.fit.point)
    plain, halved = (
        shrinkage(prepared.sets["test"], points, np.random.default_rng(0), floor=floor)
        for floor in (1.0, 0.5)
    )
    assert halved.refit == pytest.approx(2 * plain.refit)
    assert halved.effects == pytest.approx(2 * plain.effects)
    expected = (halved.refit - halved.effects) / (halved.refit - 1.0)
    assert halved.explained == pytest.approx(expected)


def test_all_of_the_gap_is_never_sure(searched):
    """The floor itself is known to a few per cent only, and other runs are other motions."""
    prepared, selection = searched
    points = [Point(np.zeros_like(selection.best.fit.point.z)), selection.nominal.fit.point]
    points.append(selection.best.fit.point)
    measured = shrinkage(
        prepared.sets["test"],
        points,
        np.random.default_rng(0),
        beside=prepared.sets["validation"],
    )
    low, high = measured.explained_ci
    assert 0.9 < low < measured.explained <= high <= 1.0
    assert low < 0.9999


@pytest.mark.parametrize(
    ("own", "elsewhere"),
    [
        ((0.85, 0.92), (0.75, 0.96)),
        ((0.9, 0.9), (0.89, 0.91)),
        ((0.4, 1.0), (0.0, 1.0)),
        ((-0.2, 0.95), (-0.2, 1.0)),
    ],
)
def test_the_share_explained_is_less_sure_for_motions_that_were_not_recorded(own, elsewhere):
    measured = Shrinkage(9.0, 5.0, 1.4, 0.9, own, (3.5, 4.5), (0.2, 0.6))
    assert measured.elsewhere == pytest.approx(elsewhere)


def test_they_are_plain_numbers(drawn):
    text = json.dumps(drawn, allow_nan=False)
    assert json.loads(text) == drawn


def test_the_worst_segments_are_of_test_runs_and_hold_what_was_logged(searched, drawn):
    prepared, _ = searched
    assert len(drawn["segments"]) == 3
    for segment in drawn["segments"]:
        assert segment["log"] in prepared.names["test"]
        assert len(segment["time"]) == prepared.horizon
        log = logged(int(segment["log"].removeprefix("run")))
        first = round(segment["time"][0] / 0.01)
        position, velocity = segment["channels"]
        part = slice(first, first + prepared.horizon)
        assert position["real"] == log.qpos[part, 0].tolist()
        assert velocity["real"] == log.qvel[part, 0].tolist()


def test_with_the_effect_the_simulation_follows_the_robot(drawn):
    for segment in drawn["segments"]:
        for channel in segment["channels"]:
            real = np.array(channel["real"])
            without, with_it = (
                np.abs(np.array(channel[name]) - real).max() for name in ("without", "with")
            )
            assert with_it < 8 * channel["noise"]
            assert with_it < without


def test_the_signature_of_dry_friction_opposes_slow_motion(drawn):
    signature = drawn["signature"]
    assert (signature["joint"], signature["unit"]) == ("hinge", "N m")
    assert signature["curves"].keys() == {"velocity", "position", "time", "command"}
    curve = signature["curves"]["velocity"]
    speed, force = (np.array(curve["before"][name]) for name in ("x", "force"))
    slow = (np.abs(speed) > 0.5) & (np.abs(speed) < 4)
    assert slow.sum() >= 2
    assert (force[slow] * speed[slow] < 0).all()
    left = np.array(curve["after"]["force"])
    assert np.abs(left).max() < 0.2 * FRICTION


def test_effects_are_as_alike_as_themselves(drawn):
    matrix = np.array(drawn["confusability"]["matrix"])
    assert sorted(drawn["confusability"]["effects"]) == [
        ["action_bias", "motor"],
        ["coulomb_friction", "hinge"],
    ]
    np.testing.assert_allclose(np.diag(matrix), 1.0, atol=1e-5)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert matrix[0, 1] < 0.99


def test_heat_and_units(drawn):
    heat = drawn["heat"]
    assert heat["outputs"] == ["q", "qd"]
    assert np.array(heat["excess"]).shape == (2, len(heat["cuts"]) + 1)
    assert np.max(heat["excess"]) > 1.0
    assert drawn["units"] == {"coulomb_friction[hinge]": "N m", "action_bias[motor]": "command"}
    low, high = drawn["waterfall"]["refit"]
    assert 1.0 < low < high


def test_a_simulator_that_diverges_is_told(searched):
    prepared, selection = searched
    test, fine = prepared.sets["test"], selection.nominal.fit.point
    assert divergence_alarms(test, {"with fitted parameters": fine}) == []
    (spring,) = units_of([effect("parallel_spring")], prepared.predictor.system.robot)
    wild = Point(fine.z, {spring: -1e9})
    (alarm,) = divergence_alarms(test, {"as described": fine, "with a wild spring": wild})
    assert alarm.startswith("the simulator with a wild spring diverges on 100% of the stretches")
