"""What is said to be ruled out is ruled out where it is said."""

import pytest

from torchrl_bayessim.diagnosis.objective import Unit, at_targets
from torchrl_bayessim.diagnosis.report import Candidate, Finding
from torchrl_bayessim.diagnosis.sentence import _described, _ruled_out
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.robot import Robot


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


def finding(name, strengths, *, where, strength, form=None, unit="rad/s"):
    return Finding(
        name=name,
        where=where,
        strength=strength,
        unit=unit,
        ci95=(strength - 0.01, strength + 0.01),
        p_value=0.0,
        share_of_gap=1.0,
        strengths=strengths,
        form=form or {},
    )


def test_what_acts_at_all_in_proportion_is_said_with_the_place_of_its_strength():
    robot = Robot(dt=0.01, channels=("q", "v"))
    unit = Unit(effect("sensor_bias"), "all", (0.25, 1.0), -1.0, 1.0)
    strengths = at_targets({unit: -0.024}, robot)
    assert strengths == {"q": pytest.approx(-0.006), "v": -0.024}
    said = _described(finding("sensor_bias", strengths, where="all", strength=-0.024))
    at_all = "sensor bias at all at once (-0.024 ± 0.01 rad/s at v, elsewhere in proportion"
    assert said.startswith(at_all)


@pytest.mark.parametrize(
    ("form", "said"),
    [
        ({"hardening": 5.0}, "(2 ± 0.01 N m/rad, hardening by 5 x²)"),
        ({"hardening": 0.0}, "(2 ± 0.01 N m/rad)"),
        ({"external": True}, "(2 ± 0.01 N m/rad, of the load with what acts from outside)"),
        ({"external": False}, "(2 ± 0.01 N m/rad)"),
    ],
)
def test_a_law_that_bends_is_said_to(form, said):
    one = finding(
        "parallel_spring", {"hinge": 2.0}, where="hinge", strength=2.0, form=form, unit="N m/rad"
    )
    assert _described(one) == f"parallel spring at hinge {said}"


@pytest.mark.parametrize(
    ("name", "form", "said"),
    [
        ("viscous_friction", {"power": 0.8}, ", by the power 0.8 of speed"),
        ("viscous_friction", {"rise": -0.1}, ", and -0.1 of it per unit of speed"),
        ("viscous_friction", {"rise": 0.0}, ""),
        ("quadratic_drag", {"power": 2.0}, ""),  # as its name says
        ("quadratic_drag", {"power": 1.996}, ""),
        ("quadratic_drag", {"power": 2.2}, ", by the power 2.2 of speed"),
        ("drag_of_my_own", {"power": 2.0}, ", by the power 2 of speed"),
    ],
)
def test_a_law_is_said_to_bend_where_its_name_does_not_say_so(name, form, said):
    found = finding(name, {"a": 0.3}, where="a", strength=0.3, form=form, unit="N m")
    assert _described(found).endswith(f"(0.3 ± 0.01 N m{said})")
