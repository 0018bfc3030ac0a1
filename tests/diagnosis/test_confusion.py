"""Which effects count as not told apart, on models with known misfits."""

from dataclasses import replace

import numpy as np
import pytest

from torchrl_bayessim.diagnosis import confusion
from torchrl_bayessim.diagnosis.confusion import confusion_set, rivals, settled
from torchrl_bayessim.diagnosis.exchange import exchanged, leaves_less_to_do, only_more
from torchrl_bayessim.diagnosis.model import Model
from torchrl_bayessim.diagnosis.objective import Point, Unit
from torchrl_bayessim.diagnosis.refit import Fit
from torchrl_bayessim.diagnosis.selection import Selection
from torchrl_bayessim.effects.catalogue import effect

SEGMENTS, SIZE = 20, 10


def model(square, *names):
    """Return a model whose squared innovations are ``square`` on average."""
    units = tuple(Unit(effect(name), "hinge", (1.0,), 0.0, 1.0) for name in names)
    noise = np.random.default_rng(0).standard_normal((2 * SEGMENTS, SIZE))
    left = noise * np.sqrt(square / (noise**2).mean(-1, keepdims=True))
    fit = Fit(
        Point(np.zeros(1), dict.fromkeys(units, 0.5)),
        units,
        left[:SEGMENTS],
        np.zeros((SEGMENTS * SIZE, 1 + len(units))),
    )
    return Model(fit, left[SEGMENTS:], np.arange(2 * SEGMENTS))


def selection(best, *tried, p_values=()):
    nominal = model(11.0)
    name = best.units[0].name
    others = tuple(m for m in tried if len(m.units) == 1)
    return Selection(nominal, best, (), p_values, (nominal, best, *tried), {name: others})


def test_what_is_clearly_worse_is_told_apart():
    found = selection(model(1.0, "action_delay"), model(3.0, "action_lag"))
    assert confusion_set(found, "action_delay") == ("action_delay",)


def test_another_form_of_the_same_cause_is_not_told_apart():
    best = model(1.0, "action_delay")
    found = selection(best, model(1.8, "action_lag"), model(1.8, "dead_band"))
    assert confusion_set(found, "action_delay") == ("action_delay", "action_lag")
    assert rivals(found, "action_delay") == []  # as good as the best it is not


def test_what_acts_alike_and_explains_much_of_the_rest_is_not_told_apart():
    best = model(5.0, "coulomb_friction")
    beside = model(3.0, "coulomb_friction", "stribeck_friction")
    other = model(3.0, "coulomb_friction", "action_delay")
    found = selection(best, beside, other)
    assert confusion_set(found, "coulomb_friction") == ("coulomb_friction", "stribeck_friction")


@pytest.mark.parametrize(
    ("left", "expected"),
    [(0.5, ("action_delay",)), (0.001, ("action_delay", "dead_band"))],
    ids=["noise", "more than noise"],
)
def test_another_kind_that_explains_nearly_as_much_belongs_where_the_best_law_is_not_true(
    left, expected
):
    best = model(1.0, "action_delay")
    found = selection(
        best, model(1.2, "dead_band"), model(1.6, "saturation"), p_values=(1e-9, left)
    )
    assert confusion_set(found, "action_delay") == expected


def test_a_part_of_the_best_model_is_no_rival_of_it():
    best = model(1.0, "action_delay", "dead_band")
    part = model(1.0, "dead_band")
    found = Selection(model(11.0), best, (), (), (part,), {"action_delay": (part,)})
    assert confusion_set(found, "action_delay") == ("action_delay",)


def test_a_part_of_the_best_model_is_no_rival_where_something_is_left():
    best = model(1.0, "action_delay")
    found = selection(best, model(1.01, "action_delay"), p_values=(1e-9, 0.001))
    assert confusion_set(found, "action_delay") == ("action_delay",)


