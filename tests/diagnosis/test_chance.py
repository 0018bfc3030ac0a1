"""Causes that are drawn anew in every run; the generator draws them itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.holds import bridged

SOME = (
    "action_delay", "action_lag", "action_jitter", "packet_drop", "action_quantization",
    "sensor_delay", "sensor_dropout", "coulomb_friction",
)  # fmt: skip


def lost(share, rng):
    last = {}

    def act(u, k):
        if k == 0 or rng.random() > share:
            last["command"] = u[k]
        return last["command"]

    return act


def held(log, share, rng, *names):
    arrays = {}
    for name in names:
        values = getattr(log, name).clone()
        for k in range(1, len(values)):
            if rng.random() < share:
                values[k] = values[k - 1]
        arrays[name] = values
    return replace(log, **arrays)


def status(report, name):
    return {c.status for c in report.candidates if c.name == name}


@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_lost_packets_are_told_from_a_lag_by_their_scatter(seed):
    act = lost(0.2, np.random.default_rng(seed))
    report = diagnose(system(), None, logs(8, act=act), effects=SOME)
    assert report.verdict in {"named", "named_partial", "ambiguous"}
    assert report.effects[0].name == "packet_drop"
    low, high = report.effects[0].ci95
    assert low - 0.05 < 0.2 < high + 0.05
    assert report.gap.with_effects == pytest.approx(1.0, abs=0.4)
    assert dict(report.strengths.popitem()[1])["motor"] == report.effects[0].strength


def test_a_lag_leaves_no_scatter():
    def act(u, k, last={}):  # noqa: B006 - the filter's memory
        last["out"] = u[k] if k == 0 else last["out"] + 0.4 * (u[k] - last["out"])
        return last["out"]

    report = diagnose(system(), None, logs(8, act=act), effects=SOME)
    assert report.effects[0].name in {"action_lag", "action_delay"}
    assert "action_lag" in report.confusion_set
    assert status(report, "packet_drop") == {"ruled_out"}


def test_held_samples_are_counted_and_nobody_else_is_blamed():
    rng = np.random.default_rng(2)
    data = [held(log, 0.1, rng, "qpos") for log in logs()]
    report = diagnose(system(), None, data, effects=SOME)
    assert report.verdict == "named"
    (found,) = report.effects
    assert (found.name, found.where) == ("sensor_dropout", "hinge position")
    assert found.strength == pytest.approx(0.1, abs=0.03)
    assert report.gap.refit > 5 > report.gap.with_effects
    assert "sensor_dropout" in report.to_dict()["confusion_set"]
    (named,) = [c for c in report.candidates if c.status == "named"]
    assert (named.where, named.strength) == ("hinge position", found.strength)


def test_commands_that_are_rounded_are_named_with_their_step():
    report = diagnose(
        system(), None, logs(8, act=lambda u, k: 0.3 * np.round(u[k] / 0.3)), effects=SOME
    )
    assert report.effects[0].name == "action_quantization"
    assert report.effects[0].strength == pytest.approx(0.3, rel=0.02)


def test_a_lattice_and_a_robot_at_rest_hold_nothing():
    (log,) = logs(1)
    robot = system().robot
    encoder = replace(log, qpos=0.05 * torch.round(log.qpos / 0.05))
    assert bridged([encoder], robot)[1] == []
    still = replace(log, qpos=torch.cat([log.qpos[:100], log.qpos[99:100].expand(100, 1)]))
    assert bridged([still], robot)[1] == []
    assert bridged([log], robot)[0][0] is log


def test_an_estimated_velocity_is_estimated_from_bridged_positions():
    (log,) = logs(1)
    log = held(replace(log, velocity_gain=torch.ones(1).double()), 0.2, np.random.default_rng(0),
               "qpos")  # fmt: skip
    (bridge,), (hold,), alarms = bridged([log], system().robot)
    assert hold.share == pytest.approx(0.2, abs=0.06)
    assert not alarms
    assert not torch.equal(bridge.qvel, log.qvel)
    assert float((bridge.qvel - log.qvel).abs().median()) < 0.3


@pytest.mark.slow
def test_noise_hides_whether_what_is_late_varies():
    rng = np.random.default_rng(5)

    def jittered(u, k):  # by up to a step
        return u[k] + rng.random() * (u[max(k - 1, 0)] - u[k])

    report = diagnose(system(), None, logs(act=jittered), effects=SOME)
    assert report.effects[0].name == "action_delay"
    assert "action_jitter" in report.confusion_set
    assert "confounded" in status(report, "action_jitter")


@pytest.mark.slow
def test_a_delay_of_several_steps_does_not_vary():
    report = diagnose(system(), None, logs(act=lambda u, k: u[max(k - 3, 0)]), effects=SOME)
    assert report.effects[0].name == "action_delay"
    assert "action_jitter" not in report.confusion_set


def test_next_to_nothing_is_named_beside_held_samples():
    """A limit that is hardly touched mends a little of what bridges over held samples leave."""
    rng = np.random.default_rng(7)
    data = logs(8, act=lambda u, k: float(np.clip(u[k], -3.9, 3.9)))
    some = [held(log, 0.1, rng, "qpos", "qvel") for log in data]
    report = diagnose(system(), None, some, effects=("saturation", "sensor_dropout"))
    assert report.effects[0].name == "sensor_dropout"
    assert report.confusion_set[0] == "sensor_dropout"
    for effect in report.effects[1:]:
        assert effect.share_of_gap >= 0.01
