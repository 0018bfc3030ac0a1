"""Dampings that bend by a power of speed, in the place of those that bend in proportion to it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from plain_models import plain
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.form_fit import _of_offered_kinds
from torchrl_bayessim.diagnosis.free_numbers import fitted_numbers
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.powers import by_power
from torchrl_bayessim.effects.friction import PowerLawFriction, QuadraticDrag
from torchrl_bayessim.effects.joints import ViscousFriction

ROBOT = system().robot
FASTEST = 4.0  # rad/s
SEGMENTS = SimpleNamespace(
    qpos=np.zeros((2, 3, 1)), qvel=np.full((2, 3, 1), FASTEST), time=np.ones((2, 3))
)
TRAIN = SimpleNamespace(
    predictor=SimpleNamespace(system=SimpleNamespace(robot=ROBOT)), segments=SEGMENTS
)


def at_hinge(effect):
    return next(unit for unit in units_of([effect], ROBOT) if unit.where == "hinge")


DRAG, STRAIGHT, BENT = (
    at_hinge(effect) for effect in (QuadraticDrag(), ViscousFriction(), ViscousFriction(-0.1))
)
POWER, ELSEWHERE = at_hinge(PowerLawFriction(0.8)), replace(STRAIGHT, where="knee")


def test_a_damping_that_was_bent_becomes_a_power_of_the_same_force():
    point = by_power(TRAIN, plain({DRAG: 0.1, BENT: 0.2}, 1000.0))
    law = next(unit for unit in point.strengths if isinstance(unit.effect, PowerLawFriction))
    assert point.strengths.keys() == {DRAG, law}
    speed = 0.3 * FASTEST
    bent = 0.2 * speed * (1 - 0.1 * speed)
    assert point.strengths[law] * speed**law.effect.power == pytest.approx(bent)
    assert law.where == BENT.where


def test_the_order_of_effects_stays():
    point = by_power(TRAIN, plain({BENT: 0.2, DRAG: 0.1}, 1000.0))
    assert [unit.name for unit in point.strengths] == ["viscous_friction", "quadratic_drag"]


@pytest.mark.parametrize(
    "units",
    [{DRAG: 0.1}, {STRAIGHT: 0.1}, {}, {POWER: 0.1}, {BENT: 0.1, ELSEWHERE: 0.1}],
    ids=["drag", "straight", "nothing", "a power already", "another damping elsewhere"],
)
def test_what_is_not_the_one_damping_that_was_bent_stays_as_it_is(units):
    assert by_power(TRAIN, plain(units, 1000.0)) is None


def test_a_power_becomes_the_offered_law_again_where_laws_are_fitted_anew():
    point = Point(np.zeros(1), {DRAG: 0.1, POWER: 0.2})
    assert _of_offered_kinds(point, [STRAIGHT, DRAG]).strengths == {DRAG: 0.1, STRAIGHT: 0.2}
    kept = _of_offered_kinds(point, [STRAIGHT, POWER, DRAG]).strengths
    assert kept == point.strengths  # it was offered itself
    assert _of_offered_kinds(point, [DRAG]).strengths == point.strengths


def test_a_power_that_was_fitted_counts_as_a_number():
    """A law of the same name was offered, with no such number."""
    assert fitted_numbers(plain({POWER: 0.1}, 1000.0), [STRAIGHT]) == 2
    assert fitted_numbers(plain({POWER: 0.1}, 1000.0), [DRAG]) == 1


def test_drag_that_takes_all_of_a_motor_at_the_largest_speed_is_told_alone_and_as_strong():
    """In a narrower range other effects would make up for what it may not be."""
    largest, fastest = ROBOT.force_scale[0].item(), ROBOT.velocity_scale[0].item()
    strong = largest / fastest**2
    assert DRAG.high == pytest.approx(strong)
    names = ["quadratic_drag", "viscous_friction", "parallel_spring", "time_scale", "action_gain"]
    data = logs(push=lambda _, v: -strong * v * abs(v))
    (drag,) = diagnose(system(), None, data, effects=names).effects
    assert drag.name == "quadratic_drag"
    assert drag.strength == pytest.approx(strong, rel=0.03)