def pair(square, **strengths):
    """Return a model of effects at given strengths."""
    bare = model(square, *strengths)
    values = dict(zip(bare.units, strengths.values(), strict=True))
    return replace(bare, fit=replace(bare.fit, point=Point(bare.fit.point.z, values)))


ONE_WAY = {"directional_friction": 0.34, "action_bias": 0.14}
BOTH_WAYS = {"coulomb_friction": 0.17, "action_bias": -0.03}


def test_friction_one_way_and_half_of_it_as_a_push_is_friction_both_ways(monkeypatch):
    best, other = pair(1.0, **ONE_WAY), pair(1.001, **BOTH_WAYS)
    assert leaves_less_to_do(best, other)
    assert not leaves_less_to_do(other, best)
    assert exchanged(model(11.0), best, {"directional_friction": (other,)}) is other
    monkeypatch.setattr(confusion, "parts", lambda *_: [])
    # also where it explains a little less, as long as that may be chance
    for one, name in ((best, "directional_friction"), (other, "coulomb_friction")):
        found = replace(
            selection(one), alternatives={name: tuple(m for m in (best, other) if m is not one)}
        )
        sets = dict.fromkeys(("train", "validation"))
        assert settled(found, name, sets).best is other


def test_rivals_of_the_others_stand_beside_what_comes_to_the_front(monkeypatch):
    old = pair(1.0, sensor_delay=0.02, com_shift=0.005)
    front = pair(1.0, action_delay=0.02, com_shift=0.005)
    rival = pair(1.0, sensor_delay=0.02, sensor_bias=0.02)
    worse = pair(2.0, sensor_delay=0.02, payload=0.1)
    found = replace(
        selection(old), alternatives={"sensor_delay": (front,), "com_shift": (rival, worse)}
    )
    monkeypatch.setattr(confusion, "parts", lambda *_: [])
    fitted = lambda *_: [pair(1.0, **{u.name: s for u, s in p.strengths.items()}) for p in _[-1]]
    monkeypatch.setattr(confusion, "judged_fits", fitted)
    found = settled(found, "sensor_delay", dict.fromkeys(("train", "validation")))
    assert found.best is front
    (beside,) = found.alternatives["com_shift"]
    assert beside.names == {"action_delay", "sensor_bias"}
    assert confusion_set(found, "com_shift") == ("com_shift", "sensor_bias")
    assert confusion_set(found, "action_delay") == ("action_delay", "sensor_delay")


def with_another(best, *, square, gained):
    """Return a selection in which two strengths explain so much more deviance than one."""
    more = model(square, "sensor_delay", "sensor_lag")
    share = gained / float((best.validation**2).sum())
    more = replace(more, validation=np.sqrt(1 - share) * best.validation)
    return replace(selection(best), alternatives={"action_delay": (more,)}), more


@pytest.mark.parametrize(
    ("square", "gained", "front"), [(1.0, 3.0, 0), (1.0, 14.0, 1), (9.0, 14.0, 0), (9.0, 126.0, 1)]
)
def test_a_strength_more_has_to_explain_more_than_chance_to_come_to_the_front(
    monkeypatch, square, gained, front
):
    """Where nine times as much as noise is left, a deviance of 14 is what noise makes of 1.6."""
    monkeypatch.setattr(confusion, "without_idle", lambda *given: given[-1])
    monkeypatch.setattr(confusion, "parts", lambda *_: [])
    best = model(square, "action_delay")
    found, more = with_another(best, square=square, gained=gained)
    sets = dict.fromkeys(("train", "validation"))
    assert rivals(found, "action_delay") == [more]
    assert settled(found, "action_delay", sets).best is (best, more)[front]


