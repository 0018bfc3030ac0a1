"""Rounds that add to a model, and what they take out again."""

from types import SimpleNamespace

import pytest
from plain_models import A, B, C, Unit, plain

from torchrl_bayessim.diagnosis import search as searching
from torchrl_bayessim.diagnosis.search import Search

WEAK = Unit("magnets", "hip")


class Scripted(Search):
    """A search of which it is known what its rounds find, and what of that is needed."""

    def __init__(self, further, needs):
        self.start, self.further, self.needs, self.asked = plain([], 1e6), further, needs, []

    def _further(self, best):
        self.asked.append(best.units)
        return self.further.get(best.units)

    def _needs(self, best):
        return self.needs.get(best.units, best)


@pytest.mark.parametrize(
    ("left", "rounds"), [(20_000.0, 4), (450.0, 3)], ids=["more than noise", "noise alone"]
)
def test_what_is_left_without_a_stopgap_is_searched_again(left, rounds):
    """A centre of mass stood in for a payload, and beside both nothing else seemed worth it."""
    alone, both, payload = plain([A], 30_000.0), plain([A, C], left - 1), plain([C], left)
    found = plain([C, WEAK], 440.0)
    search = Scripted({(): alone, (A,): both, (C,): found}, {(A, C): payload})
    best = search.best()
    assert len(search.asked) == rounds
    assert best is (found if rounds == 4 else payload)


def test_a_search_that_goes_in_circles_ends():
    alone, both, payload = plain([A], 30_000.0), plain([A, C], 20_000.0), plain([C], 20_001.0)
    search = Scripted({(): alone, (A,): both, (C,): both}, {(A, C): payload})
    assert search.best() is payload
    assert len(search.asked) == 4


def test_nothing_is_searched_again_where_all_is_needed():
    alone = plain([A], 30_000.0)
    search = Scripted({(): alone}, {})
    assert search.best() is alone
    assert search.asked == [(), (A,)]


@pytest.mark.parametrize(("left", "led"), [(2400.0, True), (700.0, True), (500.0, False)])
def test_where_more_than_noise_is_left_a_limit_is_led_to_and_what_is_alike_too(
    monkeypatch, left, led
):
    """A push was preferred to a bias before the limit, between which corners do not tell."""
    push, bias = (plain([A, other], left + i) for i, other in enumerate((C, WEAK)))
    others = [plain([A, C, WEAK], left - 100), plain([A], 5e5), bias, push]
    soft, given = plain([A, WEAK], 410.0), []

    def softened(_, __, models, ___, *, most):
        given.extend(models)
        return [plain([A, C], 600.0), soft][:most]

    monkeypatch.setattr(searching, "explanations", lambda *_: [])
    monkeypatch.setattr(searching, "judged", lambda *_: others)
    monkeypatch.setattr(searching, "exactly", lambda _, __, model: model)
    monkeypatch.setattr(searching, "with_fitted_forms", lambda _, __, model, ___: model)
    monkeypatch.setattr(searching, "softened", softened)
    monkeypatch.setattr(searching, "fitted_best", lambda *_: [])
    search = Scripted({}, {})
    search.sets, search.varied, search.tried, search.offered = ("train", "judge"), False, [], []
    found = search._explained(SimpleNamespace(base=plain([], 1e6).fit), lambda _: push)
    assert found is (soft if led else push)
    assert given == ([push, bias] if led else [])


def test_laws_that_fit_best_are_bent_before_it_is_decided(monkeypatch):
    push, wave, bent = plain([C], 900.0), plain([A], 1200.0), plain([B], 410.0)
    asked = []

    def fitted_best(_, better, models, __):
        asked.append((better, list(models)))
        return [bent]

    monkeypatch.setattr(searching, "explanations", lambda *_: [])
    monkeypatch.setattr(searching, "judged", lambda *_: [push, wave])
    monkeypatch.setattr(searching, "exactly", lambda _, __, model: model)
    monkeypatch.setattr(searching, "with_fitted_forms", lambda _, __, model, ___: model)
    monkeypatch.setattr(searching, "fitted_best", fitted_best)
    search = Scripted({}, {})
    search.sets, search.varied, search.tried, search.offered = ("train", "judge"), False, [], []
    best = lambda models: min(models, key=lambda model: model.mean_square)
    assert search._explained(SimpleNamespace(base=plain([], 1e6).fit), best) is bent
    assert asked == [(push, [push, wave])]
    assert bent in search.tried


@pytest.mark.parametrize(
    ("names", "varied", "goes_on"),
    [([A], True, "known"), ([A], False, "known"), ([], True, "found"), ([], False, "nothing")],
    ids=["an effect beside what varies", "an effect", "what varies alone", "noise alone"],
)
def test_beside_what_varies_the_search_goes_on_though_nothing_else_was_known(
    monkeypatch, names, varied, goes_on
):
    """A gap in a drive, beside jitter that was all that had been found."""
    known, found, asked = plain(names, 440.0), plain([C], 400.0), []
    robot = SimpleNamespace(predictor=SimpleNamespace(system=SimpleNamespace(robot=None)))
    monkeypatch.setattr(searching, "compare", lambda *_: SimpleNamespace(seen=None))
    monkeypatch.setattr(searching, "_p_value", lambda *_: 1e-9)
    search = Scripted({}, {})
    vars(search).update(
        again=lambda: asked.append(1) or [known], varied=varied, units=[], screens=[], p_values=[],
        tried=[], sets=(robot, None), alpha=0.01, generator=None, progress=lambda _: None,
    )  # fmt: skip
    search._explained = lambda *_: found
    answers = {"known": known, "found": found, "nothing": None}
    assert Search._further(search, search.start) is answers[goes_on]
    assert asked == [1]
