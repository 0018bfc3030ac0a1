"""The rule that says when a cause acts, against laws whose regime is known."""

import re

import numpy as np
import pytest
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis.acting import _best_cuts
from torchrl_bayessim.diagnosis.diagnose import diagnose


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


def test_what_is_found_at_a_sensor_has_no_rule_of_its_own():
    late = logs()
    turned = [type(log)(**{**log.__dict__, "qpos": log.qpos + 0.1}) for log in late]
    report = diagnose(system(), None, turned, effects=["sensor_bias"])
    assert [effect.name for effect in report.effects] == ["sensor_bias"]
    for regime in report.where["regimes"]:
        assert regime["share"] < 1.0


def test_a_cause_that_acts_in_every_step_has_no_rule():
    columns = {"v": np.linspace(-1.0, 1.0, 400)}
    assert _best_cuts(columns, np.ones(400, dtype=bool)) == ()


def test_a_rule_is_no_longer_than_it_need_be():
    rng = np.random.default_rng(0)
    columns = {name: rng.normal(size=2000) for name in ("a", "b", "c")}
    cuts = _best_cuts(columns, (columns["a"] > 0.5) & (columns["b"] < 0.0))
    assert sorted((name, sign) for name, sign, _ in cuts) == [("a", ">="), ("b", "<")]
    limits = {name: limit for name, _, limit in cuts}
    assert limits["a"] == pytest.approx(0.5, abs=0.1)
    assert limits["b"] == pytest.approx(0.0, abs=0.1)
