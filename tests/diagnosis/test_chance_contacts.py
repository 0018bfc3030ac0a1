"""Where contacts are met by chance, noise makes what a covariance of another simulator denies."""

import importlib
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.diagnosis.chance_contacts import trusted_less
from torchrl_bayessim.diagnosis.modes import Mode
from torchrl_bayessim.diagnosis.objective import Objective, Point, units_of
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.preparation import Prepared, Started
from torchrl_bayessim.diagnosis.prepared_anew import with_less_trust, with_other_logs
from torchrl_bayessim.diagnosis.refit import refit
from torchrl_bayessim.diagnosis.segments import cut_for_fits
from torchrl_bayessim.diagnosis.whitening import whitening
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.replay import Replay

# by its path, since the package has a function of that name
diagnose = importlib.import_module("torchrl_bayessim.diagnosis.diagnose")
NOISE = np.repeat([0.002, 0.02], 9)
PHYSICS = MujocoPhysics("body_mass[torso]", "dof_damping[bfoot]")
TRUE, ELSEWHERE = (6.0, 3.0), (6.4, 3.3)


def running(seed, damping=TRUE[1]):
    """Return logs of a robot that runs on its feet, twelve runs of 70 rows."""
    generator = torch.Generator().manual_seed(seed)
    held = torch.rand(12, 12, 6, generator=generator) * 2 - 1
    actions = held.repeat_interleave(6, 1)[:, :70]
    start = {"qpos": torch.zeros(12, 9), "qvel": torch.zeros(12, 9), "action": actions}
    robot = Replay("HalfCheetah-v5", start, physics=PHYSICS)
    moved = robot(torch.tensor([[TRUE[0], damping]]))[0]
    wide = torch.tensor(NOISE) * torch.randn(12, 70, 18, generator=generator).double()
    return [
        Log(
            name=f"run{i}",
            time=0.05 * torch.arange(69, dtype=torch.float64),
            qpos=moved["qpos"][i, :-1] + wide[i, :69, :9],
            qvel=moved["qvel"][i, :-1] + wide[i, :69, 9:],
            ctrl=actions[i, 1:].double(),
            velocity_gain=torch.zeros(9, dtype=torch.float64),
            measured=torch.ones(18, dtype=torch.bool),
        )
        for i in range(12)
    ]


def seen_from_elsewhere(logs):
    """Return the objective with the covariance at other parameters, and the true ones."""
    prior = BoxPrior({"body_mass[torso]": (4.5, 9.0), "dof_damping[bfoot]": (1.0, 10.0)})
    system = System(task=known_task("HalfCheetah-v5"), physics=PHYSICS, prior=prior)
    predictor = Predictor(system, threads=1)
    segments = cut_for_fits(logs, 10, history=8, most=70)
    rng = np.random.default_rng(0)
    white = whitening(predictor, segments, np.array(ELSEWHERE), NOISE, generator=rng)
    objective = Objective(predictor, prior, segments, white)
    low, high = prior.low.numpy(), prior.high.numpy()
    z = np.sqrt(12) * ((np.array(TRUE) - low) / (high - low) - 0.5)
    point = Point(np.r_[z, 0.0])
    np.testing.assert_allclose(objective.theta(point.z[None])[0], TRUE)
    return objective, point


def squares(objective, point):
    return (objective([point])[0] ** 2).mean(-1)


@pytest.mark.parametrize("seed", [3, 10, 14])
def test_of_clean_data_nothing_but_noise_is_left(seed):
    objective, point = seen_from_elsewhere(running(seed))
    before = squares(objective, point)
    assert before.mean() > 2.0
    assert before.max() > 20.0
    less = trusted_less(objective, point, noise=NOISE, generator=np.random.default_rng(1))
    after = squares(less, point)
    assert after.mean() < 1.4
    assert (before[before < 3.0] == after[before < 3.0]).all()


def test_what_a_robot_lacks_is_not_put_down_to_chance():
    objective, point = seen_from_elsewhere(running(0, damping=12.0))
    assert np.median(squares(objective, point)) > 3.0  # everywhere: no draws are needed
    generator = np.random.default_rng(1)
    assert trusted_less(objective, point, noise=NOISE, generator=generator) is None
    assert generator.bit_generator.state == np.random.default_rng(1).bit_generator.state


