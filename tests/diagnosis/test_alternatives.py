"""What is tried in the place of an effect."""

from types import SimpleNamespace

import numpy as np
import pytest
from plain_models import Unit, plain

from torchrl_bayessim.diagnosis import alternatives
from torchrl_bayessim.diagnosis.objective import Objective, Point

GAIN, PAYLOAD, DRAG, OFFSET = (Unit(name) for name in ("gain", "payload", "drag", "offset"))


@pytest.mark.parametrize(("deviance", "count"), [(1175.0, 1), (5000.0, 0)])
def test_what_was_as_good_alone_is_tried_beside_the_others_from_its_own_parameters(
    monkeypatch, deviance, count
):
    monkeypatch.setattr(alternatives, "judged_fits", lambda *given, race: given[-1])
    best = plain({GAIN: -0.5, OFFSET: 0.1}, 320.0)
    tried = [
        plain({}, 17_000.0),
        plain({GAIN: -0.5}, 1172.0),
        plain({PAYLOAD: 1.0}, deviance, z=3.0),
        plain({DRAG: 1.0, PAYLOAD: 1.0}, 1170.0),  # two in the place of one
        plain({OFFSET: 0.3}, 1170.0),  # there already
    ]
    starts = alternatives._as_before(("train", "validation"), best, "gain", tried)
    assert len(starts) == count
    for start in starts:
        assert start.strengths == {OFFSET: 0.1, PAYLOAD: 1.0}
        assert start.z == 3.0
    assert not alternatives._as_before(("train", "validation"), tried[1], "gain", tried)


@pytest.mark.parametrize(
    ("places", "numbers", "count"), [(2, 2, 1), (1, 1, 0), (2, 3, 0)],
    ids=["as many numbers", "at one place", "more numbers once bent"],
)  # fmt: skip
def test_a_law_that_bends_is_tried_in_the_place_of_an_effect_with_as_many_numbers(
    monkeypatch, places, numbers, count
):
    """A payload held aside, whose second number says where, and a centre of mass in one or two."""
    shift = [Unit("com_shift", where) for where in ("x", "y")[:places]]
    best, aside = plain(shift, 300.0), plain([PAYLOAD], 305.0)
    known_numbers = {best: places, aside: numbers}
    monkeypatch.setattr(alternatives, "fitted_numbers", lambda model, _: known_numbers[model])
    monkeypatch.setattr(alternatives, "bendable", lambda _, units: PAYLOAD in units)
    monkeypatch.setattr(alternatives, "with_fitted_forms", lambda *_: aside)
    known = [plain([PAYLOAD], 9000.0), plain([PAYLOAD], 8000.0), plain([DRAG], 7000.0)]
    found = alternatives._bent(("train", "validation"), best, known, [])
    assert found == [aside] * count


@pytest.mark.parametrize(
    ("places", "kept", "numbers"),
    [(2, {DRAG: 1.0}, 4), (2, {DRAG: 1.0}, 5), (1, {DRAG: 1.0}, 3), (2, {}, 3)],
    ids=["one number more", "two more", "at one place", "alone"],
)
def test_one_law_that_bends_is_tried_in_the_place_of_several_beside_another(
    monkeypatch, places, kept, numbers
):
    """Neither the payload as it is offered nor one of another kind comes near."""
    shift = [Unit("com_shift", where, group="inertia") for where in ("x", "y")[:places]]
    laws = [Unit("payload", "hip", group="inertia"), Unit("spring", "hip", group="elasticity")]
    best, aside = plain([*shift, *kept], 300.0), plain([laws[0], *kept], 290.0)
    tried = []

    def fits(*given):
        tried.extend(given[-1])
        return [plain(dict(start.strengths), 9000.0) for start in given[-1]]

    monkeypatch.setattr(alternatives, "judged_fits", fits)
    monkeypatch.setattr(
        alternatives, "fitted_numbers", lambda model, _: numbers if model is aside else 3
    )
    monkeypatch.setattr(alternatives, "bendable", lambda *_: True)
    monkeypatch.setattr(alternatives, "with_fitted_forms", lambda *_: aside)
    found = alternatives._of_one_law(("train", "validation"), best, kept, [*laws, *shift])
    assert found == [aside] * (places > 1 and bool(kept) and numbers < 5)
    assert all(laws[0] in start.strengths and DRAG in start.strengths for start in tried)


def test_what_explains_nearly_as_much_is_bent_to_the_data(monkeypatch):
    """Only the best with each effect, and none that explains much less or has nothing to bend."""
    bent = {}

    def forms(_, __, model, ___):
        bent[model] = plain(list(model.units), 300.0) if PAYLOAD in model.units else model
        return bent[model]

    monkeypatch.setattr(alternatives, "with_forms_anew", forms)
    monkeypatch.setattr(alternatives, "bendable", lambda _, units: OFFSET not in units)
    start, best = plain([], 10_000.0), plain([GAIN], 310.0)
    near = [plain([PAYLOAD], 500.0), plain([PAYLOAD], 600.0), plain([DRAG], 700.0)]
    others = [plain([Unit("late")], 900.0), plain([OFFSET], 400.0)]
    known = [*near, *others]
    found = alternatives._in_their_forms(("train", "validation"), best, known, [], start=start)
    assert set(bent) == {near[0], near[2]}
    assert found == [bent[near[0]]]


@pytest.mark.parametrize(("left", "count"), [(2400.0, 1), (1600.0, 0)])
def test_laws_with_a_corner_are_softened_where_much_is_left(monkeypatch, left, count):
    monkeypatch.setattr(alternatives, "bendable", lambda *_: False)
    monkeypatch.setattr(alternatives, "softened", lambda _, __, models, ___, *, most: models[:most])
    start, best, near = plain([], 1e6), plain([OFFSET], left), plain([PAYLOAD], 1.1 * left)
    known = [near, plain([DRAG], 2e5)]
    sets = "train", "validation"
    found = alternatives._in_their_forms(sets, best, known, [], start=start)
    assert found == [near] * count


@pytest.mark.parametrize("alone", [True, False])
def test_what_imitates_a_lone_effect_beside_other_parameters_is_fitted_in_its_place(
    monkeypatch, alone
):
    raced = []
    for name in ("_as_before", "_bent", "_of_one_law", "_sliding", "_sticking", "_in_their_forms"):
        monkeypatch.setattr(alternatives, name, lambda *_, **__: [])
    monkeypatch.setattr(alternatives, "_raced", lambda _, starts, __: raced.extend(starts) or [])
    monkeypatch.setattr(alternatives, "judged_fits", lambda *_: [plain({}, 900.0)])
    screen = SimpleNamespace(best=lambda _: {})
    monkeypatch.setattr(alternatives, "compare", lambda *_: SimpleNamespace(seen=screen))
    monkeypatch.setattr(
        alternatives, "imitators", lambda *_, most: [Point(np.zeros(1), {PAYLOAD: 0.1})]
    )
    best = plain([GAIN] if alone else [GAIN, OFFSET], 320.0)
    alternatives.alternatives(
        SimpleNamespace(width=Objective.width), "validation", best,
        units=[], tried=[plain({}, 900.0)], first=screen, offered=[],
    )  # fmt: skip
    assert [list(start.strengths) for start in raced] == [[PAYLOAD]] * alone
