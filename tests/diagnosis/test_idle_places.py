"""Places of an effect, and effects, that a model has for nothing."""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from torchrl_bayessim.diagnosis.alternatives import exchanged
from torchrl_bayessim.diagnosis.credit import worthwhile
from torchrl_bayessim.diagnosis.further_effects import identified
from torchrl_bayessim.diagnosis.model import Model
from torchrl_bayessim.diagnosis.selection import Selection, _idle_place


class Unit(NamedTuple):
    name: str
    where: str

    @property
    def effect(self):
        return SimpleNamespace(group=self.name)


A, B, C = Unit("gain", "knee"), Unit("gain", "hip"), Unit("friction", "hip")


def model(units, deviance, *, segments=40, flipped=False):
    """Return a model whose segments all leave as much, on the other side if ``flipped``."""
    left = np.full((segments // 2, 10), np.sqrt(deviance / (10 * segments))) * (-1) ** flipped
    fit = SimpleNamespace(units=tuple(units), innovations=left)
    return Model(fit=fit, validation=left, logs=np.arange(segments))


@pytest.mark.parametrize(
    ("without", "idle"),
    [((9000.0, 505.0), 1), ((9000.0, 700.0), None), ((504.0, 505.0), None)],
)
def test_a_place_that_next_to_nothing_is_due_to_is_idle(without, idle):
    smaller = [model([B], without[0]), model([A], without[1])]
    assert _idle_place(model([A, B], 500.0), smaller) == idle


def test_an_effect_of_its_own_is_not_idle():
    smaller = [model([C], 9e6), model([A], 510.0)]
    assert _idle_place(model([A, C], 500.0), smaller) is None


@pytest.mark.parametrize(
    ("without", "kept"),
    [(510.0, {"gain"}), (900.0, {"gain", "friction"})],
)
def test_an_effect_with_next_to_no_credit_is_not_named(without, kept):
    start, best = model([], 1e6), model([A, C], 500.0)
    others = {"friction": (model([A, Unit("drag", "hip")], 600.0),)}
    tried = (start, model([A], without), model([C], 1e6))
    selection = Selection(start, best, (), (0.0,), tried, others)
    left = worthwhile(selection, {})
    assert {one.name for one in left.best.units} == kept
    assert set(left.alternatives) == kept & set(others)


@pytest.mark.parametrize(("share", "changed"), [(0.97, False), (0.5, True)])
def test_more_strengths_do_not_take_the_place_of_fewer_that_are_as_good(share, changed):
    rng = np.random.default_rng(0)
    best, more = model([A], 5000.0), model([Unit("delay", "x"), Unit("delay", "y")], 5000.0)
    each = rng.uniform(0.5, 1.5, len(best.validation))[:, None]  # better here, worse there
    fit = SimpleNamespace(units=more.units, innovations=np.sqrt(share) * each * more.validation)
    other = Model(fit=fit, validation=fit.innovations, logs=more.logs)
    assert (exchanged(best, {"gain": (other,)}) is other) == changed


@pytest.mark.parametrize(
    ("rival", "added"), [([A, C, Unit("delay", "x")], True), ([A, Unit("delay", "x")], False)]
)
def test_what_has_the_same_beside_something_else_says_nothing_against_an_effect(rival, added):
    """A fiftieth of the gap, most of which the new effect explains; a rival is as good."""
    start, base, better = model([], 1e6), model([A], 20_000.0), model([A, C], 4000.0)
    rivals = [better, model(rival, 3990.0, flipped=True)]
    assert identified(start, base, better, rivals) == added


def test_what_explains_the_same_under_another_name_says_nothing_against_an_effect():
    start, base, better = model([], 1e6), model([A], 20_000.0), model([A, C], 4000.0)
    other = model([A, Unit("delay", "x")], 3990.0)
    assert identified(start, base, better, [better, other])


@pytest.mark.parametrize(("other", "added"), [(19_500.0, True), (17_000.0, False)])
def test_a_third_of_what_is_left_is_enough_where_no_other_kind_comes_near(other, added):
    start, base, better = model([], 1e6), model([A], 20_000.0), model([A, C], 13_500.0)
    rival = model([A, Unit("delay", "x")], other, flipped=True)
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
    start, base, better = model([], 1e6), model(first, 2400.0), model([*first, more], left)
    assert identified(start, base, better, [better]) == added
