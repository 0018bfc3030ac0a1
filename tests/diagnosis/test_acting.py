"""The rule that says when a cause acts, against laws whose regime is known."""

import re

import numpy as np
import pytest
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis.acting import _best_cuts, acting_regime
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.effects.action import Saturation
from torchrl_bayessim.effects.sensors import SensorGain


def rule(report):
    first = report.where["regimes"][0]
    name, sign, limit = re.fullmatch(r"(.*) (<|>=) (\S+)", first["rule"]).groups()
    return name, sign, float(limit), first["support"], first["share"]


def test_a_drive_that_saturates_acts_where_commands_are_larger_than_it_gives():
    act = lambda u, k: float(np.clip(u[k], -2.0, 2.0))
    report = diagnose(system(), None, logs(act=act), effects=["saturation", "coulomb_friction"])
    assert [effect.name for effect in report.effects] == ["saturation"]
    name, sign, limit, support, share = rule(report)
    assert (name, sign) == ("|motor command|", ">=")
    # it acts from where it takes a tenth of the most that it takes: 2 + 0.1 (4 - 2) at most
    assert limit == pytest.approx(2.1, abs=0.2)
    assert support < 0.7
    assert share > 0.85


@pytest.fixture(scope="module")
def prepared():
    robot = system()
    units = units_of([Saturation(), SensorGain()], robot.robot)
    rng = np.random.default_rng(0)
    return prepare(robot, logs(), units, generator=rng), {str(u): u for u in units}


@pytest.mark.parametrize(
    ("unit", "strength", "rules"),
    [
        ("saturation[motor]", 0.5, 1),  # of commands beyond 2
        ("saturation[motor]", 0.0, 0),
        ("sensor_gain[hinge velocity]", 0.1, 0),  # at speed, but of sensors nothing is said
    ],
)
def test_commands_have_a_rule_and_sensors_have_none(unit, strength, rules, prepared):
    known, units = prepared
    point = Point(known.nominal.point.z, {units[unit]: strength})
    assert len(acting_regime(known, point, units[unit].name)) == rules


def test_a_cause_that_acts_in_nearly_every_step_has_no_rule(prepared, monkeypatch):
    known, units = prepared
    unit = units["saturation[motor]"]
    point = Point(known.nominal.point.z, {unit: 0.5})

    def nearly_always(prepared, steps, point, name):
        speed = steps.qvel[:, steps.history, 0]
        return (speed > np.quantile(speed, 0.2)).astype(float)

    monkeypatch.setattr("torchrl_bayessim.diagnosis.acting.change", nearly_always)
    assert len(acting_regime(known, point, unit.name)) == 1
    monkeypatch.setattr("torchrl_bayessim.diagnosis.acting._EVERYWHERE", 0.75)
    assert acting_regime(known, point, unit.name) == []


def test_a_rule_is_no_longer_than_it_need_be():
    rng = np.random.default_rng(0)
    columns = {name: rng.normal(size=2000) for name in ("a", "b", "c")}
    cuts = _best_cuts(columns, (columns["a"] > 0.5) & (columns["b"] < 0.0))
    assert sorted((name, sign) for name, sign, _ in cuts) == [("a", ">="), ("b", "<")]
    limits = {name: limit for name, _, limit in cuts}
    assert limits["a"] == pytest.approx(0.5, abs=0.1)
    assert limits["b"] == pytest.approx(0.0, abs=0.1)


def test_what_the_reader_must_know_is_told_once(prepared):
    """The search for effects runs twice where less noise is left beside the first ones."""
    first = prepared[0].alarmed("late", "short")
    assert first.alarmed("late", "new").alarms == (*first.alarms, "new")
