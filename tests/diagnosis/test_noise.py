"""The noise floor, of innovations that are known."""

import numpy as np
import pytest
from noisy_cheetah import cheetah
from rail_cart import cart, ride

from torchrl_bayessim.diagnosis.noise import assumed_noise, measured_noise
from torchrl_bayessim.diagnosis.objective import Objective
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.whitening import innovation_noise

SEGMENTS, ROWS, CHANNELS = 60, 8, 2
NONE = np.zeros((0, SEGMENTS, ROWS * CHANNELS))


def white(seed, *, scale=(1.0, 1.0)):
    drawn = np.random.default_rng(seed).standard_normal((SEGMENTS, ROWS, CHANNELS))
    return (drawn * scale).reshape(SEGMENTS, -1)


def estimates(change=lambda innovations, seed: innovations, scale=(1.0, 1.0)):
    draws = [innovation_noise(change(white(s, scale=scale), s), NONE, ROWS) for s in range(1, 21)]
    return np.array(draws)


def test_white_noise_has_its_own_size():
    found = estimates(scale=(0.5, 2.0))
    assert found.mean(0) == pytest.approx([0.5, 2.0], rel=0.02)
    assert (found.std(0) / [0.5, 2.0]).max() < 0.08


@pytest.mark.parametrize(("louder", "factor"), [(1.05, 1.0), (1.5, 1 / 1.5)])
def test_noise_that_the_linear_view_misses_is_that_of_simulated_robots(louder, factor):
    """By far, that is: by a little they err themselves."""
    drawn = louder * np.stack([white(1000 + i) for i in range(8)])
    found = [innovation_noise(white(s), NONE, ROWS, drawn=drawn) for s in range(1, 21)]
    assert np.mean(found, 0) == pytest.approx([factor, factor], rel=0.03)


def test_what_is_smooth_is_no_noise():
    ramp = np.linspace(0.0, 3.0, ROWS)[:, None].repeat(CHANNELS, 1).ravel()
    found = estimates(lambda innovations, _: innovations + ramp)
    assert found.mean(0) == pytest.approx([1.0, 1.0], rel=0.1)


@pytest.mark.parametrize("share", [0.1, 0.4, 0.6])
def test_impacts_in_some_segments_are_no_noise(share):
    """Such as those of backlash: the floor is what the calm segments show."""

    def hit(innovations, seed):
        rng = np.random.default_rng([seed, 1])
        where = rng.random(SEGMENTS) < share
        impulse = 4.0 * rng.standard_normal((SEGMENTS, ROWS, 1)) * (rng.random((1, ROWS, 1)) < 0.5)
        both = innovations.reshape(SEGMENTS, ROWS, CHANNELS)
        return (both + where[:, None, None] * impulse * [0.0, 1.0]).reshape(SEGMENTS, -1)

    calm, shaken = estimates(hit).mean(0)
    assert calm == pytest.approx(1.0, rel=0.03)
    assert 0.9 < shaken < 1.35


def test_a_few_segments_are_not_told_apart():
    """A quarter of them would be too few to say how large the noise is."""
    even, uneven = white(0)[:16], white(0)[:16]
    uneven[::2] *= 3.0
    found, larger = (innovation_noise(some, NONE[:, :16], ROWS) for some in (even, uneven))
    assert (larger > 1.5 * found).all()


def test_fast_motion_is_no_noise():
    """Third differences of a robot that runs at 20 Hz are many times its sensors' noise."""
    system, logs, true = cheetah()
    predictor = Predictor(system)
    assert np.median(assumed_noise(predictor, logs) / true) > 5
    noise, _ = measured_noise(predictor, logs, history=8, alarms=[])
    assert np.exp(np.abs(np.log(noise / true)).max()) < 1.6
    assert np.median((noise / true)[12:]) < 1.25  # of the legs' velocities


@pytest.mark.parametrize("told", [False, True])
def test_what_contacts_make_of_noise_is_not_believed_beyond_reason(monkeypatch, told):
    """However loud simulated robots are, noise is not estimated away, nor below the spec."""
    *_, spec = cheetah()
    system, logs, true = cheetah(noise=spec if told else None)
    made = Objective.made_by_noise
    monkeypatch.setattr(Objective, "made_by_noise", lambda *a, **k: 30.0 * made(*a, **k))
    noise, _ = measured_noise(Predictor(system), logs, history=8, alarms=[])
    monkeypatch.setattr("torchrl_bayessim.diagnosis.noise._CORRECTIONS", 0)
    linear, _ = measured_noise(Predictor(system), logs, history=8, alarms=[])
    assert (noise > 0.99 * linear / 1.6).all()
    assert (noise < 0.9 * linear).any()
    if told:
        assert (noise > 0.99 * np.minimum(linear, true)).all()


def test_where_nothing_touches_the_linear_view_misses_nothing(monkeypatch):
    rng = np.random.default_rng(0)
    logs = [ride(rng, 120, lambda *_: 0.0, noise=[0.0005, 0.01], finer=4) for _ in range(4)]
    noise, _ = measured_noise(Predictor(cart()), logs, history=8, alarms=[])
    monkeypatch.setattr("torchrl_bayessim.diagnosis.noise._CORRECTIONS", 0)
    linear, _ = measured_noise(Predictor(cart()), logs, history=8, alarms=[])
    np.testing.assert_array_equal(noise, linear)


@pytest.mark.parametrize("seed", [3, 7])
def test_a_sensor_as_good_as_its_spec_is_no_alarm(seed):
    *_, spec = cheetah()
    system, logs, _ = cheetah(noise=spec, amplitude=1.0, seed=seed)
    alarms = []
    measured_noise(Predictor(system), logs, history=8, alarms=alarms)
    assert not alarms


def test_no_sensor_is_much_worse_than_its_like():
    """What a spring does that the model lacks is no noise of the sensors at its joint."""
    system, logs, true = cheetah(stiffness=400.0)
    noise, _ = measured_noise(Predictor(system), logs, history=8, alarms=[])
    legs = noise.reshape(2, -1)[:, 3:] / true.reshape(2, -1)[:, 3:]
    usual = np.quantile(legs, 0.25, axis=1)
    assert (legs[:, 0] > 1.5 * usual).all()
    assert (legs[:, 0] <= 3.01 * usual).all()


def test_no_sensor_is_much_worse_than_its_spec():
    *_, spec = cheetah()
    system, logs, _ = cheetah(noise=spec, stiffness=400.0)
    alarms = []
    noise, _ = measured_noise(Predictor(system), logs, history=8, alarms=alarms)
    assert noise.max() <= 3.01 * spec.max()
    assert any("bthigh velocity" in alarm for alarm in alarms)


def test_a_spec_that_no_sensor_has_says_nothing():
    *_, true = cheetah()
    tiny, none = (cheetah(noise=spec)[:2] for spec in (1e-300 * true, None))
    found = [assumed_noise(Predictor(system), logs) for system, logs in (tiny, none)]
    np.testing.assert_array_equal(*found)


def test_a_sensor_may_be_twice_as_bad_as_its_spec():
    *_, true = cheetah()
    system, logs, _ = cheetah(noise=0.5 * true)
    noise, _ = measured_noise(Predictor(system), logs, history=8, alarms=[])
    assert noise == pytest.approx(true, rel=0.5)
