"""What the report says of effects that act at several places, or twice at one."""

import pytest
from plain_models import Unit

from torchrl_bayessim.diagnosis.found import _together

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
