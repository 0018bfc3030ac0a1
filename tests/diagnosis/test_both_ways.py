"""Friction in both directions and a push, in the place of friction in one."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from plain_models import plain
from test_diagnose import system

from torchrl_bayessim.diagnosis import both_ways
from torchrl_bayessim.diagnosis.objective import units_of
from torchrl_bayessim.effects.action import ActionBias
from torchrl_bayessim.effects.disturbance import ConstantForce
from torchrl_bayessim.effects.friction import DirectionalFriction, PreslidingFriction
from torchrl_bayessim.effects.joints import CoulombFriction, ViscousFriction

ROBOT = system().robot
SETS = (SimpleNamespace(predictor=SimpleNamespace(system=SimpleNamespace(robot=ROBOT))), None)
ONE_WAY, DRY, SOFT, PUSH, FORCE, VISCOUS = (
    next(unit for unit in units_of([effect], ROBOT) if unit.where != "all")
    for effect in (
        DirectionalFriction(), CoulombFriction(), PreslidingFriction(), ActionBias(),
        ConstantForce(), ViscousFriction(),
    )
)  # fmt: skip
EVERY = [ONE_WAY, DRY, SOFT, PUSH, FORCE, VISCOUS]
BENT = replace(SOFT, effect=PreslidingFriction(0.007))


@pytest.fixture
def started(monkeypatch):
    """Starts of fits, which all leave as little as is set."""
    starts, leaves = [], SimpleNamespace(deviance=2000.0)

    def fits(*given):
        starts.extend(given[-1])
        return [plain(dict(start.strengths), leaves.deviance) for start in given[-1]]

    monkeypatch.setattr(both_ways, "judged_fits", fits)
    return starts, leaves


def test_half_of_friction_in_one_direction_is_tried_in_both_in_all_forms_beside_a_push(started):
    starts, _ = started
    best = plain({ONE_WAY: -0.4, VISCOUS: 0.1}, 8000.0)
    found = both_ways.both_ways(SETS, best, ONE_WAY.name, EVERY)
    assert [dict(start.strengths) for start in starts] == [
        {VISCOUS: 0.1, dry: 0.2, push: 0.0} for dry in (DRY, SOFT) for push in (PUSH, FORCE)
    ]
    assert len(found) == 4


@pytest.mark.parametrize(
    ("strengths", "deviance", "name"),
    [
        ({ONE_WAY: 0.4}, 1900.0, ONE_WAY.name),  # little more than noise, which leaves 400
        ({VISCOUS: 0.4}, 8000.0, VISCOUS.name),
        ({ONE_WAY: 0.4, PUSH: 0.1}, 8000.0, ONE_WAY.name),  # a push there already
        ({ONE_WAY: 0.4, DRY: 0.1}, 8000.0, ONE_WAY.name),
        ({ONE_WAY: 0.4, BENT: 0.1}, 8000.0, ONE_WAY.name),  # in a form that was fitted
    ],
)
def test_it_is_not_tried_where_nothing_asks_for_it(started, strengths, deviance, name):
    starts, _ = started
    assert not both_ways.both_ways(SETS, plain(strengths, deviance), name, EVERY)
    assert not starts


def test_what_takes_less_than_most_of_what_is_left_is_a_stopgap(started):
    starts, leaves = started
    leaves.deviance = 5000.0
    assert not both_ways.both_ways(SETS, plain({ONE_WAY: 0.4}, 8000.0), ONE_WAY.name, EVERY)
    assert starts
