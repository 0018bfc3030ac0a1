"""The noise floor, of innovations that are known."""

import numpy as np
import pytest

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


def test_a_few_segments_are_not_told_apart():
    """A quarter of them would be too few to say how large the noise is."""
    found = innovation_noise(white(0)[:16], NONE[:, :16], ROWS)
    uneven = white(0)[:16]
    uneven[::2] *= 3.0
    assert (innovation_noise(uneven, NONE[:, :16], ROWS) > 1.5 * found).all()
