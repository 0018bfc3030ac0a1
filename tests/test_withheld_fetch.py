"""The blind check's Fetch: it moves as Gymnasium's own, and the diagnosis can read its cases."""

import itertools
from dataclasses import replace
from pathlib import Path

import gymnasium
import gymnasium_robotics
import numpy as np
import pytest

from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.logs.read import read_logs
from torchrl_bayessim.logs.system import System

gymnasium.register_envs(gymnasium_robotics)
RECIPES = Path(__file__).parent.parent / "recipes"
STILL = 4  # degrees of freedom that stand still, the first ones


@pytest.fixture(autouse=True)
def recipes_on_path(monkeypatch):
    monkeypatch.syspath_prepend(RECIPES)


@pytest.fixture
def drawn(recipes_on_path, monkeypatch):
    """Return cases of two short motions, of which nobody asks how visible their cause is."""
    from withheld import cases

    moved = cases._motions
    few = lambda *given, count, **options: moved(*given, count=2, **options)
    short = replace(cases.ROBOTS["fetch_push"], steps=(30, 30))
    monkeypatch.setattr(cases, "_motions", few)
    monkeypatch.setattr(cases, "detectability", lambda *_, **__: 1.0)
    monkeypatch.setitem(cases.ROBOTS, "fetch_push", short)

    def draw(*names, tier="T1", seed=0):
        plan = cases.Plan(tier, "fetch_push", names)
        return cases.make(plan, np.random.default_rng(seed))

    return draw


def fetch(*causes):
    from withheld.fetch_push import fetch_push_model
    from withheld.plant_fetch import FetchPlant

    return FetchPlant(fetch_push_model(), 0.04, causes, np.zeros(42), np.random.default_rng(0))


def test_without_causes_it_is_gymnasium_s_own_simulator():
    from withheld.coordinates import coordinates

    env, robot = gymnasium.make("FetchPush-v4").unwrapped, fetch()
    env.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-1.2, 1.2, (20, 4))
    start, expected = coordinates(robot.model, env.data.qpos), []
    v = env.data.qvel.copy()
    for action in actions:
        expected.append(np.r_[coordinates(robot.model, env.data.qpos), env.data.qvel])
        env.step(action)
    seen = robot.run(start, v, lambda k, _: actions[k], steps=20).clean
    np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-6)
    assert np.ptp(seen[:, 6:13], axis=0).min() > 1e-3


def test_predictions_go_as_the_plant_does():
    from withheld.coordinates import coordinates
    from withheld.fetch_push import start
    from withheld.plant_fetch import dragged

    robot, actions = fetch(), np.random.default_rng(1).uniform(-1, 1, (12, 4))
    qpos, v = start()
    q = coordinates(robot.model, qpos)
    clean = robot.run(q, v, lambda k, _: actions[k], steps=12).clean
    found = dragged(fetch().model, clean[[2, 4]], np.stack([actions[2:9], actions[4:11]]), 20)
    for rows, k in zip(found, (3, 5), strict=True):
        # MuJoCo's solver begins elsewhere, and ends within its tolerance
        np.testing.assert_allclose(rows[:, :21], clean[k : k + 7, :21], rtol=0, atol=1e-5)


def test_the_object_is_pushed_about_and_stays_where_it_can_be_reached():
    from withheld.pushing import pushes

    rng = np.random.default_rng(0)
    motions = pushes(fetch(), fetch().model, [True, False] * 3, steps=55, rng=rng)
    for motion in motions:
        place = motion.clean[:, 15:17] - motion.clean[0, 15:17]
        assert 0.03 < np.linalg.norm(place, axis=1).max() < 0.15
        assert motion.clean[:, 17].min() > 0.4  # on the table
        assert np.abs(motion.ctrl).max() <= 1.0
        assert np.abs(motion.ctrl[:, :3]).mean(0).min() > 0.05


def test_the_diagnosis_reads_a_case_and_its_simulator_goes_as_the_robot_did(drawn, tmp_path):
    from withheld import folders

    case = drawn(tier="T0")
    assert set(case.theta) == {"body_mass[object0]"}
    quiet = tuple(replace(motion, measured=motion.clean) for motion in case.motions)
    for name, text in folders.handed_over(replace(case, motions=quiet)).items():
        (tmp_path / name).write_text(text)
    system = System.load(tmp_path / "system.yaml")
    logs = read_logs(tmp_path, system)
    assert [len(log) for log in logs] == [30, 30]
    assert system.robot.actuators == ("action0", "action1", "action2", "action3")
    assert len(system.robot.channels) == 42
    np.testing.assert_allclose(logs[0].qvel.numpy(), quiet[0].clean[:, 21:], rtol=1e-8)
    predictor = Predictor(system, threads=1)
    predictor.exactly()
    theta = np.array([list(case.theta.values())])
    missed = predictor.residuals(cut(logs, 4, history=2), theta)
    assert np.abs(missed).max() < 1e-4


def test_what_stands_still_is_measured_without_noise(drawn):
    import yaml
    from withheld import folders

    every = (drawn(seed=seed) for seed in itertools.count())
    case = next(case for case in every if case.noise is not None)
    noise = yaml.safe_load(folders.handed_over(case)["system.yaml"])["noise"]
    assert list(noise.values()) == case.noise.tolist()
    assert {name for name, value in noise.items() if value == 0.0} == {
        f"{kind}_robot0:{joint}"
        for kind in "qv"
        for joint in ("slide0", "slide1", "slide2", "torso_lift_joint")
    }
    assert 1e-3 <= noise["object0:joint rotation z"] <= 3e-3
    assert 1e-4 <= noise["q_robot0:elbow_flex_joint"] <= 3e-4
    for motion in case.motions:
        off = np.abs(motion.measured - motion.clean)
        assert off[:, [*range(STILL), *range(21, 21 + STILL)]].max() == 0.0
        assert off[:, STILL:21].min(0).max() > 0


def test_places_are_commands_encoders_and_the_object(drawn, tmp_path):
    from withheld import folders

    expected = {
        "payload": ["object0:joint", "object0"],
        "contact_friction": [],
        "action_delay": [],
    }
    for name, places in expected.items():
        assert folders.label(drawn(name))["truths"][0]["places"] == places
    (place,) = folders.label(drawn("action_lag"))["truths"][0]["places"]
    assert place in {"action0", "action1", "action2"}
    joint, body = folders.label(drawn("sensor_bias"))["truths"][0]["places"]
    assert joint.replace("joint", "link") == body
    # nothing tells a payload from a mass: there is no parameter then
    for name, text in folders.handed_over(drawn("payload")).items():
        (tmp_path / name).write_text(text)
    assert System.load(tmp_path / "system.yaml").prior is None


def test_only_causes_that_it_can_show_are_drawn_and_considered(drawn):
    from withheld.plans import applicable, plans
    from withheld.robots import ROBOTS

    effects = ROBOTS["fetch_push"].effects
    for form in ("same", "other"):
        assert set(applicable("fetch_push", form)) < set(effects)
    assert drawn(tier="T0").effects == effects
    withheld = drawn("contact_friction", tier="T3").effects
    assert set(withheld) == set(effects) - {"contact_friction", "contact_softness"}
    tiers = {"T0": 1, "T4": 2, "T6": 2, "T6B": 1, "controls": 1}
    found = plans(tiers, ["fetch_push"], np.random.default_rng(0))
    assert sorted(plan.tier for plan in found) == [
        *("T0", "T6", "T6", "noise", "parameters", "shuffled")
    ]
