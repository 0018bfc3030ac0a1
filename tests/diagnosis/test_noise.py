"""The noise floor, and what is unlike noise, of innovations that are known."""

import numpy as np
import pytest

from torchrl_bayessim.diagnosis.model import Model, unevenness
from torchrl_bayessim.diagnosis.objective import Point
from torchrl_bayessim.diagnosis.refit import Fit
from torchrl_bayessim.diagnosis.selection import Selection
from torchrl_bayessim.diagnosis.shrinkage import Shrinkage
from torchrl_bayessim.diagnosis.verdict import _visible
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


def judged(innovations):
    fit = Fit(Point(np.zeros(0)), (), innovations[:40], np.zeros((innovations[:40].size, 0)))
    return Model(fit, innovations[40:], np.arange(SEGMENTS) // 6)


@pytest.mark.parametrize("size", [0.5, 1.0, 2.0])
def test_noise_of_any_size_is_even(size):
    scores = np.array([unevenness(judged(size * white(seed))) for seed in range(100)])
    assert abs(scores.mean()) < 0.4
    assert 0.7 < scores.std() < 1.3
    assert scores.max() < 4.0


def test_what_comes_and_goes_is_uneven():
    innovations = white(0)
    innovations[::4] *= 2.0
    assert unevenness(judged(innovations)) > 5.0


def selection(innovations, p_value):
    model = judged(innovations)
    return Selection(model, model, (), (p_value,), (), {})


def measured(refit, low):
    return Shrinkage(refit, refit, refit, 0.0, (0.0, 0.0), (low, low + 0.4), (low, low + 0.4))


def uneven(factor):
    innovations = white(0)
    innovations[::4] *= factor
    return innovations


@pytest.mark.parametrize(
    ("innovations", "p_value", "test", "seen"),
    [
        (white(0), 0.5, measured(0.97, -0.1), False),  # noise
        (1.1 * white(0), 0.005, measured(1.2, 0.1), False),  # a floor that is a little low
        (1.5 * white(0), 0.005, measured(2.2, 0.8), True),  # every split shows a gap
        (1.5 * white(0), 0.005, measured(1.0, -0.2), False),  # test runs do not
        (uneven(2.0), 0.005, measured(1.2, 0.1), True),  # it comes and goes
        (uneven(2.0), 0.5, measured(1.2, 0.1), False),  # as outliers of a sensor do
        (uneven(2.0), 1e-9, measured(0.9, -0.2), True),  # where training runs alone moved
        (white(0), 1e-9, measured(0.9, -0.2), False),
    ],
)
def test_a_gap_that_nothing_explains_is_one_beyond_noise(innovations, p_value, test, seen):
    assert _visible(selection(innovations, p_value), test, alpha=0.01) == seen