@pytest.mark.parametrize(("seed", "damping"), [(3, 4.0), (3, 7.0), (14, 4.0)])
def test_of_what_a_robot_lacks_chancy_segments_keep_what_no_draw_makes(seed, damping):
    objective, point = seen_from_elsewhere(running(seed, damping=damping))
    clean, _ = seen_from_elsewhere(running(seed))
    draw = lambda: np.random.default_rng(1)
    less = trusted_less(objective, point, noise=NOISE, generator=draw()) or objective
    nothing = trusted_less(clean, point, noise=NOISE, generator=draw())
    assert squares(less, point).mean() > 1.5 * squares(nothing, point).mean()
    assert squares(less, point).max() > 3.0


BOXES = """
<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body name="sled"><joint name="x" type="slide" axis="1 0 0"/>
    <joint name="y" type="slide" axis="0 1 0"/><geom type="box" size=".05 .05 .05" mass="1"/></body>
  <body name="block" pos=".11 .1 0"><joint name="block" type="slide" axis="1 0 0"/>
    <geom type="box" size=".05 .05 .05" mass="1"/></body>
</worldbody><actuator><motor name="push" joint="x" ctrlrange="-1 1"/></actuator></mujoco>
"""
SLED = np.repeat([0.002, 0.002], 3)


