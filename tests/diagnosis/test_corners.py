"""Laws with a corner are led to by soft ones."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from plain_models import plain
from test_diagnose import logs
from test_diagnose import system as robot

from torchrl_bayessim.diagnosis.corners import is_corner, soft_start
from torchrl_bayessim.diagnosis.form_fit import softened, with_fitted_forms
from torchrl_bayessim.diagnosis.free_numbers import Shift
from torchrl_bayessim.diagnosis.model import judged
from torchrl_bayessim.diagnosis.objective import Point, Unit, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.diagnosis.refit import refit
from torchrl_bayessim.effects.action import ActionBias, ActionLag, DeadBand, Saturation
from torchrl_bayessim.effects.friction import PreslidingFriction
from torchrl_bayessim.effects.joints import CoulombFriction


def limited(u, k):
    """A motor that is told a little more than it should be, and cuts what is too much."""
    return float(np.clip(u[k] + 0.5, -1.5, 1.5))


def test_a_hard_limit_is_found_from_afar_by_way_of_a_soft_one():
    """From a limit of nearly all commands, where half as hard a one does not cut any less."""
    units = [
        u
        for e in (Saturation(), Saturation(0.5), ActionBias())
        for u in units_of([e], robot().robot)
    ]
    hard, soft, bias = units
    known = prepare(robot(), logs(act=limited), units, generator=np.random.default_rng(0))
    sets = known.sets["train"], known.sets["validation"]
    z = known.nominal.point.z
    (bent,) = judged(*sets, refit(sets[0], [Point(z, {soft: 0.05, bias: 0.1})]))
    assert bent.mean_square > 2.0
    sharp = with_fitted_forms(*sets, bent, units)
    strengths = dict(sharp.fit.point.strengths)
    assert strengths.keys() == {hard, bias}
    assert strengths[hard] == pytest.approx(1 - 1.5 / 4, abs=0.01)
    assert strengths[bias] == pytest.approx(0.5, abs=0.02)
    assert sharp.mean_square < 1.2
    (stuck,) = judged(*sets, refit(sets[0], [Point(z, {hard: 0.2, bias: 0.1})], iterations=2))
    (led,) = softened(*sets, [bent, stuck, stuck], units, most=1)
    assert dict(led.fit.point.strengths).keys() == {hard, bias}
    assert led.fit.cost == pytest.approx(sharp.fit.cost, rel=0.01)
    assert not softened(*sets, [bent], units, most=1)  # it is soft already


SHIFTS = {"softness": (0.02, 0.1, 1.0), "presliding": (1e-4, 5e-4, 0.1), "second": (0.05, 0.0, 0.5)}


@pytest.mark.parametrize(
    ("soft", "number", "other", "is_one"),
    [
        (Saturation(0.1), "softness", Saturation(), True),
        (Saturation(0.1), "softness", Saturation(0.5), False),
        (DeadBand(softness=0.1), "softness", DeadBand(), True),
        (DeadBand(softness=0.1), "softness", DeadBand(damped=False), False),
        (PreslidingFriction(5e-4), "presliding", CoulombFriction(), True),
        (ActionLag(held=False), "second", ActionLag(held=True), False),
    ],
)
def test_the_corner_of_a_law_is_the_same_law_without_its_bend(soft, number, other, is_one):
    shift = Shift(unit_of(soft), number, *SHIFTS[number])
    assert is_corner(unit_of(other), shift) is is_one
    assert not is_corner(replace(unit_of(other), where="elsewhere"), shift)


@pytest.mark.parametrize("strength", [0.3, 0.0])
def test_a_limit_that_cuts_nothing_begins_as_a_soft_one_that_cuts_a_little(strength):
    hard, soft, lag = units = [unit_of(e) for e in (Saturation(), Saturation(0.5), ActionLag())]
    train = SimpleNamespace(
        predictor=SimpleNamespace(system=robot()),
        segments=SimpleNamespace(qpos=np.ones((1, 1, 1)), qvel=np.ones((1, 1, 1)), time=np.ones(1)),
    )
    model = plain({hard: strength, lag: 0.01}, 500.0)
    assert soft_start(train, model, units).strengths == {soft: 0.05, lag: 0.01}
    assert soft_start(train, plain({soft: 0.3, lag: 0.01}, 500.0), units) is None


def unit_of(effect):
    return Unit(effect, "motor", (1.0,), 0.0, 1.0)
