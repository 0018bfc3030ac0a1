"""The blind check reads and places robots in tangent coordinates, free bodies among them."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

RECIPES = Path(__file__).parent.parent / "recipes"
BODIES = """<mujoco><worldbody>
  <body pos="1 0 0"><joint type="slide"/><geom size="0.1"/></body>
  <body><freejoint/><geom size="0.1"/></body>
</worldbody></mujoco>"""


@pytest.fixture(autouse=True)
def recipes_on_path(monkeypatch):
    monkeypatch.syspath_prepend(RECIPES)


def test_coordinates_and_positions_are_of_each_other():
    from withheld.coordinates import coordinates, displaced, positions

    model, y = mujoco.MjModel.from_xml_string(BODIES), np.array([0.1, 1, 2, 3, 0.3, -0.2, 0.5])
    qpos = positions(model, y)
    np.testing.assert_array_equal(qpos[:4], y[:4])
    assert np.linalg.norm(qpos[4:]) == pytest.approx(1.0)
    np.testing.assert_allclose(coordinates(model, qpos), y, atol=1e-12)
    yawed = np.array([0.0, 0, 0, 0, 0, 0, 1.0])
    turned = displaced(model, yawed, np.array([1.0, 1, 1, 1, 0, 0, 0.5]))
    np.testing.assert_allclose(turned, [1.0, 1, 1, 1, 0, 0, 1.5], atol=1e-12)


def test_a_free_body_falls_and_turns_on_and_is_measured_with_the_noise_told():
    from withheld.plant import Plant

    noise = np.repeat([1e-3, 1e-2], 7)
    model = mujoco.MjModel.from_xml_string(BODIES)
    plant = Plant(model, 0.1, [], noise, np.random.default_rng(0))
    start, v = np.zeros(7), np.array([0.0, 0, 0, 0, 0, 0, 2.0])
    motion = plant.run(start, v, lambda *_: np.zeros(0), steps=11)
    fallen = -9.81 / 2 * 1.0 * (1.0 + model.opt.timestep)  # of Euler steps
    np.testing.assert_allclose(motion.clean[10, [3, 6]], [fallen, 2.0], rtol=1e-6)
    off = (motion.measured - motion.clean) / noise
    assert off.std() == pytest.approx(1.0, abs=0.2)
    again = plant.follow(motion.clean, motion.ctrl, [5])
    np.testing.assert_allclose(again, motion.clean, atol=1e-9)


@pytest.mark.parametrize(
    ("robot", "cause", "known"),
    [
        ("arm", "coulomb_friction", [0.411539409, 0.0011764641, 245, 7.876888925]),
        ("half_cheetah", "sensor_bias", [7.068390803, 0.0027724850, 73, 5.988919624]),
    ],
)
def test_other_robots_are_drawn_as_before(robot, cause, known, monkeypatch):
    from withheld import cases

    monkeypatch.setattr(cases, "detectability", lambda *_, **__: 1.0)
    case = cases.make(cases.Plan("T1", robot, (cause,)), np.random.default_rng(11))
    commands = case.motions[0].ctrl
    drawn = [*case.theta.values(), case.real_noise[0], len(commands), commands.sum()]
    assert drawn == pytest.approx(known, rel=1e-6)
    assert case.effects is None
