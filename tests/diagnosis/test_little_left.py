"""A weak cause beside a strong one is named if it is all of the little that is left."""

from types import SimpleNamespace

import numpy as np
import pytest
from plain_models import A, Unit, plain
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis import objective
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.little_left import all_of_little, little_left, one_alone
from torchrl_bayessim.diagnosis.objective import units_of
from torchrl_bayessim.diagnosis.screening import Screen
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.joints import ViscousFriction

SOME = (
    "dead_band", "quadratic_drag", "coulomb_friction", "action_lag", "action_gain",
    "parallel_spring", "sensor_gain", "payload", "action_delay", "series_elasticity",
)  # fmt: skip


def of_segments(**parts):
    return SimpleNamespace(segments=SimpleNamespace(**parts))


FREE = of_segments(touching=None)


@pytest.mark.parametrize(
    ("units", "left", "p_value", "little"),
    [
        ([A], 440.0, 1e-8, True),
        ([A], 440.0, 1e-3, False),
        ([A], 600.0, 1e-8, False),
        ([], 440.0, 1e-8, False),
        ([Unit("friction", "hip")], 440.0, 1e-8, False),
        ([Unit("backlash", "hip", group="elasticity")], 440.0, 1e-8, False),
        ([Unit("delay", "x", group="timing")], 440.0, 1e-8, True),
        ([A, Unit("payload", "hip")], 440.0, 1e-8, False),
    ],
    ids=[
        "little",
        "perhaps nothing",
        "more",
        "no cause yet",
        "it sticks",
        "it gives way",
        "it is late",
        "two causes",
    ],
)
def test_little_is_left_if_it_is_hardly_more_than_noise_and_surely_more(
    units, left, p_value, little
):
    assert little_left(plain(units, left), p_value) == little


@pytest.mark.parametrize(
    ("touching", "gained", "beside", "whole"),
    [
        (False, 30.0, 0.0, True),
        (False, 90.0, 4.0, False),  # something is missing still
        (False, 200.0, 9.0, True),
        (False, 200.0, 11.0, False),
        (True, 30.0, 0.0, False),
        (True, 200.0, 0.0, True),
        (True, 90.0, 0.0, False),
        (True, 200.0, 9.0, True),
        (True, 200.0, 11.0, False),
        (False, 200.0, None, True),
    ],
)
def test_one_effect_is_all_of_little_if_it_explains_ten_times_what_shows_beside_it(
    monkeypatch, *, touching, gained, beside, whole
):
    known, added = (units_of([effect(n)], system().robot)[0] for n in ("armature", "payload"))
    start, best = plain([], 9000.0), plain([known], 400.0 + gained)
    better = plain([known, added], 400.0)
    left = np.array([] if beside is None else [beside / 4])  # half as many segments, twice as far
    seen = SimpleNamespace(ratios={1.0: left}.__getitem__, growth=np.full(left.shape, 2.0))
    ours = "torchrl_bayessim.diagnosis.little_left."
    monkeypatch.setattr(ours + "compare", lambda *_: SimpleNamespace(seen=seen))
    monkeypatch.setattr(ours + "waver", lambda *_: False)
    monkeypatch.setattr(ours + "numerical", lambda *_: False)
    train = of_segments(touching=np.ones((4, 9), dtype=bool) if touching else None)
    train.predictor = SimpleNamespace(system=system())
    found = all_of_little(
        start, best, [better], train=train, left=[], missing=lambda *_: bool(beside)
    )
    assert found is (better if whole else None)


@pytest.mark.parametrize(("rest", "alone"), [(0.0, True), (12.0, False)])
def test_one_effect_is_all_of_it_if_beside_it_no_other_shows(rest, alone):
    """Two signatures at right angles: what the second explains, the first does not."""
    units = tuple(objective.Unit(ViscousFriction(), name, (1.0,), 0.0, 1.0) for name in "ab")
    zero, one = np.zeros(2), np.ones(2)
    seen = Screen(
        units=units,
        strengths=one,
        norms=one,
        sizes=one,
        scores=np.array([20.0, rest]),
        correlation=np.eye(2),
        swallowed=zero,
        residual=400.0 + rest**2,
        effective=1000,
        changes=(np.zeros((1, 1), np.float32),) * 2,
        growth=one,
    )
    assert one_alone(seen, 1.0, np.random.default_rng(0)) == alone


def test_a_drag_that_is_a_thousandth_of_the_gap_at_most_is_named_beside_a_dead_band():
    found = weak(drag=0.001)
    assert set(found) == {"dead_band", "quadratic_drag"}
    assert found["dead_band"].strength == pytest.approx(0.5, rel=0.05)
    assert found["quadratic_drag"].strength == pytest.approx(0.001, rel=0.3)
    assert found["quadratic_drag"].share_of_gap < 0.01
    assert set(weak(drag=0.0)) == {"dead_band"}


@pytest.mark.parametrize("cause", ["quadratic_drag", "parallel_spring"])
def test_a_weak_cause_is_named_beside_a_delay(cause):
    name = "drag" if cause == "quadratic_drag" else "spring"
    found = weak(**{name: 0.002}, act=lambda u, k: u[max(k - 2, 0)])
    late = {"action_delay", "action_lag"} & set(found)
    assert set(found) - late == {cause}
    assert len(late) == 1
    assert found[cause].strength == pytest.approx(0.002, rel=0.3)


@pytest.mark.parametrize(
    ("known", "added", "asked"),
    [
        ("action_delay", "sensor_lag", False),
        ("action_delay", "series_elasticity", False),
        ("action_delay", "parallel_spring", True),  # a spring, but not of a drive
        ("parallel_spring", "action_delay", True),
        ("action_gain", "action_delay", True),
    ],
)
def test_what_is_late_is_not_asked_beside_what_is_late(monkeypatch, known, added, asked):
    """A lag beside a delay, or the other way round, is the form of one of them."""
    base, more = (units_of([effect(name)], system().robot)[0] for name in (known, added))
    seen = []
    chosen = lambda _, models: seen.extend(models)
    monkeypatch.setattr("torchrl_bayessim.diagnosis.little_left.chosen", chosen)
    models = [plain([base, more], 400.0)]
    start, best = plain([], 900.0), plain([base], 440.0)
    assert all_of_little(start, best, models, train=FREE, left=[], missing=lambda *_: False) is None
    assert seen == models * asked


def dead_band(u, k):
    return np.sign(u[k]) * max(abs(u[k]) - 0.5, 0.0)


def weak(drag=0.0, spring=0.0, act=dead_band):
    """Return what is found of an arm with a strong cause and some drag or a spring, by name."""
    push = lambda q, v: -drag * v * abs(v) - spring * q
    report = diagnose(system(), None, logs(10, 300, act=act, push=push), effects=SOME)
    return {effect.name: effect for effect in report.effects}
