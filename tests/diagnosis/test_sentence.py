"""What is said to be ruled out is ruled out where it is said."""

import pytest

from torchrl_bayessim.diagnosis.report import Candidate
from torchrl_bayessim.diagnosis.sentence import _ruled_out


def candidate(where, least, *, name="coulomb_friction", status="ruled_out", form=None):
    return Candidate(
        name=name,
        where=where,
        strength=0.0,
        ci95=None,
        likelihood_ratio=1.0,
        p_value=0.5,
        held_out_gain=None,
        explained_fraction=0.0,
        explained_by_parameters=0.0,
        minimal_detectable_strength=least,
        status=status,
        form=form or {},
        unit="N m",
    )


@pytest.mark.parametrize(
    ("candidates", "said"),
    [
        ([candidate("hinge", 0.02)], "above 0.02 N m at hinge"),
        ([candidate("all", 0.01), candidate("a", 0.02), candidate("b", 0.3)],
         "above 0.3 N m anywhere"),
        ([candidate("all", 0.01), candidate("a", 0.02), candidate("b", None, status="not_excited")],
         "above 0.02 N m at a"),
        ([candidate("all", 0.01), candidate("a", None, status="not_excited")],
         "above 0.01 N m at all at once"),
    ],
)  # fmt: skip
def test_the_least_strength_is_that_of_the_place(candidates, said):
    assert _ruled_out(candidates) == f" Ruled out: coulomb friction {said}."


def test_a_force_that_comes_again_is_ruled_out_at_its_frequency_only():
    one = candidate("hinge", 0.1, name="periodic_disturbance", form={"frequency": 1.0})
    assert _ruled_out([one]) == (" Ruled out: periodic disturbance, 1 Hz above 0.1 N m at hinge.")
