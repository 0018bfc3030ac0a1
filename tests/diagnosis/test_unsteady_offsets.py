"""An offset that changes slowly is one cause, whatever stands in the simulator for its change."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from test_diagnose import ARM, as_log, run, system
from test_doubts import TWO

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.objective import units_of
from torchrl_bayessim.diagnosis.unsteady_offsets import unrepeated_alarms, unsteady_offsets
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.disturbance import PeriodicDisturbance
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.system import System


def robot_of(xml):
    return System(task=Task(model=mujoco.MjModel.from_xml_string(xml), frame_skip=5)).robot


BOTH, ONE = robot_of(TWO), robot_of(ARM)
RUNS = SimpleNamespace(log=np.repeat([0, 1], 5), time=np.tile(np.linspace(0.0, 4.0, 5), 2))
SLOW, FAST = 0.4, 0.6  # Hz: 1.6 and 2.4 periods in a run


def found(changes, robot=BOTH):
    """Return a model of effects at their places that change so much, ``{(name, where): size}``."""
    sizes = {}
    for (kind, where), size in changes.items():
        wave = isinstance(kind, float)
        law = PeriodicDisturbance(kind, 0.0) if wave else effect(kind)
        sizes[next(u for u in units_of([law], robot) if u.where == where)] = size
    change = lambda unit: np.array([0.0, sizes[unit]])
    return SimpleNamespace(units=tuple(sizes), fit=SimpleNamespace(change=change))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {("sensor_bias", "b position"): 9, ("sensor_drift", "b position"): 5},
            {"sensor_drift": "sensor_bias"},
        ),
        (
            {("sensor_bias", "b position"): 5, ("sensor_drift", "b position"): 9},
            {"sensor_bias": "sensor_drift"},
        ),
        (
            {("constant_force", "b"): 9, ("sensor_drift", "b position"): 5},
            {"sensor_drift": "constant_force"},
        ),
        # more than the push, and no zero of a sensor, that may begin anywhere
        ({("constant_force", "b"): 5, ("sensor_drift", "b position"): 9}, {}),
        ({("sensor_bias", "a position"): 9, ("sensor_drift", "b position"): 5}, {}),
        (
            {
                ("sensor_bias", "b position"): 9,
                ("sensor_drift", "b position"): 5,
                ("sensor_drift", "b velocity"): 1,
            },
            {"sensor_drift": "sensor_bias"},
        ),
        (
            {
                ("sensor_bias", "b position"): 9,
                ("sensor_drift", "b position"): 5,
                ("sensor_drift", "a position"): 1,
            },
            {},
        ),
        ({("sensor_bias", "b position"): 9, ("coulomb_friction", "b"): 1}, {}),
    ],
    ids=[
        "a bias that drifts",
        "a drift from elsewhere",
        "a push that drifts",
        "a push and a drift",
        "another joint",
        "of position and velocity",
        "one of two elsewhere",
        "friction",
    ],
)
def test_a_drift_is_told_with_the_offset_that_it_is_a_part_of(changes, told):
    assert unsteady_offsets(found(changes), RUNS, BOTH) == told


@pytest.mark.parametrize(
    ("wave", "size", "told"),
    [
        ((SLOW, "b"), 1.8, True),
        ((SLOW, "b"), 2.4, False),  # 0.3 of 10 is the amplitude of a sine of 2.1
        ((FAST, "b"), 1.8, False),
        ((SLOW, "a"), 1.8, False),
    ],
    ids=["a slow part", "more than a part", "it repeats", "another joint"],
)
@pytest.mark.parametrize("offset", [("constant_force", "b"), ("sensor_bias", "b position")])
def test_a_wave_is_told_with_an_offset_unless_it_repeats(wave, size, told, offset):
    model = found({offset: 10.0, wave: size})
    together = unsteady_offsets(model, RUNS, BOTH)
    assert together == ({"periodic_disturbance": offset[0]} if told else {})
    # what is not told so is named, with reserve if it was not seen to repeat
    assert bool(unrepeated_alarms(model, RUNS, together)) == (wave[0] == SLOW and not told)


def test_drift_and_wave_of_one_bias_are_told_with_it():
    changes = {
        ("sensor_bias", "b position"): 9.0,
        ("sensor_drift", "b position"): 3.0,
        (SLOW, "b"): 1.0,
    }
    both = {"sensor_drift": "sensor_bias", "periodic_disturbance": "sensor_bias"}
    assert unsteady_offsets(found(changes), RUNS, BOTH) == both
    # and with the drift, where that is more
    changes[("sensor_drift", "b position")] = 30.0
    both = {"sensor_bias": "sensor_drift", "periodic_disturbance": "sensor_drift"}
    assert unsteady_offsets(found(changes), RUNS, BOTH) == both


def test_a_tilt_is_an_offset_of_the_only_joint():
    tilt = next(unit.where for unit in units_of([effect("gravity_tilt")], ONE))
    changes = {("gravity_tilt", tilt): 9.0, ("sensor_drift", "hinge position"): 3.0}
    assert unsteady_offsets(found(changes, ONE), RUNS, ONE) == {"sensor_drift": "gravity_tilt"}
    changes = {("gravity_tilt", tilt): 9.0, ("sensor_drift", "b position"): 3.0}
    assert unsteady_offsets(found(changes), RUNS, BOTH) == {}


def off_by(zero, count=6):
    """Return runs whose encoder's zero is elsewhere, at a time in the run."""
    rng, seen = np.random.default_rng(0), []
    for _ in range(count):
        state, u = run(rng, 300)
        state[:, 0] += zero(0.01 * np.arange(300))
        seen.append(as_log("run", state, u))
    return seen


