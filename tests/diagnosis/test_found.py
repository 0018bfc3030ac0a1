"""What the report says of effects that act at several places, or twice at one."""

import pytest
from plain_models import Unit

from torchrl_bayessim.diagnosis.as_recorded import Recorded
from torchrl_bayessim.diagnosis.found import _is_stopgap, _together
from torchrl_bayessim.diagnosis.shrinkage import Shrinkage

HIP, KNEE, HARDER = Unit("friction", "hip"), Unit("friction", "knee"), Unit("friction", "hip", 2.0)


@pytest.mark.parametrize(
    ("units", "expected"),
    [
        ([HIP], (0.2, 0.03)),
        ([HIP, KNEE], (0.25, 0.025)),  # the mean of joints
        ([HIP, HARDER], (0.5, 0.05)),  # two laws of one joint brake it together
        ([HIP, HARDER, KNEE], (0.4, 0.065)),
    ],
)
def test_a_strength_is_the_mean_of_places_and_the_sum_at_each(units, expected):
    strengths, errors = (0.2, 0.3, 0.3)[: len(units)], (0.03, 0.04, 0.12)[: len(units)]
    assert _together(units, strengths, errors) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("refit", "effects", "stopgap"),
    [
        (6.7, 2.3, False),  # a gap in a drive, beside a sensor that repeats itself
        (6.7, 4.5, True),
        (1.94, 1.51, False),  # a sensor's gain
        (1.3, 1.0, True),  # what straight lines leave
        (90.0, 80.0, False),  # more than a hundredth of all
    ],
)
def test_what_explains_little_of_held_samples_is_a_cause_if_it_is_most_of_the_rest(
    refit, effects, stopgap
):
    left = Shrinkage(refit, refit, effects, 0.5, (0.0, 1.0), (0.0, 1.0), (0.0, 1.0))
    assert _is_stopgap(left, 614.0) == stopgap


@pytest.mark.parametrize(
    ("effects", "bridged", "matter"),
    [
        (1.52, 0.93, True),
        (1.02, 0.93, False),  # noise, as it was recorded
        (3.0, 2.8, False),  # something else is most of what is left
    ],
)
def test_held_samples_beside_a_large_gap_matter_if_they_are_most_of_what_effects_leave(
    effects, bridged, matter
):
    assert Recorded(445.0, effects, bridged).matter == matter
