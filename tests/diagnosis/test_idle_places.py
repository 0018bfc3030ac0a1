"""Places of an effect, and effects, that a model has for nothing."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from plain_models import A, B, C, Unit, plain

from torchrl_bayessim.diagnosis.credit import worthwhile
from torchrl_bayessim.diagnosis.elimination import _idle_place, _one_event, _without_doubt
from torchrl_bayessim.diagnosis.exchange import exchanged
from torchrl_bayessim.diagnosis.model import Model
from torchrl_bayessim.diagnosis.selection import Selection


@pytest.mark.parametrize(
    ("without", "idle"),
    [((9000.0, 505.0), 1), ((9000.0, 700.0), None), ((504.0, 505.0), None)],
)
def test_a_place_that_next_to_nothing_is_due_to_is_idle(without, idle):
    smaller = [plain([B], without[0]), plain([A], without[1])]
    assert _idle_place(plain([A, B], 500.0), smaller) == idle


def test_an_effect_of_its_own_is_not_idle():
    smaller = [plain([C], 9e6), plain([A], 510.0)]
    assert _idle_place(plain([A, C], 500.0), smaller) is None


@pytest.mark.parametrize(
    ("without", "judged", "logs", "needed"),
    [
        (9000.0, 1.0, 2, True),
        (4000.0, 1.0, 2, False),  # not down to noise
        (9000.0, 1.0, 1, False),  # whatever happened in that one
        (9000.0, 2.0, 2, False),  # it does not hold up
    ],
)
def test_what_the_runs_that_judge_never_excite_is_needed_by_the_runs_of_the_fit(
    without, judged, logs, needed
):
    """A speed limit, where only the runs of the fit are fast."""
    best = plain([A, C], 500.0)
    slow = plain([A], 500.0)
    fast = np.sqrt(without / 200) * np.ones_like(slow.fit.innovations)
    smaller = replace(slow, fit=replace(slow.fit, innovations=fast))
    best = replace(best, validation=np.sqrt(judged) * best.validation)
    of_logs = np.r_[np.arange(20) % logs, np.full(20, logs)]
    best, smaller = (replace(m, logs=of_logs) for m in (best, smaller))
    assert _without_doubt(smaller, best) == needed


def met(model, deviance):
    """Return the model with such a deviance in one segment of the fit."""
    left = model.fit.innovations.copy()
    left[7] = np.sqrt(deviance / left.shape[1])
    return replace(model, fit=replace(model.fit, innovations=left))


@pytest.mark.parametrize(
    ("once", "left", "judged", "needed"),
    [
        ((4000.0, 10.0), 1.0, 1.0, True),
        ((900.0, 10.0), 1.0, 1.0, False),  # many a law would
        ((4000.0, 16.0), 1.0, 1.0, False),  # it is not quite what happened
        ((1100.0, 14.0), 1.0, 1.0, True),
        ((4000.0, 10.0), 1.3, 1.0, False),  # more than noise is left elsewhere
        ((4000.0, 10.0), 1.0, 1.1, False),  # it does not hold up
        ((4000.0, 10.0), 1.0, 1.02, True),
    ],
)
def test_what_is_met_once_is_needed_by_the_run_in_which_it_was_met(once, left, judged, needed):
    """A speed limit, where the robot was once as fast."""
    slow, best = plain([A], 400.0), plain([A, C], 400.0 * left)
    slow = replace(slow, validation=best.validation)
    smaller, best = (met(m, there) for m, there in zip((slow, best), once, strict=True))
    best = replace(best, validation=np.sqrt(judged) * best.validation)
    assert _one_event(smaller, best) == needed


@pytest.mark.parametrize(
    ("without", "with_it", "where", "kept"),
    [
        (510.0, 500.0, "hip", {"gain"}),
        (900.0, 500.0, "hip", {"gain", "friction"}),
        (500.0, 420.0, "hip", {"gain", "friction"}),
        (500.0, 420.0, "knee", {"gain"}),
        (450.0, 420.0, "hip", {"gain"}),
    ],
    ids=["idle", "most of the rest", "surely elsewhere", "at the same joint", "faint"],
)
def test_an_effect_with_next_to_no_credit_is_named_only_if_nothing_else_can_be_it(
    without, with_it, where, kept
):
    friction = Unit("friction", where)
    start, best = plain([], 1e6), plain([A, friction], with_it)
    others = {"friction": (plain([A, Unit("drag", "hip")], 600.0),)}
    tried = (start, plain([A], without), plain([friction], 1e6))
    selection = Selection(start, best, (), (0.0,), tried, others)
    predictor = SimpleNamespace(system=SimpleNamespace(robot="robot"))
    left = worthwhile(selection, {"train": SimpleNamespace(predictor=predictor)})
    assert {one.name for one in left.best.units} == kept
    assert set(left.alternatives) == (kept if kept == {"gain"} else set(others))


@pytest.mark.parametrize(("share", "changed"), [(0.97, False), (0.5, True)])
def test_more_strengths_do_not_take_the_place_of_fewer_that_are_as_good(share, changed):
    rng = np.random.default_rng(0)
    best, more = plain([A], 5000.0), plain([Unit("delay", "x"), Unit("delay", "y")], 5000.0)
    each = rng.uniform(0.5, 1.5, len(best.validation))[:, None]  # better here, worse there
    fit = replace(more.fit, innovations=np.sqrt(share) * each * more.validation)
    other = Model(fit=fit, validation=fit.innovations, logs=more.logs)
    assert (exchanged(plain([], 6000.0), best, {"gain": (other,)}) is other) == changed


def test_a_model_of_fewer_effects_has_alternatives_of_its_own():
    """Not those that were tried beside what it lacks, nor what explains more."""
    drag, delay, push = Unit("drag"), Unit("delay", "x"), Unit("push")
    start, best, less = plain([], 1e6), plain([A, C], 500.0), plain([A], 510.0)
    beside, worse, better = plain([drag, C], 505.0), plain([drag], 512.0), plain([delay], 400.0)
    others = {"gain": (beside,), "friction": (plain([A, push], 502.0),)}
    selection = Selection(start, best, (), (0.0,), (start, worse, better), others)
    left = selection.reduced(less, [plain([push], 511.0), plain([push, drag], 509.0)])
    assert left.best is less
    assert [[u.name for u in m.units] for m in left.alternatives["gain"]] == [["drag"], ["push"]]
    assert set(left.alternatives) == {"gain"}
    assert len(left.tried) == 5


@pytest.mark.parametrize(("left", "kept"), [(440.0, {"gain", "friction"}), (620.0, {"gain"})])
def test_a_faint_effect_is_kept_where_next_to_nothing_is_left_with_it(left, kept):
    """It removes 170 of a deviance of which 400 is noise; where more is left it may be anything."""
    start, best = plain([], 400_000.0), plain([A, C], left)
    tried = (start, plain([A], left + 170.0), plain([C], 399_000.0))
    others = {"friction": (plain([A, Unit("drag")], left + 100.0),)}
    selection = Selection(start, best, (), (0.5,), tried, others)
    predictor = SimpleNamespace(system=SimpleNamespace(robot="robot"))
    kept_of = worthwhile(selection, {"train": SimpleNamespace(predictor=predictor)}).best
    assert kept_of.names == kept


@pytest.mark.parametrize(("credit", "lasting", "kept"), [
    (0.02, None, {"gain", "friction"}),
    (0.02, 1.0, {"gain", "friction"}),
    (0.02, 0.5, {"gain", "friction"}),
    (0.02, 0.1, {"gain"}),
    (1e-4, None, {"gain", "friction"}),  # next to nothing, but surely one of two
    (1e-4, 1.0, {"gain"}),
])  # fmt: skip
def test_beside_chance_an_effect_is_a_third_cause_and_its_credit_a_part_of_all(
    credit, lasting, kept
):
    knee = Unit("friction", "knee")
    start, best, gap = plain([], 400.0 + 150.0 / credit), plain([A, knee], 400.0), 150.0
    tried = (start, plain([A], 400.0 + gap), plain([knee], 400.0 + gap / credit))
    selection = Selection(start, best, (), (0.5,), tried, {"friction": ()})
    predictor = SimpleNamespace(system=SimpleNamespace(robot="robot"))
    sets = {"train": SimpleNamespace(predictor=predictor)}
    assert worthwhile(selection, sets, lasting=lasting).best.names == kept