def test_a_bias_that_creeps_is_one_cause_and_simulated_as_it_changes():
    seen = off_by(lambda t: 0.25 * (1 + 0.4 * np.sin(1.5 * t)))
    effects = "sensor_bias", "sensor_drift", "periodic_disturbance", "coulomb_friction"
    report = diagnose(system(), None, seen, effects=effects)
    assert [cause.name for cause in report.effects] == ["sensor_bias"]
    assert len(report.strengths) > 1
    assert sum(cause.share_of_gap for cause in report.effects) > 0.95
    assert any("sensor bias" in a and "in the simulator a" in a for a in report.alarms)


def test_a_drift_alone_is_a_drift():
    report = diagnose(
        system(), None, off_by(lambda t: 0.1 * t), effects=("sensor_bias", "sensor_drift")
    )
    assert [cause.name for cause in report.effects] == ["sensor_drift"]
    assert not any("in the simulator a" in alarm for alarm in report.alarms)


FLOATING = """
<mujoco><worldbody><body><freejoint name="base"/><geom size=".1"/><site name="s"/>
  <body pos="0 0 .2"><joint name="h" axis="0 1 0"/><geom size=".05" pos="0 0 .1"/></body>
  {}</body></worldbody>
<actuator><motor name="thrust" site="s" gear="0 0 1 0 0 0"/><motor name="m" joint="h"/></actuator>
</mujoco>
"""
LEG = '<body pos="0 0 -.2"><joint name="k" axis="0 1 0"/><geom size=".05"/></body>'


@pytest.mark.parametrize("legs", ["", LEG], ids=["one hinge", "two"])
def test_on_a_floating_base_only_offsets_of_one_channel_are_one(legs):
    robot = robot_of(FLOATING.format(legs))
    tell = lambda changes: unsteady_offsets(found(changes, robot), RUNS, robot)
    drift = {("sensor_drift", "base x"): 5}
    assert tell({("sensor_bias", "base z"): 9} | drift) == {}
    assert tell({("action_bias", "thrust"): 9} | drift) == {}
    assert tell({("action_bias", "m"): 9} | drift) == {}
    assert tell({("sensor_bias", "base x"): 9} | drift) == {"sensor_drift": "sensor_bias"}
