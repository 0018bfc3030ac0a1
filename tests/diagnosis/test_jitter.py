"""Jitter of commands by the response to each of them: where, how much, and what lasts beside it."""

from types import SimpleNamespace

import numpy as np
import pytest
from noisy_cheetah import cheetah
from scipy.stats import multivariate_normal
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis.beside_jitter import (
    _better,
    _Seen,
    _with_jitter,
    beside_jitter,
    outdone,
)  # fmt: skip
from torchrl_bayessim.diagnosis.chance import drawn
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.jitter import Responses, jitter, moments, shaken
from torchrl_bayessim.diagnosis.loss_segments import loss_segments
from torchrl_bayessim.diagnosis.model import judged_fits
from torchrl_bayessim.diagnosis.moved_innovations import SCATTER, Judged, Moved, tell
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.effects.action import ActionJitter
from torchrl_bayessim.effects.disturbance import ConstantForce

SOME = (
    "action_delay", "action_lag", "action_jitter", "packet_drop", "coulomb_friction",
    "viscous_friction",
)  # fmt: skip
SEGMENTS, NUMBERS, DRAWS, DT = 4, 6, 2, 0.05


def late(seed, most, *, least=0.0):
    """Return a drive whose commands are late by another time each, in steps."""
    rng = np.random.default_rng(seed)

    def act(u, k):
        steps = rng.uniform(least, most)
        whole = int(steps)
        now, before = u[max(k - whole, 0)], u[max(k - whole - 1, 0)]
        return now + (steps - whole) * (before - now)

    return act


def some(seed=0):
    """Return segments that chance may have moved, and how."""
    rng = np.random.default_rng(seed)
    left = rng.normal(size=(SEGMENTS, NUMBERS))
    judged = Judged(None, None, left, rng.normal(size=(SEGMENTS, NUMBERS, 3)))
    mean, roots = rng.normal(size=left.shape), rng.normal(size=(*left.shape, DRAWS))
    return judged, mean, roots


def test_the_deviance_is_that_of_the_normal_distribution():
    judged, mean, roots = some()
    change = np.array([0.2, -0.1, 0.3])
    costs, standard = Moved.of(mean, roots).deviances(judged, change)
    for phi, cost in zip(SCATTER, costs, strict=True):
        for i in range(SEGMENTS):
            covariance = phi * np.eye(NUMBERS) + roots[i] @ roots[i].T
            at = judged.left[i] + judged.derivatives[i] @ change
            density = multivariate_normal(-mean[i], covariance).logpdf(at)
            assert cost[i] == pytest.approx(-2 * density - NUMBERS * np.log(2 * np.pi))
    error = judged.left + mean + judged.derivatives @ change
    covariance = np.eye(NUMBERS) + roots @ roots.mT
    exact = np.einsum("sm,smn,sn->s", error, np.linalg.inv(covariance), error) / NUMBERS
    assert standard == pytest.approx(exact)


def test_the_fit_changes_to_where_it_is_likeliest():
    judged, mean, roots = some(1)
    change = Moved.of(mean, roots).change(judged)

    def cost(at):
        error = judged.left + mean + judged.derivatives @ at
        inverse = np.linalg.inv(np.eye(NUMBERS) + roots @ roots.mT)
        return np.einsum("sm,smn,sn->", error, inverse, error) + at @ at

    for step in 0.01 * np.eye(3):
        assert cost(change) < min(cost(change + step), cost(change - step))
    judge = some(2)[0]
    told = tell([judged, judge], [Moved.of(mean, roots)] * 2)
    assert told.change == pytest.approx(change)
    assert told.costs.shape == (2 * SEGMENTS,)


@pytest.mark.parametrize("steps", [0.3, 1.0, 1.7])
def test_moments_are_those_of_the_effect(steps):
    rng = np.random.default_rng(3)
    ctrl, rows = rng.normal(size=(2, 6)), np.array([3, 4, 5])
    acting = []
    for part in (np.arange(4000) + 0.5) / 4000 * steps:
        whole = int(part)
        acting.append(ctrl[:, rows - whole] * (1 - part + whole)
                      + ctrl[:, rows - whole - 1] * (part - whole))  # fmt: skip
    change, variance = moments(ctrl, rows, steps)
    assert change == pytest.approx(np.mean(acting, 0) - ctrl[:, rows], abs=1e-3)
    assert variance == pytest.approx(np.var(acting, 0), rel=0.01)


@pytest.fixture(scope="module")
def prepared():
    """Return logs of an arm whose commands are late, and jitter of its drive."""
    data = logs(act=late(0, 1.2))
    (unit,) = units_of([ActionJitter()], system().robot)
    return prepare(system(), data, [], generator=np.random.default_rng(0)), unit


def test_innovations_move_as_draws_of_the_effect_say(prepared):
    prepared, unit = prepared
    point = prepared.nominal.point
    one = Responses.of(prepared.sets["train"], point, 8)
    moved = one.moved(unit, 0.008)
    objective = one.judged.objective
    draws = drawn(objective, [Point(point.z, {unit: 0.008})], 300)[0] - one.judged.left
    spread = draws.std(0).mean()
    assert moved.mean == pytest.approx(draws.mean(0), abs=0.3 * spread)
    roots = moved.vectors * np.sqrt(moved.values)[:, None]
    variances = (roots**2).sum(-1)
    assert variances.sum() == pytest.approx(draws.var(0).sum(), rel=0.1)
    strong = variances > 0.2 * variances.max()
    assert variances[strong] == pytest.approx(draws.var(0)[strong], rel=0.4)


