"""What varies by chance widens the covariance, and no longer hides what else is missing."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from plain_models import A, C, plain
from scipy.stats import multivariate_normal
from test_diagnose import ARM, FINER, as_log, commands, system

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.model import Model, shown, takes_most
from torchrl_bayessim.diagnosis.objective import Objective, Point
from torchrl_bayessim.diagnosis.refit import Fit
from torchrl_bayessim.diagnosis.selection import Selection
from torchrl_bayessim.diagnosis.varying import _cost, _widened, varying
from torchrl_bayessim.diagnosis.whitening import Whitening
from torchrl_bayessim.diagnosis.with_chance import _beside_variation

SEGMENTS, NUMBERS, DRAWS = 5, 6, 3


def roots():
    return np.random.default_rng(0).normal(size=(SEGMENTS, NUMBERS, DRAWS))


def test_the_deviance_is_that_of_the_wider_normal_distribution():
    left = np.random.default_rng(1).normal(size=(SEGMENTS, NUMBERS))
    wider = [np.eye(NUMBERS) + root @ root.T for root in roots()]
    both = [
        -2
        * sum(multivariate_normal(cov=cov).logpdf(row) for row, cov in zip(left, of, strict=True))
        for of in (wider, [np.eye(NUMBERS)] * SEGMENTS)
    ]
    gained = _cost(left, roots()) - (left**2).sum()
    assert gained == pytest.approx(both[0] - both[1])


def test_innovations_of_what_varies_so_are_white_again():
    rng = np.random.default_rng(2)
    factor = np.tril(rng.normal(size=(SEGMENTS, NUMBERS, NUMBERS))) + 3 * np.eye(NUMBERS)
    ones, drift = np.ones(SEGMENTS), rng.normal(size=(SEGMENTS, NUMBERS))
    white = Whitening(np.linalg.inv(factor), ones, ones[:, None, None], drift, 0.0)
    now = _widened(Objective(None, None, None, white), roots()).whitening
    for old, new, root, before, after in zip(
        factor, now.inverse, roots(), drift, now.drift, strict=True
    ):
        covariance = old @ (np.eye(NUMBERS) + root @ root.T) @ old.T
        assert new @ covariance @ new.T == pytest.approx(np.eye(NUMBERS), abs=1e-9)
        # what the time step makes is the same residual as before
        assert np.linalg.solve(new, after) == pytest.approx(old @ before)
    assert now.weights is white.weights


def of_runs(train, judged, units):
    """Return a model that leaves so much of each of the fit's runs, and of those that judge."""
    left = np.sqrt(np.array(train))[:, None]
    fit = Fit(Point(np.zeros(1), dict.fromkeys(units, 1.0)), units, left, np.zeros((len(left), 1)))
    return Model(fit, np.full((1, 1), judged**0.5), np.arange(len(left) + 1))


@pytest.mark.parametrize(
    ("train", "judged", "better"),
    [
        ([1, 1, 100], 0.5, True),  # who judges sees it
        ([1, 1, 100], 2.0, True),  # two runs do, plainly, and the judge does not disagree
        ([1, 1, 100], 3.5, False),  # it disagrees
        ([1, 95, 100], 2.0, False),  # one run only
        ([1, 1, 130], 2.0, False),  # another run disagrees
    ],
)
def test_what_runs_of_the_fit_show_plainly_need_not_be_in_those_that_judge(train, judged, better):
    judge = 10.0 if judged < 1 else 3.0
    base = of_runs([100, 100, 100], judge, (A,))
    assert shown(base, of_runs(train, judged, (A, C))) is better
    first = of_runs([100, 100, 100], judge, ())  # a first effect has to show where it is judged
    assert shown(first, of_runs(train, judged, (C,))) is (judged < 1)


@pytest.mark.parametrize(
    ("train", "better"),
    [
        ([1, 1, 1020, 900], True),  # by next to nothing, though it is more than chance
        ([1, 1, 1100, 900], False),  # by a tenth of its own, however much the others gain
        ([900, 900, 1020, 980], False),  # by much of what the others gain
    ],
)
def test_a_run_may_be_next_to_nothing_worse_for_what_others_show_plainly(train, better):
    base = of_runs([1000, 1000, 1000, 1000], 3.0, (A,))
    assert shown(base, of_runs(train, 2.0, (A, C))) is better


