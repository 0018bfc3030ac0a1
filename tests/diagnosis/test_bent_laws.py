"""Laws that fit better than the best explanation, and lost because they predict worse."""

from dataclasses import replace

import numpy as np
import pytest
from plain_models import Unit, plain

from torchrl_bayessim.diagnosis import bent_laws

WAVE, PUSH, DRAG = (Unit(name) for name in ("cogging", "bias", "drag"))
SETS = "train", "validation"


def model(units, fitted, judged):
    """Return a model with so much left where it was fitted, and where it was judged."""
    known, segments = plain(units, 400.0), 20
    left, out = (np.full((segments, 10), np.sqrt(d / 10 / segments)) for d in (fitted, judged))
    return replace(known, fit=replace(known.fit, innovations=left), validation=out)


@pytest.fixture
def formed(monkeypatch):
    """Models whose laws were fitted."""
    asked = []

    def bent(train, validation, known, offered):
        asked.append(known)
        return model(known.units, 200.0, 200.0) if WAVE in known.units else known

    monkeypatch.setattr(bent_laws, "with_fitted_forms", bent)
    monkeypatch.setattr(bent_laws, "bendable", lambda _, units: DRAG not in units)
    return asked


def test_what_fits_better_and_predicts_worse_is_bent_to_the_data(formed):
    best = model([PUSH], 900.0, 900.0)
    waves, straight = model([WAVE], 300.0, 9000.0), model([DRAG], 200.0, 9000.0)
    other, worse = model([PUSH, WAVE], 400.0, 9000.0), model([WAVE, Unit("a")], 950.0, 9000.0)
    third = model([PUSH, Unit("b")], 500.0, 9000.0)
    found = bent_laws.fitted_best(SETS, best, [best, third, worse, straight, other, waves], [])
    assert formed == [waves, other]  # the two that fit best
    assert [known.names for known in found] == [waves.names, other.names]


def test_what_bending_leaves_as_it_is_is_not_returned_again(formed):
    best, pushed = model([DRAG], 900.0, 900.0), model([PUSH], 300.0, 9000.0)
    assert not bent_laws.fitted_best(SETS, best, [pushed], [])
    assert formed == [pushed]


@pytest.mark.parametrize("best", [None, model([PUSH], 220.0, 220.0)])
def test_nothing_is_bent_where_noise_alone_is_left_or_nothing_was_found(formed, best):
    assert not bent_laws.fitted_best(SETS, best, [model([WAVE], 100.0, 9000.0)], [])
    assert not formed
