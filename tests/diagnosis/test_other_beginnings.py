"""Two causes that a third law imitates alone, so that a search begins with neither."""

from types import SimpleNamespace

import numpy as np
import pytest
from plain_models import A, B, C, Unit, plain
from test_diagnose import ARM, logs, system
from test_search import Scripted

from torchrl_bayessim.diagnosis import search as searching
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.objective import units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.diagnosis.selection import select
from torchrl_bayessim.effects.catalogue import effect

SPRING, ROTOR, PAYLOAD, WAVE = (Unit(n) for n in ("spring", "rotor", "payload", "wave"))


def test_a_spring_beside_a_heavier_rotor_is_no_payload():
    heavier = ARM.replace('<joint name="hinge"', '<joint name="hinge" armature="0.022"')
    data = logs(8, push=lambda q, v: -0.44 * q, xml=heavier)
    some = (
        "payload", "com_shift", "action_gain", "sensor_gain", "armature", "parallel_spring",
        "time_scale", "cogging", "coulomb_friction",
    )  # fmt: skip
    report = diagnose(system(), None, data, effects=some)
    assert report.verdict == "named"
    found = {effect.name: effect.strength for effect in report.effects}
    assert found == {
        "parallel_spring": pytest.approx(0.44, rel=0.03),
        "armature": pytest.approx(0.022, rel=0.05),
    }


class Begun(Scripted):
    """A search of which it is known what is found beside each effect."""

    def __init__(self, best, beside):
        super().__init__({}, {})
        self.tried = [best, *(plain([unit], 1e5 + i) for i, unit in enumerate(beside))]
        self.again, self.offered, self.units = None, [SPRING], [PAYLOAD]
        self.beside, self.begun = beside, []

    def _two(self, one):
        self.begun.append(one.units[0])
        two = self.beside[one.units[0]]
        self.tried.append(two)
        return two


@pytest.mark.parametrize(
    ("best", "left", "taken"),
    [
        ([PAYLOAD], 900.0, True),
        ([PAYLOAD], 700.0, False),  # a law in another form may leave as much
        ([PAYLOAD, C], 700.0, True),
        ([PAYLOAD, C], 450.0, False),
        ([PAYLOAD, C, WAVE], 405.0, True),  # three effects explain no more than two
        ([], 900.0, False),
    ],
)
def test_where_more_than_noise_is_left_a_search_goes_on_from_what_explains_less(best, left, taken):
    two, before = plain([SPRING, ROTOR], 410.0), plain(best, left)
    beside = {
        PAYLOAD: plain([PAYLOAD, A], 405.0),
        SPRING: None,
        ROTOR: two,
        A: plain([A, C], 430.0),
    }
    search = Begun(before, beside)
    assert search.or_two_others(before) is (two if taken else before)
    assert search.begun == [SPRING, ROTOR, A][: 3 * taken]
    assert search.units == ([SPRING] if taken else [PAYLOAD])


@pytest.mark.parametrize(("left", "pairs"), [
    (385.0, [410.0]),  # the three explain more
    (300.0, [314.5]),  # less than noise, of which two "take most" whatever they do
    (405.0, [410.0, 411.5]),  # another two do as well, though they cost more than the three
])  # fmt: skip
def test_three_effects_stay_if_two_cost_more_or_another_two_do_as_well(left, pairs):
    before = plain([PAYLOAD, C, WAVE], left)
    others = [plain(units, p) for units, p in zip(([SPRING, ROTOR], [A, B]), pairs, strict=False)]
    search = Begun(before, dict(zip((SPRING, A), others, strict=False)))
    assert search.or_two_others(before) is before
    assert search.begun == [SPRING, A][: len(pairs)]


@pytest.mark.parametrize("others", [[plain([SPRING, ROTOR], 470.0)], [
    plain([SPRING, ROTOR], 410.0), plain([A, C], 411.0),
]])  # fmt: skip
def test_two_that_explain_little_more_or_two_pairs_that_do_are_not_taken(others):
    before = plain([PAYLOAD, WAVE], 485.0)
    search = Begun(before, dict(zip((ROTOR, A), others, strict=False)))
    tried = list(search.tried)
    assert search.or_two_others(before) is before
    assert search.begun
    assert search.tried == tried


def test_no_more_than_so_many_are_begun_from_in_a_search_of_few_effects_that_began_anew():
    before, kinds = plain([PAYLOAD], 900.0), [Unit(f"law {i}") for i in range(9)]
    search = Begun(before, dict.fromkeys(kinds))
    assert search.or_two_others(before) is before
    assert search.begun == kinds[:5]
    search = Begun(before, dict.fromkeys(kinds))
    search.again = list
    assert search.or_two_others(before) is before
    search.again, search.offered = None, [SPRING] * 151
    assert search.or_two_others(before) is before
    assert not search.begun


@pytest.mark.parametrize(
    ("found", "needs", "kept"),
    [
        (plain([ROTOR, SPRING], 410.0), None, True),
        (plain([ROTOR, SPRING], 500.0), None, False),
        (plain([ROTOR, SPRING], 410.0), plain([SPRING], 411.0), False),
        (None, None, False),
    ],
)
def test_two_have_to_leave_noise_alone_and_need_each_other(monkeypatch, found, needs, kept):
    one, pair, three = (plain(units, 420.0) for units in (
        [ROTOR], [ROTOR, SPRING], [ROTOR, SPRING, WAVE],
    ))  # fmt: skip
    given = []

    def explained(now, best_of):
        best_of([one, pair, three])
        return found

    search = Scripted({}, {} if needs is None else {found.units: needs})
    search.sets, search.offered = ("train", "judge"), [ROTOR, SPRING]
    search.progress, search.shapes = (lambda _: None), (lambda _: [])
    search._explained = explained
    search._better = lambda base, models, seen: given.extend(models)
    monkeypatch.setattr(searching, "refit", lambda _, points, iterations: [one.fit])
    monkeypatch.setattr(searching, "with_forms_of", lambda units, _: units)
    monkeypatch.setattr(searching, "with_shapes", lambda units, _: units)
    monkeypatch.setattr(searching, "compare", lambda _, fit, units: SimpleNamespace(seen=units))
    assert search._two(one) is (found if kept else None)
    assert given == [pair]


def test_a_search_that_goes_on_from_two_has_as_many_rounds_less():
    names = [Unit(f"law {i}") for i in range(9)]
    further = {
        tuple(names[:count]): plain(names[: count + 1], 1e5 / (1 + count)) for count in range(8)
    }
    search = Scripted(further, {})
    assert len(search.best().names) == 4
    assert len(search.best(further[names[0],]).names) == 4


@pytest.mark.parametrize("pairs", [True, False])
def test_two_others_are_looked_for_if_that_is_asked(monkeypatch, pairs):
    asked = []
    monkeypatch.setattr(
        "torchrl_bayessim.diagnosis.search.Search.or_two_others",
        lambda _, best: asked.append(best) or best,
    )
    system_, noise = system(), np.random.default_rng(0)
    prepared = prepare(system_, logs(6), [], generator=noise)
    sets = prepared.sets["train"], prepared.sets["validation"]
    units = units_of([effect("armature")], system_.robot)
    select(*sets, prepared.nominal, units, pairs=pairs, generator=noise)
    assert len(asked) == pairs
