import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_bayessim.diagnosis.excitation_library import excitations
from torchrl_bayessim.diagnosis.experiment import _discrimination
from torchrl_bayessim.diagnosis.objective import Point
from torchrl_bayessim.diagnosis.refit import Fit


@settings(max_examples=25, deadline=None)
@given(
    low=st.floats(-10, 0),
    width=st.floats(0, 10),
    steps=st.integers(20, 300),
    size=st.integers(1, 4),
)
def test_excitations_stay_within_limits(low, width, steps, size):
    lows = np.full(size, low)
    library = excitations(
        lows, lows + width, steps=steps, dt=0.02, generator=np.random.default_rng(0)
    )
    for wave in library.values():
        assert wave.shape == (steps, size)
        assert (wave >= low - 1e-9).all()
        assert (wave <= low + width + 1e-9).all()


def test_the_same_generator_gives_the_same_excitations():
    first, second = (
        excitations(-np.ones(2), np.ones(2), steps=50, dt=0.01, generator=np.random.default_rng(3))
        for _ in range(2)
    )
    for name, wave in first.items():
        assert np.array_equal(wave, second[name])


def fit(innovations, jacobian):
    return Fit(Point(np.zeros(1)), (), innovations, jacobian)


def test_what_parameters_could_imitate_tells_nothing_unless_the_data_forbid_it():
    direction = np.array([[1.0], [2.0], [2.0]])
    there = fit((3.0 * direction).reshape(1, 3), direction)
    nothing = np.zeros((1, 3))
    unknown = fit(nothing, np.zeros((3, 1)))
    assert _discrimination(there, unknown, nothing) == pytest.approx(0.0, abs=1e-12)
    # one number x with 9 x² of old data against 9 (3 + x)² of new: half of 81 remains
    known = fit(nothing, direction)
    assert _discrimination(there, known, nothing) == pytest.approx(81 / 2)


def test_what_no_parameter_imitates_tells_all():
    there = fit(np.array([[0.0, 4.0]]), np.array([[1.0], [0.0]]))
    before = fit(np.zeros((1, 2)), np.zeros((2, 1)))
    assert _discrimination(there, before, np.zeros((1, 2))) == pytest.approx(16.0)
