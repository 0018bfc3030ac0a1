"""Two laws that are one cause, of friction or of lateness, are told once and simulated twice."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from test_diagnose import logs, system
from test_doubts import TWO

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.one_cause import (
    dry_friction,
    dry_friction_alarms,
    lateness,
    lateness_alarms,
)
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.system import System

ROBOT = System(task=Task(model=mujoco.MjModel.from_xml_string(TWO), frame_skip=5)).robot
LAWS = "coulomb_friction", "stribeck_friction"
FIRST, SECOND = ROBOT.joints[:2]


def found(places, names=LAWS, strengths=(0.2, 0.1), robot=ROBOT, *, last=None):
    """Return a model of laws, each at a target or at all, the last of this form."""
    laws = [*map(effect, names[:-1]), effect(names[-1], **(last or {}))]
    units = [
        next(u for u in units_of([law], robot) if u.where == place)
        for law, place in zip(laws, places, strict=True)
    ]
    point = Point(np.zeros(1), dict(zip(units, strengths, strict=True)))
    names = dict.fromkeys(unit.name for unit in units).keys()
    return SimpleNamespace(units=tuple(units), names=names, fit=SimpleNamespace(point=point))


@pytest.mark.parametrize(
    ("places", "credit", "told"),
    [
        ((FIRST, FIRST), (0.7, 0.3), {LAWS[1]: LAWS[0]}),
        ((FIRST, FIRST), (0.3, 0.7), {LAWS[0]: LAWS[1]}),
        ((FIRST, FIRST), (0.5, 0.5), {LAWS[1]: LAWS[0]}),
        (("all", SECOND), (0.7, 0.3), {LAWS[1]: LAWS[0]}),
        (("all", SECOND), (0.3, 0.7), {}),  # friction at a joint where the named law has none
        ((FIRST, SECOND), (0.7, 0.3), {}),
    ],
)
def test_laws_of_dry_friction_are_one_where_they_share_their_joints(places, credit, told):
    assert dry_friction(found(places), dict(zip(LAWS, credit, strict=True)), ROBOT) == told


def test_other_friction_is_a_cause_of_its_own():
    names = "coulomb_friction", "viscous_friction"
    credit = dict.fromkeys(names, 0.5)
    assert dry_friction(found((FIRST, FIRST), names), credit, ROBOT) == {}


def test_an_alarm_tells_both_ends_of_the_curve():
    (alarm,) = dry_friction_alarms(found((FIRST, FIRST)), {LAWS[1]: LAWS[0]}, ROBOT)
    assert f"friction at {FIRST} fades with speed, from 0.3 to 0.2 N m" in alarm
    assert dry_friction_alarms(found((FIRST, FIRST)), {}, ROBOT) == []
    partly = found((FIRST, FIRST), last={"kinetic": 0.4})
    (alarm,) = dry_friction_alarms(partly, {LAWS[1]: LAWS[0]}, ROBOT)
    assert "from 0.3 to 0.24 N m" in alarm


FILTERED = "sensor_lag", "sensor_delay"
CHANNEL, OTHER = ROBOT.channels[:2]


@pytest.mark.parametrize(
    ("places", "strengths", "told"),
    [
        ((CHANNEL, CHANNEL), (0.06, 0.01), {FILTERED[1]: FILTERED[0]}),
        ((CHANNEL, CHANNEL), (0.01, 0.06), {FILTERED[0]: FILTERED[1]}),
        (("all", CHANNEL), (0.06, 0.01), {FILTERED[1]: FILTERED[0]}),
        ((CHANNEL, CHANNEL), (0.03, 0.03), {FILTERED[1]: FILTERED[0]}),
        (("all", CHANNEL), (0.01, 0.09), {FILTERED[1]: FILTERED[0]}),  # at more of them
        ((CHANNEL, "all"), (0.06, 0.01), {FILTERED[0]: FILTERED[1]}),
        ((CHANNEL, OTHER), (0.06, 0.01), {}),
    ],
)
def test_a_filter_and_a_delay_of_one_sensor_are_one_lateness(places, strengths, told):
    assert lateness(found(places, FILTERED, strengths), ROBOT) == told


def test_lateness_of_commands_is_none_of_sensors():
    robot = system().robot
    motor, channel = robot.actuators[0], robot.channels[0]
    one = found((motor, channel), ("action_lag", "sensor_delay"), robot=robot)
    assert lateness(one, robot) == {}
    one = found((motor, motor), ("action_lag", "action_delay"), robot=robot)
    assert lateness(one, robot) == {"action_delay": "action_lag"}


def test_commands_and_sensors_may_both_be_late():
    robot = system().robot
    motor, channel = robot.actuators[0], robot.channels[0]
    names = "action_delay", "action_lag", "sensor_lag", "sensor_delay"
    places, strengths = (motor, motor, channel, channel), (0.02, 0.01, 0.01, 0.02)
    told = {"action_lag": "action_delay", "sensor_lag": "sensor_delay"}
    one = found(places, names, strengths, robot=robot)
    assert lateness(one, robot) == told
    commands, sensors = lateness_alarms(one, told, robot)
    assert commands.startswith(f"{motor} is late by 0.01 s of a filter and 0.02 s of delay")
    assert sensors.startswith(f"{channel} is late by 0.01 s of a filter and 0.02 s of delay")
    assert "sensor lag and sensor delay stand for it together" in sensors


def test_an_alarm_tells_where_both_are():
    one = found(("all", CHANNEL), FILTERED, (0.06, 0.01))
    (alarm,) = lateness_alarms(one, {FILTERED[1]: FILTERED[0]}, ROBOT)
    assert alarm.startswith(f"{CHANNEL} is late by 0.06 s of a filter and 0.01 s of delay")
    assert lateness_alarms(one, {}, ROBOT) == []


@pytest.mark.slow
def test_friction_that_fades_to_some_is_named_once_and_simulated_with_both_laws():
    push = lambda q, v: -(0.15 + 0.4 * np.exp(-((v / 0.8) ** 2))) * np.tanh(v / 0.01)
    effects = (*LAWS, "viscous_friction", "quadratic_drag", "dead_band")
    report = diagnose(system(), None, logs(push=push), effects=effects)
    assert [cause.name for cause in report.effects] in ([LAWS[0]], [LAWS[1]])
    assert {law.name for law in report.strengths} == set(LAWS)
    assert any("stand for it together" in alarm for alarm in report.alarms)
    assert sum(sum(at.values()) for at in report.strengths.values()) == pytest.approx(0.55, rel=0.1)
    assert {c.name for c in report.candidates if c.status == "named"} == set(LAWS)
