"""What the search says is missing is said of the model beside which it was looked for."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from plain_models import A, C, Unit, plain

from torchrl_bayessim.diagnosis import search as module
from torchrl_bayessim.diagnosis.search import Search
from torchrl_bayessim.diagnosis.selection import Selection

UNITS = A, C, Unit("drag", "hip"), Unit("delay", "x"), Unit("lag", "y")


def test_what_is_missing_is_unknown_where_effects_were_exchanged_since():
    best, other = plain([A], 500.0), plain([C], 450.0)
    found = Selection(plain([], 1e4), best, (), (1e-60, 1e-9), (), {})
    found = replace(found, screened=frozenset(best.names))
    assert found.missing == 1e-9
    assert replace(found, best=other).missing == 1.0
    assert replace(found, best=plain([A, C], 420.0)).missing == 1.0
    assert replace(found, p_values=()).missing == 1.0


@pytest.mark.parametrize("effects", [1, 2, 3, 4])
def test_a_search_knows_beside_what_it_looked_last(monkeypatch, effects):
    """After the fourth effect it does not look again: the last p-value is that effect's own."""
    models = [plain(UNITS[:count], 1e6 * 0.1**count) for count in range(effects + 1)]
    train = SimpleNamespace(predictor=SimpleNamespace(system=SimpleNamespace(robot=None)))
    search = Search(
        train, None, models[0], UNITS, again=None, varied=True, shapes=lambda _: (), alpha=0.01,
        generator=None, progress=lambda _: None,
    )  # fmt: skip
    monkeypatch.setattr(module, "compare", lambda *_: SimpleNamespace(seen=None))
    for name in ("nothing_left", "_may_be_rounded"):
        monkeypatch.setattr(module, name, lambda *_: False)
    monkeypatch.setattr(module, "bent", lambda _: False)
    more = lambda model: models[len(model.units) + 1 :]
    monkeypatch.setattr(module, "_p_value", lambda _, model, __: 1e-9 if more(model) else 0.5)
    monkeypatch.setattr(
        Search, "_explained", lambda self, now, better: next(iter(search.next), None)
    )
    monkeypatch.setattr(Search, "_needs", lambda self, best: best)
    further = Search._further

    def looked(self, best):
        self.next = more(best)
        return further(self, best)

    monkeypatch.setattr(Search, "_further", looked)
    best = search.best()
    assert best is models[-1]
    p_values = tuple(search.p_values)
    found = Selection(models[0], best, (), p_values, (), {}, screened=search.screened)
    assert p_values[-1] == (0.5 if effects < 4 else 1e-9)
    assert found.missing == (0.5 if effects < 4 else 1.0)
