"""What makes a further effect more than a stopgap."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from plain_models import A, C, Unit, plain

from torchrl_bayessim.diagnosis import further_effects
from torchrl_bayessim.diagnosis.further_effects import (
    beside_variation,
    identified,
    stands_apart,
    surely_elsewhere,
)
from torchrl_bayessim.diagnosis.search import Search


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


@pytest.mark.parametrize(
    ("judging", "left", "added"), [(5, 760.0, True), (3, 760.0, False), (5, 880.0, False)]
)
def test_what_hardly_exceeds_noise_is_named_if_all_runs_together_show_one_effect(
    judging, left, added
):
    """A third beyond the noise, all of which it explains; few runs judge it."""
    start, base, better = (
        replace(model, validation=model.validation[:judging])
        for model in (
            plain(units, deviance, width=20)
            for units, deviance in (([], 1e4), ([A], 1040.0), ([A, C], left))
        )
    )
    beside = {"seen": screened({})[0], "robot": None}
    assert identified(start, base, better, [better], **beside) == added
    # of a part of what was found at once no law has been bent yet
    assert not identified(start, base, better, [better])


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


def screened(ratios):
    """Return what a screen says that no law near the base could have, and whom it was asked of."""
    asked = []

    def beside(near, dispersion):
        assert dispersion > 1.0
        asked.extend(near)
        return {unit: ratio for unit, ratio in ratios.items() if unit not in near}

    return SimpleNamespace(units=tuple(ratios), beside=beside), asked


FRICTION, SPRING = Unit("friction", "knee"), Unit("spring", "knee")
SENSOR = Unit("sensor_gain", "hip", group="scale", channel="sensing")


@pytest.mark.parametrize(
    ("mine", "other", "added"),
    [(400.0, 230.0, True), (400.0, 300.0, False), (35.0, 0.0, False)],
    ids=["plain", "a rival is near", "faint"],
)
def test_what_no_law_at_the_same_joint_could_be_is_an_effect_elsewhere(mine, other, added):
    """Two thirds of what the base leaves, and nothing of the gap."""
    start, base = plain([], 1e5), plain([FRICTION], 590.0)
    better = plain([FRICTION, SENSOR], 445.0)
    seen, asked = screened({SENSOR: mine, SPRING: 900.0, Unit("gain", "hip"): other})
    rival = plain([FRICTION, Unit("gain", "hip")], 520.0, flipped=True)
    given = start, base, better, [better, rival]
    assert not identified(*given)
    assert identified(*given, seen=seen, robot="robot") == added
    assert asked == [SPRING]


def test_what_is_at_the_same_joint_may_be_the_form_of_its_law():
    start, base = plain([], 1e5), plain([FRICTION], 590.0)
    better = plain([FRICTION, SPRING], 445.0)
    seen, _ = screened({SENSOR: 0.0, SPRING: 900.0})
    rival = plain([FRICTION, SENSOR], 520.0, flipped=True)
    assert not identified(start, base, better, [better, rival], seen=seen, robot="robot")


def test_a_gain_that_other_runs_do_not_show_is_no_effect_elsewhere():
    base, better = plain([FRICTION], 590.0), plain([FRICTION, SENSOR], 575.0)
    seen, _ = screened({SENSOR: 400.0})
    assert not further_effects._elsewhere(base, better, seen, "robot", beyond=0.0)


@pytest.mark.parametrize(
    ("mine", "other", "apart"),
    [(60.0, 15.0, True), (30.0, 0.0, False), (60.0, 30.0, False), (120.0, 65.0, True)],
    ids=["plain", "faint", "a rival is near", "far enough from a rival"],
)
@pytest.mark.parametrize("gap", [2e5, 2e6], ids=["a little of the gap", "as a force a little off"])
def test_what_shows_elsewhere_is_an_effect_although_noise_alone_seems_left(gap, mine, other, apart):
    """A pole's friction beside a sensor's gain, of which it leaves a hundredth."""
    start, base = plain([], gap), plain([FRICTION], 440.0)
    better = plain([FRICTION, SENSOR], 390.0)
    seen, _ = screened({SENSOR: mine, Unit("gain", "hip"): other, SPRING: 900.0})
    assert further_effects.nothing_left(start, base)
    assert stands_apart(base, seen, "robot") == apart
    assert not identified(start, base, better, [better])
    added = identified(start, base, better, [better], seen=seen, robot="robot")
    assert added == (apart and gap < 1e6)


@pytest.mark.parametrize(("timestep", "added"), [(0.5, True), (2.0, False)])
def test_where_noise_seems_left_a_delay_is_longer_than_a_time_step(timestep, added):
    class Late(Unit):
        def actual(self, strength):
            return strength

    late = Late("action_delay", group="timing")
    start, base, better = (
        plain(units, left)
        for units, left in (([], 2e5), ([FRICTION], 440.0), ([FRICTION, late], 390.0))
    )
    seen, _ = screened({late: 60.0, SPRING: 900.0})
    given = start, base, better, [better]
    assert identified(*given, timestep=timestep, seen=seen, robot="robot") == added


def test_two_kinds_that_show_elsewhere_alike_stand_not_apart():
    base = plain([FRICTION], 440.0)
    both = {SENSOR: 60.0, Unit("gain", "hip"): 50.0}
    assert not stands_apart(base, screened(both)[0], "robot")
    assert not stands_apart(base, screened({SPRING: 900.0})[0], "robot")


@pytest.mark.parametrize(
    ("there", "left", "added"),
    [([A], 1900.0, True), ([A, C], 1020.0, False), ([A, C], 980.0, True)],
    ids=["a second effect", "a third of little", "a third of some share"],
)
def test_a_third_effect_beside_a_variation_is_a_share_of_the_gap(there, left, added):
    """A hundredth of a gap of 100,000 beyond the noise, 400."""
    last = Unit("timing", "hip")
    start, base, better = plain([], 100_400.0), plain(there, 2000.0), plain([*there, last], left)
    assert beside_variation(start, base, better, [better]) == added
    train = SimpleNamespace(predictor=SimpleNamespace(system=None))
    search = Search(
        train, None, start, [], again=None, varied=True, shapes=None, alpha=0.01,
        generator=None, progress=None,
    )  # fmt: skip
    assert search.worth(base, better, [better], seen=None) == added


def test_what_another_kind_mends_as_well_is_no_effect_beside_a_variation():
    start, base, better = plain([], 1e5), plain([A], 2e4), plain([A, C], 4000.0)
    other = plain([A, Unit("delay", "x")], 3990.0, flipped=True)
    assert beside_variation(start, base, better, [better])
    assert not beside_variation(start, base, better, [better, other])


@pytest.mark.parametrize(
    ("without", "left", "where", "needed"),
    [
        (500.0, 440.0, "knee", True),  # noise alone is left
        (500.0, 440.0, "hip", False),  # where the other effect acts
        (450.0, 440.0, "knee", False),  # chance makes as much
        (740.0, 540.0, "knee", True),  # half as much again as noise, and less than it takes
        (640.0, 540.0, "knee", False),  # what the base leaves is mostly something else
        (2000.0, 800.0, "knee", False),  # off everywhere: anything helps
    ],
)
def test_what_is_elsewhere_is_surely_needed_if_it_takes_most_of_what_is_left(
    without, left, where, needed
):
    """Noise alone would leave 400."""
    added = Unit("drag", where)
    base, better = plain([C], without), plain([C, added], left)
    assert surely_elsewhere(base, better, None) == needed