def test_the_strength_is_known_and_no_force_is_as_likely(prepared):
    prepared, unit = prepared
    judged = [
        Responses.of(prepared.sets[name], prepared.nominal.point, 40)
        for name in ("train", "validation")
    ]
    found = jitter(judged, [unit])
    assert abs(found.strength - 0.012) < 3 * found.error < 0.006
    assert 0.7 < found.told.scatter < 1.3
    assert found.cost < shaken(judged, unit) - 20


def rough(rng, steps):
    """Return commands that turn in every row."""
    return np.clip(1.5 * rng.standard_normal(steps), -4, 4)


def test_what_counts_as_noise_is_the_scatter_of_the_commands_that_were_sent(monkeypatch):
    """Their mean is much smoother than they are."""
    monkeypatch.setattr("test_diagnose.commands", rough)
    data, robot = logs(act=late(3, 1.0)), system()
    (unit,) = units_of([ActionJitter()], robot.robot)
    prepared = prepare(robot, data, [], generator=np.random.default_rng(0))
    sets = prepared.sets["train"], prepared.sets["validation"]
    judged = [Responses.of(one, prepared.nominal.point, 40) for one in sets]
    found = jitter(judged, [unit])
    assert found.strength == pytest.approx(0.01, rel=0.35)  # and noise was thought to be more
    (base,) = judged_fits(*sets, [prepared.nominal.point])
    roots = {}
    monkeypatch.setattr(
        "torchrl_bayessim.diagnosis.beside_jitter.widened",
        lambda prepared, given: roots.update(given) or prepared,
    )
    _with_jitter(prepared, _Seen(base, found, np.zeros(1)), np.random.default_rng(1))
    for name, one in zip(("train", "validation"), judged, strict=True):
        expected = one.moved(unit, found.strength).values.sum(-1).mean()
        assert (roots[name] ** 2).sum((1, 2)).mean() > 0.8 * expected


def test_what_the_search_no_longer_needs_beside_jitter_does_not_come_back(prepared):
    prepared, unit = prepared
    sets = prepared.sets["train"], prepared.sets["validation"]
    judged = [Responses.of(one, prepared.nominal.point, 40) for one in sets]
    (push,) = units_of([ConstantForce()], system().robot)
    start = prepared.nominal.point
    nothing, pushed = judged_fits(*sets, [start, Point(start.z, {push: 1e-4})])
    seen = _Seen(pushed, jitter(judged, [unit]), np.zeros(1))
    more = SimpleNamespace(best=nothing, reduced=lambda base: SimpleNamespace(best=base))
    found, kept = _better(prepared, prepared, seen, more=more, units=[unit])
    assert found.base is kept.best is nothing
    seen, more.best = _Seen(nothing, seen.jitter, np.zeros(1)), pushed  # and need not come in
    found, kept = _better(prepared, prepared, seen, more=more, units=[unit])
    assert found is seen
    assert not kept.best.units


def test_losses_are_outdone_only_by_jitter_that_is_plainly_likelier(prepared):
    prepared, unit = prepared
    segments = loss_segments(prepared)
    suspects = SimpleNamespace(nominal=segments, best={})
    judged = [
        Responses.of(segments[name].objective, segments[name].point, len(segments[name].left))
        for name in ("train", "validation")
    ]
    cost = jitter(judged, [unit]).cost

    def lost(deviance, gain):
        return SimpleNamespace(deviance=deviance, gain=gain, beside=False)

    assert outdone(suspects, [lost(cost + 41, 100.0)], [unit])
    assert not outdone(suspects, [lost(cost + 39, 100.0)], [unit])
    assert not outdone(suspects, [lost(cost + 150, 1000.0)], [unit])
    assert not outdone(suspects, [lost(cost + 41, 100.0), lost(cost, 100.0)], [unit])
    assert not outdone(suspects, [lost(cost + 41, 100.0)], [])


def test_jitter_is_named_beside_drag_in_the_place_of_a_lag():
    data = logs(12, act=late(1, 1.5), push=lambda q, v: -0.04 * v * abs(v))
    report = diagnose(system(), None, data, effects=[*SOME, "quadratic_drag"])
    found = {effect.name: effect for effect in report.effects}
    assert set(found) == {"action_jitter", "quadratic_drag"}
    assert found["quadratic_drag"].strength == pytest.approx(0.04, rel=0.1)
    low, high = found["action_jitter"].ci95
    assert low < 0.015 < high
    assert 0.3 < found["action_jitter"].share_of_gap < 0.95
    assert sum(one.share_of_gap for one in found.values()) <= 1.0
    assert report.gap.with_effects < 1.4
    assert any("as late as jitter makes them" in alarm for alarm in report.alarms)
    assert {c.name for c in report.candidates} == {*SOME, "quadratic_drag"}
    assert {c.status for c in report.candidates if c.name == "action_jitter"} == {"named"}


def test_a_delay_that_varies_a_little_is_a_delay():
    report = diagnose(system(), None, logs(act=late(2, 1.6, least=1.0)), effects=SOME)
    assert [effect.name for effect in report.effects] == ["action_delay"]


def test_jitter_of_one_drive_of_many_is_found():
    robot, data, _ = cheetah(amplitude=0.7, runs=6, late=0.8)
    report = diagnose(robot, None, data, effects=SOME)
    assert [effect.name for effect in report.effects] == ["action_jitter"]
    assert report.effects[0].where == "bshin"
    assert report.effects[0].strength == pytest.approx(0.8 * DT, rel=0.2)


def test_it_is_not_looked_for_where_noise_alone_is_left(prepared):
    prepared, unit = prepared
    best = SimpleNamespace(units=(), fit=SimpleNamespace(mean_square=1.0), dispersion=lambda: 1.0)
    calm = SimpleNamespace(best=best)
    assert beside_jitter(prepared, calm, [unit], search=None, generator=None) is None