@pytest.mark.parametrize(("apart", "front"), [(-0.04, 0), (0.04, 0), (-0.3, 1)])
def test_of_twins_the_drives_comes_to_the_front(monkeypatch, apart, front):
    monkeypatch.setattr(confusion, "parts", lambda *_: [])
    drive, force = model(1.0, "action_bias"), model(1.0, "constant_force")
    share = 1.0 + apart / float((force.validation**2).sum())
    force = replace(force, validation=np.sqrt(share) * force.validation)
    sets = dict.fromkeys(("train", "validation"))
    for one, other in ((drive, force), (force, drive)):
        name = one.units[0].name
        found = replace(selection(one), alternatives={name: (other,)})
        assert settled(found, name, sets).best is (drive, force)[front]


@pytest.mark.parametrize(("apart", "front"), [(0.4, "gravity_tilt"), (1.9, "com_shift")])
def test_the_likeliest_group_of_equals_comes_to_the_front(monkeypatch, apart, front):
    """Two of the offsets together are likelier than a shifted centre of mass, if hardly worse."""
    monkeypatch.setattr(confusion, "parts", lambda *_: [])
    best = model(1.0, "com_shift")
    share = np.sqrt(1.0 + apart / float((best.validation**2).sum()))
    others = [model(1.0, name) for name in ("sensor_bias", "gravity_tilt")]
    others = [replace(one, validation=share * one.validation) for one in others]
    found = replace(selection(best), alternatives={"com_shift": tuple(others)})
    sets = dict.fromkeys(("train", "validation"))
    assert set(settled(found, "com_shift", sets).best.names) == {front}


@pytest.mark.parametrize(("parts", "front"), [((1.0, 1.0), 1), ((0.0, 1.0), 0)])
@pytest.mark.parametrize("name", ["payload", "armature"])
def test_one_gain_comes_to_the_front_of_bodies_that_are_all_heavier(
    monkeypatch, name, parts, front
):
    monkeypatch.setattr(confusion, "parts", lambda *_: [])
    heavier, gain = model(1.0, name), model(1.0, "action_gain")
    unit = replace(heavier.units[0], where="all", direction=parts)
    point = Point(np.zeros(1), {unit: 0.5})
    heavier = replace(heavier, fit=replace(heavier.fit, units=(unit,), point=point))
    share = np.sqrt(1.0 + 3.0 / float((gain.validation**2).sum()))  # likelier, but not by much
    gain = replace(gain, validation=share * gain.validation)
    found = replace(selection(heavier), alternatives={name: (gain,)})
    sets = dict.fromkeys(("train", "validation"))
    assert settled(found, name, sets).best is (heavier, gain)[front]


@pytest.mark.parametrize(("gained", "front"), [(4.0, 0), (20.0, 1)])
def test_a_number_of_a_law_that_was_fitted_has_its_price(monkeypatch, gained, front):
    monkeypatch.setattr(confusion, "parts", lambda *_: [])
    best, other = model(1.0, "com_shift"), model(1.0, "action_gain")
    unit = replace(other.units[0], effect=effect("action_gain", bend=-0.4))
    point = Point(np.zeros(1), {unit: 0.5})
    share = np.sqrt(1.0 - gained / float((other.validation**2).sum()))
    fit = replace(other.fit, units=(unit,), point=point)
    bent = replace(other, fit=fit, validation=share * other.validation)
    found = replace(
        selection(best), alternatives={"com_shift": (bent,)}, offered=(*best.units, *other.units)
    )
    others = found.alternatives, found.offered
    assert exchanged(found.nominal, best, *others) is (best, bent)[front]
    sets = dict.fromkeys(("train", "validation"))
    assert settled(found, "com_shift", sets).best is (best, bent)[front]


