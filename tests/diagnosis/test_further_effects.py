"""What makes a further effect more than a stopgap."""

from types import SimpleNamespace

import pytest
from plain_models import A, C, Unit, plain

from torchrl_bayessim.diagnosis.further_effects import identified


@pytest.mark.parametrize(
    ("rival", "added"), [([A, C, Unit("delay", "x")], True), ([A, Unit("delay", "x")], False)]
)
def test_what_has_the_same_beside_something_else_says_nothing_against_an_effect(rival, added):
    """A fiftieth of the gap, most of which the new effect explains; a rival is as good."""
    start, base, better = plain([], 1e6), plain([A], 20_000.0), plain([A, C], 4000.0)
    rivals = [better, plain(rival, 3990.0, flipped=True)]
    assert identified(start, base, better, rivals) == added


def test_what_explains_the_same_under_another_name_says_nothing_against_an_effect():
    start, base, better = plain([], 1e6), plain([A], 20_000.0), plain([A, C], 4000.0)
    other = plain([A, Unit("delay", "x")], 3990.0)
    assert identified(start, base, better, [better, other])


@pytest.mark.parametrize(("other", "added"), [(19_500.0, True), (17_000.0, False)])
def test_a_third_of_what_is_left_is_enough_where_no_other_kind_comes_near(other, added):
    start, base, better = plain([], 1e6), plain([A], 20_000.0), plain([A, C], 13_500.0)
    rival = plain([A, Unit("delay", "x")], other, flipped=True)
    assert identified(start, base, better, [better, rival]) == added


@pytest.mark.parametrize(
    ("first", "more", "left", "added"),
    [
        ([A], C, 450.0, True),
        ([A], C, 1600.0, False),
        ([A], Unit("timing", "hip"), 450.0, False),  # as another integrator does
        ([A, C], Unit("drag", "hip"), 450.0, False),
    ],
)
def test_what_is_hardly_a_share_of_the_gap_is_named_if_one_effect_takes_all_of_it(
    first, more, left, added
):
    """Less than a hundredth, but five times the noise."""
    start, base, better = plain([], 1e6), plain(first, 2400.0), plain([*first, more], left)
    assert identified(start, base, better, [better]) == added


@pytest.mark.parametrize(("units", "added"), [([Unit("drag")], True), ([A, Unit("drag")], False)])
def test_two_in_the_place_of_one_are_one_more(units, added):
    """Three fifths of what one leaves: enough for one more, and not for two."""
    start, base, better = plain([], 1e6), plain([A], 20_000.0), plain([C, *units], 8_000.0)
    assert identified(start, base, better, [better]) == added


@pytest.mark.parametrize(("timestep", "added"), [(0.5, True), (2.0, False)])
def test_a_delay_beside_a_cause_is_one_if_it_is_longer_than_a_time_step(timestep, added):
    class Delay(Unit):
        effect = SimpleNamespace(group="timing")

        def actual(self, strength):
            return strength

    start, base, better = (
        plain(units, left)
        for units, left in (([], 1e6), ([A], 2400.0), ([A, Delay("action_delay")], 450.0))
    )
    assert identified(start, base, better, [better], timestep=timestep) == added


def test_what_a_force_a_little_off_would_leave_is_no_cause_of_its_own():
    """A few hundred-thousandths of the gap, though six times the noise."""
    start, base, better = plain([], 1e8), plain([A], 2400.0), plain([A, C], 450.0)
    assert not identified(start, base, better, [better])


@pytest.mark.parametrize(("strength", "added"), [(1e-3, True), (1.0, False)])
def test_what_comes_in_the_place_of_a_second_effect_is_no_third(strength, added):
    """Drift and a payload leave little; with magnets the drift is nothing."""
    drift, magnets = Unit("drift"), Unit("magnets")
    start, base = plain([], 1e6), plain([A, drift], 2400.0)
    better = plain({A: 1.0, drift: strength, magnets: 1.0}, 450.0)
    assert identified(start, base, better, [better]) == added


@pytest.mark.parametrize(("left", "added"), [(4.2e5, True), (6.2e5, False)])
def test_a_third_effect_takes_half_of_what_two_leave(left, added):
    """A fifth and more of the gap, which would be enough for a second."""
    start, base = plain([], 4e6), plain([A, C], 1e6)
    better = plain([A, C, Unit("magnets")], left)
    rival = plain([A, C, Unit("drag")], left, flipped=True)
    assert identified(start, base, better, [better, rival]) == added
    assert identified(start, plain([A], 1e6), plain([A, Unit("magnets")], left), [better])


def test_what_a_rival_lacks_does_nothing_in_it():
    start, base = plain([], 1e6), plain([A, C], 2400.0)
    better = plain([A, Unit("magnets")], 450.0)
    assert identified(start, base, better, [better])


@pytest.mark.parametrize(("left", "added"), [(2.2e5, True), (4.2e5, False)])
def test_two_effects_at_once_take_half_of_what_is_left_each(left, added):
    start, base = plain([], 4e6), plain([A], 1e6)
    better = plain([A, C, Unit("magnets")], left)
    assert identified(start, base, better, [better]) == added
