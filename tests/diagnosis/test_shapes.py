"""Forces that come again along a rail: their distance and phase are read off the missing force."""

import numpy as np
import pytest
from noisy_cheetah import cheetah
from rail_cart import cart, ride

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.shapes import _cogging, _numbers, _sine
from torchrl_bayessim.effects.disturbance import Cogging
from torchrl_bayessim.effects.effect import Reach

SOME = ("cogging", "constant_force", "coulomb_friction", "parallel_spring", "periodic_disturbance")


def test_magnets_along_a_rail_are_found_at_their_distance():
    rng = np.random.default_rng(1)
    options = {"noise": [0.0005, 0.01], "finer": 4}

    def magnets(time, position):
        return 0.4 * np.sin(31.0 * position + 1.0)  # every 20 cm

    logs = [ride(rng, 200, magnets, **options) for _ in range(6)]
    report = diagnose(cart(), None, logs, effects=SOME)
    assert [effect.name for effect in report.effects] == ["cogging"]
    assert report.effects[0].strength == pytest.approx(0.4, rel=0.1)
    assert report.effects[0].where == "rail"
    (found,) = report.strengths
    assert found.number == pytest.approx(31.0, rel=0.02)


def test_a_force_that_shakes_faster_than_segments_follow_each_other_is_no_slower_one():
    """Segments of 60 ms: 9.9 Hz looks like 6.8 Hz in every one of them."""
    rng = np.random.default_rng(3)
    options = {"noise": [0.0005, 0.01], "finer": 4}
    shaking = lambda time, position: 0.9 * np.sin(2 * np.pi * 9.9 * time + 0.5)
    logs = [ride(rng, 200, shaking, **options) for _ in range(6)]
    report = diagnose(cart(), None, logs, effects=SOME)
    assert [effect.name for effect in report.effects] == ["periodic_disturbance"]
    (found,) = report.strengths
    assert found.frequency == pytest.approx(9.9, rel=5e-3)
    assert report.effects[0].strength == pytest.approx(0.9, rel=0.1)


@pytest.mark.parametrize("phase", [-2.6, -2.2, 0.6])
def test_of_a_part_of_a_wave_the_mean_belongs_to_it(phase):
    """Over 0.6 rad a sine of five per turn is much like others that are off by a constant."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(-0.1, 0.5, 100)
    force = np.sin(5.0 * angle + phase)
    noisy = force + 0.1 * rng.standard_normal(100)
    rate, found = _sine(noisy, np.ones(100), angle, np.arange(2.0, 25.0), offset=False)
    wave = np.sin(rate * angle + found)
    strength = float(wave @ force / (wave @ wave))
    assert strength > 0
    np.testing.assert_allclose(strength * wave, force, atol=0.1)


@pytest.mark.parametrize("turns", [0.5, 2.0, 6.0])
def test_magnets_behind_a_gear_are_seen_however_far_a_hinge_turns(turns):
    rng = np.random.default_rng(0)
    angle = rng.uniform(0.0, 2 * np.pi * turns, 400)
    force = np.sin(6.25 * angle + 0.4) + 0.1 * rng.standard_normal(400)
    number, _ = _sine(force, np.ones(400), angle, _numbers(angle))
    assert number == pytest.approx(6.25, abs=0.2)


@pytest.mark.parametrize(("number", "slides"), [(1.0, False), (6.0, True)])
def test_a_wave_that_was_given_is_not_too_long(number, slides):
    least = Cogging(number).free(Reach(0.2, 1.0, 1.0, slides))["number"][1]
    assert least == number
    assert Cogging(20.0).free(Reach(0.2, 1.0, 1.0, slides))["number"][1] > least


def test_a_constant_is_no_wave():
    rng = np.random.default_rng(0)
    angle = rng.uniform(-0.1, 0.5, 200)
    force = 3.0 + 0.1 * rng.standard_normal(200)
    assert _sine(force, np.ones(200), angle, np.arange(2.0, 25.0), offset=False) is None


@pytest.mark.parametrize("seed", [3, 7])
def test_a_spring_that_is_off_center_is_no_wave(seed):
    """A wave has three numbers, which over a part of its length do what two of a spring do."""
    rng = np.random.default_rng(seed)
    spring = lambda time, position: -3.0 * position - 0.6
    logs = [ride(rng, 150, spring, noise=[0.002, 0.02]) for _ in range(6)]
    report = diagnose(cart(), None, logs, effects=SOME)
    assert {effect.name for effect in report.effects} == {"constant_force", "parallel_spring"}


def test_a_wave_shows_where_forces_are_sure():
    """A foot on the ground hides a force that the same foot in the air shows."""
    rng = np.random.default_rng(0)
    time = rng.uniform(0.0, 1.2, 200)
    error = np.where(rng.random(200) < 0.3, 2.0, 40.0)
    force = 10.0 * np.sin(2 * np.pi * 3.1 * time + 0.4) + error * rng.standard_normal(200)
    rates = np.arange(0.5, 12.0, 0.1)
    alike = _sine(force, np.ones(200), 2 * np.pi * time, rates)
    assert alike is None or abs(alike[0] - 3.1) > 0.3
    weight = error**-2.0 / np.mean(error**-2.0)
    rate, phase = _sine(force, weight, 2 * np.pi * time, rates)
    assert rate == pytest.approx(3.1, abs=0.15)
    assert phase == pytest.approx(0.4, abs=0.4)


def test_a_foot_that_is_shaken_is_found_though_forces_at_all_joints_could_be_its_own():
    """At 20 Hz, where six steps are longer than a period of its 4 Hz."""
    system, logs, _ = cheetah(shaken=4.0)
    report = diagnose(system, None, logs, effects=("periodic_disturbance", "constant_force"))
    assert [effect.name for effect in report.effects] == ["periodic_disturbance"]
    assert report.effects[0].strengths["bfoot"] == pytest.approx(4.0, rel=0.05)
    (first, *_) = report.strengths
    assert first.frequency == pytest.approx(4.0, rel=5e-3)


def test_a_rate_that_is_known_is_not_offered_twice():
    """Of a slide whose segments cover its way there is one rate, and forces alone are the same."""
    rng = np.random.default_rng(0)
    positions = rng.uniform(0.0, 0.1, 60)[:, None] + np.linspace(-0.05, 0.05, 6)
    force, weight = np.sin(30.0 * positions[:, 3]), np.ones(60)
    for numbers in (np.array([30.0]), np.arange(10.0, 60.0, 5.0)):
        found = _cogging(force, weight, positions, numbers, there=[])
        assert len(found) == 1
        assert _cogging(force, weight, positions, numbers, there=found) == []