def held_aside(apart):
    """Return a shift along two axes beside drag, and a payload that is held aside, as likely.

    The drag beside the payload has a power of its own.
    """
    drag, other = (
        Unit(effect("quadratic_drag", power=p), "hinge", (1.0,), 0.0, 1.0) for p in (1.7, 1.6)
    )
    shifts = [Unit(effect("com_shift"), f"arm {a}", (1.0,), -1.0, 1.0) for a in "xz"]
    load = Unit(effect("payload", at_end=True, aside=-0.5), "arm", (1.0,), 0.0, 1.0)
    left = model(1.0)
    two, one = (
        replace(
            left,
            fit=replace(left.fit, units=units, point=Point(np.zeros(1), dict.fromkeys(units, 0.5))),
        )
        for units in ((drag, *shifts), (other, load))
    )
    share = np.sqrt(1.0 + apart / float((one.validation**2).sum()))
    one = replace(one, validation=share * one.validation)
    plain = replace(load, effect=effect("payload", at_end=True))
    found = replace(
        selection(two), alternatives={"com_shift": (one,)}, offered=(drag, other, *shifts, plain)
    )
    return found, two, one


@pytest.mark.parametrize(("apart", "front"), [(1.0, 1), (4.0, 0)])
def test_one_place_comes_to_the_front_of_several_that_are_no_likelier(monkeypatch, apart, front):
    monkeypatch.setattr(confusion, "parts", lambda *_: [])
    monkeypatch.setattr(confusion, "without_idle", lambda *given: given[-1])
    found, *models = held_aside(apart)
    sets = dict.fromkeys(("train", "validation"))
    assert settled(found, "com_shift", sets).best is models[front]


@pytest.mark.parametrize("fewer", [0, 1])
def test_of_equals_one_of_fewer_causes_comes_to_the_front(monkeypatch, fewer):
    """An offset and its change are one, whatever stands in the simulator for either."""
    monkeypatch.setattr(confusion, "parts", lambda *_: [])
    monkeypatch.setattr(confusion, "without_idle", lambda *given: given[-1])
    found, *models = held_aside(1.0)
    sets = dict.fromkeys(("train", "validation"))
    causes = lambda model: 1 if model is models[fewer] else 2
    assert settled(found, "com_shift", sets, causes=causes).best is models[fewer]


def test_a_rival_beside_a_law_of_another_form_is_known_by_its_own_name():
    found, _, one = held_aside(1.0)
    assert confusion.stand_in(found, one) == "payload"
    assert confusion_set(found, "com_shift") == ("com_shift", "payload")


@pytest.mark.parametrize(
    ("least", "gained", "front"), [(101.0, 70.0, 0), (101.0, 90.0, 1), (1.05, 20.0, 1)]
)
def test_more_places_have_to_explain_a_share_where_one_leaves_nothing(
    monkeypatch, least, gained, front
):
    """Unless noise hides most of what either explains."""
    monkeypatch.setattr(confusion, "parts", lambda *_: [])
    monkeypatch.setattr(confusion, "without_idle", lambda *given: given[-1])
    tilt, start = model(1.0, "gravity_tilt"), model(least)
    units = tuple(Unit(effect("com_shift"), f"arm {a}", (1.0,), -1.0, 1.0) for a in "xz")
    point = Point(np.zeros(1), dict.fromkeys(units, 0.5))
    share = np.sqrt(1.0 - gained / float((tilt.validation**2).sum()))
    shift = replace(
        tilt, fit=replace(tilt.fit, units=units, point=point), validation=share * tilt.validation
    )
    found = Selection(start, tilt, (), (), (start, tilt, shift), {"gravity_tilt": (shift,)})
    assert only_more(start, tilt, shift) is not bool(front)
    assert exchanged(start, tilt, found.alternatives) is (tilt, shift)[front]
    assert exchanged(start, shift, {"com_shift": (tilt,)}) is (tilt, shift)[front]
    assert (
        settled(found, "gravity_tilt", dict.fromkeys(("train", "validation"))).best
        is (tilt, shift)[front]
    )


def test_where_much_is_left_more_places_may_explain_hardly_more():
    start = model(1001.0)
    for left, more, alone in ((20.0, 19.5, False), (9.0, 8.5, True), (1.1, 0.6, True)):
        one = model(left, "gravity_tilt")
        assert only_more(start, one, model(more, "gravity_tilt", "com_shift")) is alone
