"""Limits that a robot hardly reaches: from where on they act, and that they are found there."""

import numpy as np
import pytest
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.objective import Objective, Point, Unit, units_of
from torchrl_bayessim.diagnosis.onsets import with_onsets
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.diagnosis.whitening import whitening
from torchrl_bayessim.effects.catalogue import effect

LARGEST = 4.0  # of the model's commands


def clipped(limit):
    return lambda u, k: np.clip(u[k], -limit, limit)


def objective(data):
    one = system()
    predictor, pieces = Predictor(one, threads=1), cut(data, 20)
    middle = np.array([1.1 * 0.6, 0.08])
    white = whitening(predictor, pieces, middle, np.array([0.002, 0.02]))
    return Objective(predictor, one.prior, pieces, white)


def test_a_saturation_begins_at_the_largest_command():
    some = objective(logs())
    names = ["saturation", "torque_speed_limit", "coulomb_friction"]
    units = units_of([effect(name) for name in names], some.predictor.system.robot)
    found = {unit.name: unit for unit in with_onsets(some, Point(np.zeros(3)), units)}
    at = some.segments.history
    used = np.abs(some.segments.ctrl[:, at : at + some.segments.horizon]).max()
    assert found["saturation"].onset == pytest.approx(1 - used / LARGEST, abs=0.9 / 256)
    assert found["torque_speed_limit"].onset > 0
    assert found["coulomb_friction"] == units[2]
    assert found["coulomb_friction"].onset == 0.0


def test_a_limit_that_nothing_reaches_is_left_as_it_is():
    some = objective(logs())
    some.segments.ctrl[...] *= 0.001
    units = units_of([effect("saturation")], some.predictor.system.robot)
    assert with_onsets(some, Point(np.zeros(3)), units) == units


def test_strengths_are_counted_from_the_onset():
    unit = Unit(effect("saturation"), "motor", (1.0,), 0.0, 0.8, onset=0.4)
    assert [unit.actual(s) for s in (0.0, 0.4, 0.8)] == pytest.approx([0.0, 0.6, 0.8])


def test_commands_that_are_cut_now_and_then_are_named():
    report = diagnose(
        system(), None, logs(act=clipped(1.5)), effects=["saturation", "dead_band", "action_gain"]
    )
    assert report.confusion_set == ("saturation",)
    assert report.effects[0].strength == pytest.approx(1 - 1.5 / LARGEST, abs=0.02)
    assert report.gap.explained_fraction > 0.9