def sliding(*, true, shown, pushed=0.0):
    """Return a run whose first segment starts elsewhere across the track than it is shown to."""
    task = Task(model=mujoco.MjModel.from_xml_string(BOXES), frame_skip=10)
    data, rows = mujoco.MjData(task.model), []
    data.qpos[:], data.qvel[:] = [0.0, true, 0.0], [0.1, 0.0, 0.0]
    for row in range(11):
        rows.append(np.r_[data.qpos, data.qvel])
        data.qvel[0] += pushed * (row == 5)
        mujoco.mj_step(task.model, data, task.frame_skip)
    state = torch.from_numpy(np.array(rows))
    state += torch.tensor(SLED) * torch.randn(
        state.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    state[0] = torch.tensor([0.0, shown, 0.0, 0.1, 0.0, 0.0])
    return task, Log(
        name="run",
        time=task.dt * torch.arange(11).double(),
        qpos=state[:, :3],
        qvel=state[:, 3:],
        ctrl=torch.zeros(11, 1).double(),
        velocity_gain=torch.zeros(3).double(),
        measured=torch.ones(6, dtype=torch.bool),
    )


def of_sleds(task, log, *, steps=10):
    """Return the objective of a run beside three of which the simulator is right, one that hits."""
    logs = [log, *(sliding(true=y, shown=y)[1] for y in (-0.02, -0.02, 0.02))]
    predictor = Predictor(System(task=task))
    segments = cut_for_fits(logs, steps, history=0, most=40)
    white = whitening(predictor, segments, np.zeros(0), SLED, generator=np.random.default_rng(0))
    objective, point = Objective(predictor, None, segments, white), Point(np.zeros(1))
    loud = squares(objective, point) > 3.0
    assert loud.any()
    assert not loud[segments.log > 0].any()
    return objective, point


@pytest.mark.parametrize(
    ("true", "shown", "pushed", "chance"),
    [(0.0005, -0.0047, 0.0, True), (-0.02, -0.02, 0.1, False), (0.02, -0.02, 0.0, False)],
    ids=["hit by chance", "pushed", "hit by no chance"],
)
def test_a_block_that_is_hit_once_in_hundreds_of_draws(true, shown, pushed, chance):
    objective, point = of_sleds(*sliding(true=true, shown=shown, pushed=pushed))
    less = trusted_less(objective, point, noise=SLED, generator=np.random.default_rng(1))
    assert (less is not None) == chance
    if chance:
        assert squares(less, point)[0] < 2.0


def test_a_push_is_no_chance_though_the_loudest_of_a_thousand_draws_comes_near_it():
    """Few numbers of a segment are loud once in so many draws without any contact."""
    objective, point = of_sleds(*sliding(true=-0.02, shown=-0.02, pushed=0.03), steps=3)
    for seed in range(5):
        generator = np.random.default_rng(seed)
        assert trusted_less(objective, point, noise=SLED, generator=generator) is None


def test_a_draw_that_diverges_says_nothing(monkeypatch):
    objective, point = of_sleds(*sliding(true=-0.02, shown=-0.02, pushed=0.1))
    simulated = Objective.raw

    def one_diverges(self, points, offsets=None):
        residual = simulated(self, points, offsets)
        if len(points) > 1:
            residual[-1, :, -1] = np.nan
        return residual

    monkeypatch.setattr(Objective, "raw", one_diverges)
    generator = np.random.default_rng(1)
    assert trusted_less(objective, point, noise=SLED, generator=generator) is None


def test_the_same_noise_is_drawn_for_the_same_seed():
    objective, point = seen_from_elsewhere(running(3))
    one, two = (
        trusted_less(objective, point, noise=NOISE, generator=np.random.default_rng(1))
        for _ in range(2)
    )
    np.testing.assert_array_equal(one.whitening.inverse, two.whitening.inverse)


def test_a_robot_that_touches_nothing_is_trusted(monkeypatch):
    objective, point = seen_from_elsewhere(running(0))
    monkeypatch.setattr(Predictor, "colliding", False)
    generator = np.random.default_rng(1)
    assert trusted_less(objective, point, noise=NOISE, generator=generator) is None
    assert generator.bit_generator.state == np.random.default_rng(1).bit_generator.state


def test_beside_what_was_found_segments_are_trusted_less_and_parameters_fitted_again():
    objective, point = seen_from_elsewhere(running(3))
    nominal = refit(objective, [point], iterations=0)[0]
    sets, mode = {"train": objective}, Mode()
    prepared = Prepared(objective.predictor, sets, {}, NOISE, "", 10, nominal, (), mode)
    draw = lambda: np.random.default_rng(1)
    assert with_less_trust(prepared, point, generator=draw()) is None  # nothing was found
    unit = units_of([effect("viscous_friction")], objective.predictor.system.robot)[0]
    found = Point(point.z, {unit: 1e-6})
    less = with_less_trust(prepared, found, generator=draw())
    assert squares(less.sets["train"], found).mean() < 1.4
    again = refit(less.sets["train"], [less.nominal.point], iterations=0)[0]
    np.testing.assert_allclose(less.nominal.innovations, again.innovations, atol=1e-6)


def test_what_was_put_down_to_chance_still_is_where_logs_or_noise_are_others(monkeypatch):
    objective, point = seen_from_elsewhere(running(3))
    nominal = refit(objective, [point], iterations=0)[0]
    prepared = Prepared(
        objective.predictor, {"train": objective}, {}, NOISE, "", 10, nominal, (), Mode()
    )
    monkeypatch.setattr(Started, "fitted", lambda *_: prepared)
    monkeypatch.setattr(Mode, "noise", lambda *_, **__: (NOISE, ""))
    anew = lambda before: with_other_logs(before, {"train": []}, generator=np.random.default_rng(1))
    assert anew(prepared) is prepared
    unit = units_of([effect("viscous_friction")], objective.predictor.system.robot)[0]
    found = Point(point.z, {unit: 1e-6})
    again = anew(replace(prepared, beside=found))
    assert again.beside is found
    assert squares(again.sets["train"], found).mean() < 1.4


def test_segments_that_are_trusted_less_do_not_count_for_less_twice():
    objective, point = seen_from_elsewhere(running(3))
    robust = objective.weighted(point)
    loud = squares(objective, point) > 20.0
    assert (robust.whitening.weights[loud] < 0.6).all()
    less = trusted_less(robust, point, noise=NOISE, generator=np.random.default_rng(1))
    trusted = less.whitening.weights
    assert trusted[loud].mean() > 2 * robust.whitening.weights[loud].mean()
    assert trusted.max() == 1.0


@pytest.mark.parametrize(("left", "searched"), [(3.0, 2), (1.5, 1)])
def test_only_where_much_is_left_a_search_goes_on(monkeypatch, left, searched):
    model = SimpleNamespace(mean_square=left, fit=SimpleNamespace(point=None))
    selection, calls = SimpleNamespace(best=model), []

    def search(prepared, known=None):
        calls.append((prepared, known))
        return prepared, selection

    started = SimpleNamespace(alarms=("one",))
    monkeypatch.setattr(diagnose, "with_less_trust", lambda *_, **__: "less")
    monkeypatch.setattr(diagnose, "with_less_noise", lambda *_, **__: None)
    alarms, prepared, _ = diagnose._beside_noise(search, started, np.random.default_rng(0))
    assert alarms == ("one",)
    assert calls == [(started, None), ("less", selection)][:searched]
    assert prepared == calls[-1][0]


@pytest.fixture(autouse=True)
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