@pytest.mark.parametrize(
    ("left", "after", "instead"),
    [(2.3, 1.2, True), (2.1, 1.9, False), (4.8, 4.5, False), (1.3, 1.1, True)],
)
def test_what_explains_a_variation_is_not_found_beside_it(left, after, instead):
    before = of_runs([left] * 3, left, (A,))
    assert takes_most(before, of_runs([after] * 3, after, (A, C))) is instead


def test_a_model_without_effects_varies_in_nothing():
    assert varying(SimpleNamespace(), SimpleNamespace(units=()), (), ()) is None


@pytest.mark.parametrize(
    ("before", "after", "refused", "expected"),
    [
        (10.0, 1.0, False, "alone"),  # noise is left: nothing varied
        (10.0, 1.0, True, "alone"),  # though it had been refused where it could not be told
        (10.0, 3.0, False, "beside"),
        (10.0, 3.0, True, "before"),  # a little of everything helps
        (10.0, 8.0, True, "beside"),
        (10.0, 1.0, False, "dropped"),  # the search takes it out again
        (10.0, 1.0, True, "refused"),
    ],
)
def test_what_leaves_noise_alone_without_a_variation_stands_in_its_place(
    monkeypatch, *, before, after, refused, expected
):
    """Of 400 numbers."""
    first, both = plain([A], 400 * before), plain([A, C], 400 * after)
    tried = (first, plain([A, C], 400 * before)) if refused else (first,)
    selection = Selection(plain([], 1e5), first, ("seen",), (0.0,), tried, {}, (A, C))
    found, asked = SimpleNamespace(group="other", what="something varies"), []

    gone = expected in {"dropped", "refused"}

    def search(prepared, *, known, varied=False):
        asked.append((prepared, known.best, varied))
        best = both if varied or not gone else first
        return prepared if varied else "with its alarms", replace(known, best=best)

    where = "torchrl_bayessim.diagnosis.with_chance."
    monkeypatch.setattr(where + "varying", lambda *_: found)
    monkeypatch.setattr(where + "with_variation", lambda *_: "wider")
    monkeypatch.setattr(where + "_under_noise_alone", lambda *_: both)
    prepared, more = _beside_variation(search, "as it was", selection, ())
    alone = [("as it was", both, False)] if expected == "alone" or gone else []
    assert asked == [("wider", first, True), *alone]
    where = {"alone": "with its alarms", "beside": "wider", "dropped": "wider"}
    assert prepared == where.get(expected, "as it was")
    assert more.best is (first if expected in {"before", "refused"} else both)
    assert (more is selection) == (expected in {"before", "refused"})


def sampled(rng, steps, drag, jitter):
    """Return what sensors that are two samples late, more or less, show of an arm with drag."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.body_mass[1] *= 1.1
    model.body_inertia[1] *= 1.1
    model.opt.timestep /= FINER
    data = mujoco.MjData(model)
    data.qpos[0] = rng.normal(scale=0.5)
    u, fine, each = commands(rng, steps), [], 5 * FINER
    for k in range(steps * each):
        fine.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = u[k // each]
        data.qfrc_applied[0] = -drag * data.qvel[0] * abs(data.qvel[0])
        mujoco.mj_step(model, data)
    at = each * (np.arange(steps) - 2 - jitter * rng.uniform(-1, 1, steps))
    state = [np.interp(at, np.arange(len(fine)), one) for one in np.transpose(fine)]
    return np.stack(state, 1) + rng.normal(size=(steps, 2)) * [0.002, 0.02], u


@pytest.mark.parametrize(("drag", "jitter"), [(0.003, 0.6), (0.0, 0.5)])
def test_drag_is_found_beside_samples_that_are_late_by_other_times_and_only_where_it_is(
    drag, jitter
):
    rng = np.random.default_rng(0)
    data = [as_log(f"run{i}", *sampled(rng, 200, drag, jitter)) for i in range(6)]
    effects = "action_delay", "sensor_delay", "action_lag", "quadratic_drag", "coulomb_friction"
    report = diagnose(system(), None, data, effects=effects)
    assert report.effects[0].name in {"action_delay", "action_lag"}
    named = {effect.name: effect.strength for effect in report.effects[1:]}
    assert named == ({"quadratic_drag": pytest.approx(drag, rel=0.2)} if drag else {})
    noted = [alarm for alarm in report.alarms if "that counts as noise here" in alarm]
    assert len(noted) == bool(drag)
    told = [alarm for alarm in report.alarms if "that explains what remains" in alarm]
    assert len(told) == (not drag)
    (alarm,) = noted or told
    assert "samples are late by times that vary by 0.00" in alarm
    assert report.gap.with_effects > 2  # what varies is a part of the gap
