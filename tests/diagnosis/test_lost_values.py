"""Commands and samples that are lost now and then are found one by one."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from test_chance import lost
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis.chance import Chance
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.found import _matters as found_matters
from torchrl_bayessim.diagnosis.loss_law import LossLaw, Told, Tried, likeliest
from torchrl_bayessim.diagnosis.loss_suspects import Alone, _explained
from torchrl_bayessim.diagnosis.losses import _explain, _of_one_drive, all_found, found_beside
from torchrl_bayessim.diagnosis.model import Model
from torchrl_bayessim.diagnosis.objective import Unit, units_of
from torchrl_bayessim.diagnosis.shrinkage import Shrinkage
from torchrl_bayessim.effects.action import PacketDrop
from torchrl_bayessim.effects.joints import CoulombFriction
from torchrl_bayessim.effects.sensors import SensorDelay, SensorDropout, SensorGain
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

SOME = ("action_delay", "action_jitter", "packet_drop", "sensor_dropout", "coulomb_friction")


def shown_again(log, share, rng):
    """Return the log with angles that are sometimes the last one, with noise of their own."""
    angles = log.qpos.clone()
    for k in range(1, len(angles)):
        if rng.random() < share:
            angles[k] = angles[k - 1]
    noise = torch.from_numpy(rng.normal(scale=0.0005, size=angles.shape))
    return replace(log, qpos=angles + noise)


def rough(share, rng):
    """Commands that jump, as a policy's do, and are lost now and then."""
    arrives = lost(share, rng)

    def act(u, k):
        if k == 0:
            u += rng.normal(size=len(u))
        return arrives(u, k)

    return act


def explained(report):
    return report.gap.explained_fraction


@pytest.mark.parametrize(
    ("changes", "explained"),
    [
        ({}, True),
        ({"left": 4.0}, False),  # over longer segments
        ({"calm": False}, False),
        ({"units": ()}, False),
        ({"missing": 1e-8}, False),  # hardly more than noise, but surely more
    ],
)
def test_a_lag_explains_lost_commands_only_if_it_does_over_long_segments(changes, explained):
    given = {"units": ("delay",), "calm": True, "left": 1.0, "missing": 0.3} | changes
    left = np.full((9, 4), given["left"] ** 0.5)
    best = Model(fit=SimpleNamespace(units=given["units"]), validation=left, logs=None)
    found = SimpleNamespace(best=best, p_values=(1e-30, given["missing"]))
    assert _explained(SimpleNamespace(calm=given["calm"]), found) is explained


@pytest.mark.slow
def test_lost_commands_are_found_beside_a_drive_that_saturates():
    arrives = rough(0.1, np.random.default_rng(1))
    act = lambda u, k: float(np.clip(arrives(u, k), -2.0, 2.0))
    report = diagnose(system(), None, logs(8, act=act), effects=[*SOME, "saturation"])
    assert {effect.name for effect in report.effects} == {"saturation", "packet_drop"}
    strengths = {effect.name: effect.strength for effect in report.effects}
    assert strengths["saturation"] == pytest.approx(0.5, rel=0.1)
    assert strengths["packet_drop"] == pytest.approx(0.1, rel=0.5)
    assert report.gap.with_effects < 1.3


@pytest.mark.parametrize("share", [0.02, pytest.param(0.1, marks=pytest.mark.slow)])
def test_rare_losses_of_commands_are_counted(share):
    act = rough(share, np.random.default_rng(1))
    report = diagnose(system(), None, logs(8, act=act), effects=SOME)
    assert report.verdict in {"named", "named_partial"}
    (found,) = report.effects
    assert (found.name, found.where) == ("packet_drop", "motor")
    assert report.confusion_set == ("packet_drop",)
    assert found.strength == pytest.approx(share, rel=0.5)
    assert explained(report) > 0.5


@pytest.mark.parametrize("share", [pytest.param(0.1, marks=pytest.mark.slow), 0.3])
def test_frequent_losses_of_commands_are_counted_though_not_all_patterns_are_tried(share):
    report = diagnose(
        system(), None, logs(8, act=rough(share, np.random.default_rng(1))), effects=SOME
    )
    (found,) = report.effects
    assert found.name == "packet_drop"
    assert found.ci95[0] < share < found.ci95[1]
    assert found.ci95[1] - found.ci95[0] < 0.6 * share


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_samples_that_are_not_renewed_are_counted_though_they_never_repeat(share):
    rng = np.random.default_rng(2)
    data = [shown_again(log, share, rng) for log in logs(8)]
    report = diagnose(system(), None, data, effects=SOME)
    assert report.verdict in {"named", "named_partial"}
    (found,) = report.effects
    assert (found.name, found.where) == ("sensor_dropout", "hinge position")
    assert found.strength == pytest.approx(share, rel=0.5)
    low, high = found.ci95
    assert abs(found.strength - share) < 0.75 * (high - low)  # three standard errors
    assert explained(report) > 0.8


def test_nothing_is_lost_where_something_else_strikes_now_and_then():
    """Blows spoil as many segments as losses would, and no pattern of losses explains them."""
    rng = np.random.default_rng(3)
    report = diagnose(
        system(), None, logs(8, act=lambda u, k: u[k] + 3.0 * (rng.random() < 0.05)), effects=SOME
    )
    names = {effect.name for effect in report.effects}
    assert not names & {"packet_drop", "sensor_dropout"}


def test_nothing_is_lost_on_a_clean_robot():
    report = diagnose(system(), None, logs(8, seed=5), effects=SOME)
    assert report.verdict == "none"


def test_samples_and_commands_are_told_apart():
    """Half of each would explain the other's scatter, none of it one by one."""
    rng = np.random.default_rng(4)
    data = [shown_again(log, 0.2, rng) for log in logs(8)]
    assert diagnose(system(), None, data, effects=SOME).confusion_set == ("sensor_dropout",)


@pytest.mark.slow
def test_friction_and_samples_that_are_not_renewed_are_both_named():
    rng = np.random.default_rng(6)
    data = logs(8, push=lambda _, v: -0.15 * np.tanh(v / 0.02))
    report = diagnose(system(), None, [shown_again(log, 0.1, rng) for log in data], effects=SOME)
    assert report.verdict in {"named", "named_partial"}
    found = {effect.name: effect for effect in report.effects}
    assert set(found) == {"coulomb_friction", "sensor_dropout"}
    assert found["coulomb_friction"].strength == pytest.approx(0.15, rel=0.1)
    assert found["sensor_dropout"].strength == pytest.approx(0.1, rel=0.5)
    assert {effect.name for effect in report.strengths} == set(found)
    shares = [effect.share_of_gap for effect in report.effects]
    assert min(shares) > 0.0
    assert sum(shares) == pytest.approx(explained(report))
    low, high = report.gap.ci95
    assert low <= explained(report) <= high


def short_segments(rng, *, lost, spoiled, left=0.0, size=8.0, count=60, steps=8, colliding=False):
    """Segments that noise alone is in, and some with a lost value or spoiled by something else.

    Of the variances of noise that a lost value adds some may be left with the right pattern.
    """
    tried = np.tile(rng.chisquare(16, count) / 16, (1 + steps, 1))
    tried[1:] += 2.0
    tried[:, :spoiled] += 20.0
    for s in range(spoiled, spoiled + lost):
        tried[0, s] += size
        tried[1 + rng.integers(steps), s] -= 2.0 - left
    patterns = Tried(tried, np.r_[0, np.ones(steps, dtype=int)], values=steps)
    return SimpleNamespace(
        tried=lambda unit: patterns,
        without=patterns.without,
        left=np.zeros((count, 16)),
        colliding=colliding,
    )


@pytest.mark.parametrize(
    ("lost", "spoiled", "other", "found"),
    [
        ((12, 12), 3, CoulombFriction, True),
        ((6, 6), 14, CoulombFriction, True),  # clear, whatever spoils a quarter of the segments
        ((6, 6), 14, None, False),  # something is wrong that may look like losses
        ((12, 12), 22, CoulombFriction, False),
        ((24, 0), 3, CoulombFriction, True),  # a burst in the runs of the fit
        ((24, 0), 3, None, False),
        ((0, 0), 14, CoulombFriction, False),
        ((6, 6), 14, SensorGain, True),
        ((0, 0), 14, SensorGain, False),
    ],
)  # fmt: skip
def test_losses_beside_an_effect_that_explain_what_they_spoil_are_found(
    lost, spoiled, other, found
):
    rng = np.random.default_rng(0)
    counts = dict(zip(("train", "validation", "test"), (*lost, 12), strict=True))
    data = {n: short_segments(rng, lost=k, spoiled=spoiled) for n, k in counts.items()}
    chance = losses_beside(data, other)
    assert (chance is not None) == found
    if found:
        assert chance.strength == pytest.approx(sum(lost) / 2 / (60 - spoiled) / 8, rel=0.5)


@pytest.mark.parametrize(
    ("size", "effect", "found"),
    [(1.0, PacketDrop, True), (0.7, PacketDrop, False), (0.7, SensorDropout, True)],
)
def test_commands_that_are_lost_beside_an_effect_are_seen_where_they_are(size, effect, found):
    """A law that is a little wrong everywhere looks like many losses, hardly one of them sure."""
    rng = np.random.default_rng(0)
    splits = "train", "validation", "test"
    data = {name: short_segments(rng, lost=40, spoiled=3, size=size) for name in splits}
    assert (losses_beside(data, CoulombFriction, effect) is not None) == found


def losses_beside(data, other, effect=SensorDropout):
    unit = SimpleNamespace(effect=effect(), high=0.5)
    others = () if other is None else (SimpleNamespace(effect=other()),)
    return found_beside(data, unit, Alone.of(data), others)


def test_what_losses_leave_speaks_against_them_where_another_law_of_a_sensor_would_leave_it():
    rng = np.random.default_rng(0)
    counts = {"train": 6, "validation": 6, "test": 6}
    data = {n: short_segments(rng, lost=k, spoiled=3, left=1.5) for n, k in counts.items()}
    assert losses_beside(data, CoulombFriction) is not None
    assert losses_beside(data, SensorGain) is None


@pytest.mark.parametrize(("lost", "found"), [((12, 12), True), ((40, 2), False)])
def test_losses_beside_an_effect_that_leave_some_show_in_runs_that_judge_as_in_those_of_the_fit(
    lost, found
):
    """A foot that touches the ground at another time spoils samples as if a few were lost."""
    rng = np.random.default_rng(0)
    counts = dict(zip(("train", "validation", "test"), (*lost, 6), strict=True))
    data = {n: short_segments(rng, lost=k, spoiled=3, left=1.5) for n, k in counts.items()}
    assert (losses_beside(data, CoulombFriction) is not None) == found


@pytest.mark.parametrize(
    ("left", "colliding", "found"), [(1.5, False, True), (1.5, True, False), (0.0, True, True)]
)
def test_where_anything_touches_losses_beside_an_effect_leave_noise(left, colliding, found):
    """An impact that is a little off holds a velocity, too, and not quite."""
    rng = np.random.default_rng(0)
    given = {"lost": 12, "spoiled": 3, "left": left, "colliding": colliding}
    data = {name: short_segments(rng, **given) for name in ("train", "validation", "test")}
    assert (losses_beside(data, CoulombFriction) is not None) == found


@pytest.mark.parametrize(("excess", "explains"), [(0.3, True), (0.02, False)])
def test_losses_beside_an_effect_take_an_excess_and_not_noise(excess, explains):
    """Of ever so many segments that have no more than noise many losses take some of that."""
    law, count = LossLaw(share=0.15, scatter=1.0, spoiled=0.01, size=32), 50
    before, after = np.full(count, 1.0 + excess), np.full(count, 0.95)
    told = Told(np.ones(count), np.ones(count), np.zeros(count), before, after)
    some = SimpleNamespace(law=law, gains=(45.0, 30.0), gain=75.0, unit=unit_of_samples())
    alone = Alone(law, [0.0, 0.0], 0.01, count, colliding=False)
    others = (SimpleNamespace(effect=CoulombFriction()),)
    assert _explain(some, told, alone=alone, others=others, lone=False) == explains


def unit_of_samples():
    return SimpleNamespace(effect=SensorDropout(), high=0.5)


class Sensors:
    """Segments with a lost value each, of which every unit explains so many and no others."""

    def __init__(self, rng, lost, **given):
        most, spoiled = max(k for _, k in lost), 3
        segments = short_segments(rng, lost=most, spoiled=spoiled, **given)
        every = segments.tried(None)
        self.left, self.without, self.parts = segments.left, segments.without, {}
        self.colliding = segments.colliding
        for unit, k in lost:
            squares = every.squares.copy()
            squares[1:, spoiled + k : spoiled + most] += 8.0
            self.parts[unit] = replace(every, squares=squares)

    def tried(self, unit):
        return self.parts[unit]


SENSOR, OTHER, DRIVE = (
    Unit(effect, name, (1.0,), 0.0, 0.5)
    for effect, name in ((SensorDropout(), "q"), (SensorDropout(), "v"), (PacketDrop(), "motor"))
)


@pytest.mark.parametrize("known", [SensorGain, SensorDelay])
@pytest.mark.parametrize(
    ("lost", "found"),
    [
        ([(SENSOR, 14), (OTHER, 0)], [SENSOR]),
        ([(SENSOR, 14), (OTHER, 0), (DRIVE, 14)], [SENSOR]),
        ([(SENSOR, 14), (OTHER, 10)], []),  # what is late in another way errs in both
        ([(SENSOR, 14)], []),  # of one sensor nothing says so
        ([(SENSOR, 14), (DRIVE, 0)], []),
        ([(SENSOR, 4), (OTHER, 0)], []),  # not evident
    ],
)
def test_samples_are_lost_beside_what_a_sensor_does_if_only_one_of_several_loses_any(
    lost, found, known
):
    """Of the eight variances that a loss adds, 1.4 are left: a law that is not quite true."""
    rng = np.random.default_rng(0)
    data = {name: Sensors(rng, lost, left=1.4) for name in ("train", "validation", "test")}
    others = (SimpleNamespace(effect=known()),)
    seen = all_found(data, [unit for unit, _ in lost], Alone.of(data), others)
    assert [one.unit for one in seen] == found


def test_samples_of_one_sensor_are_lost_beside_another_sensors_gain():
    rng = np.random.default_rng(6)
    data = [replace(log, qvel=0.85 * log.qvel) for log in logs(8)]
    data = [shown_again(log, 0.1, rng) for log in data]
    report = diagnose(system(), None, data, effects=[*SOME, "sensor_gain", "action_gain"])
    found = {effect.name: effect for effect in report.effects}
    assert set(found) == {"sensor_gain", "sensor_dropout"}
    assert found["sensor_gain"].where == "hinge velocity"
    assert found["sensor_gain"].strength == pytest.approx(-0.15, rel=0.2)
    assert found["sensor_dropout"].strength == pytest.approx(0.1, rel=0.5)


def test_losses_are_not_tried_where_an_effect_that_lasts_leaves_noise_alone(monkeypatch):
    monkeypatch.setattr("torchrl_bayessim.diagnosis.losses.all_found", pytest.fail)
    data = logs(6, push=lambda _, v: -0.15 * np.tanh(v / 0.02))
    report = diagnose(system(), None, data, effects=SOME)
    assert [effect.name for effect in report.effects] == ["coulomb_friction"]


@pytest.mark.slow
def test_nothing_is_lost_where_commands_are_late_in_a_way_that_no_effect_has():
    def smeared(u, k):
        return float(np.mean(u[max(k - 5, 0) : k + 1]))

    report = diagnose(system(), None, logs(8, act=smeared), effects=(*SOME, "action_lag"))
    assert not {effect.name for effect in report.effects} & {"packet_drop", "sensor_dropout"}


def test_the_likeliest_law_of_a_grid_is_the_one_of_least_deviance_by_the_definition():
    rng = np.random.default_rng(3)
    lost = np.array([0, 1, 1, 1, 2, 2, 2])
    parts = [Tried(rng.chisquare(12, (7, n)) / 6, lost, values=3) for n in (20, 11)]
    shares, scatters, spoiled = (0.02, 0.2, 0.5), (1.0, 1.7, 3.0), (0.01, 0.2)

    def deviance(law):
        total = 0.0
        for part in parts:
            s, phi = law.share, law.scatter
            prior = s**lost * (1 - s) ** (3 - lost) / (1 - s**3)  # three losses are not tried
            normal = (phi * np.exp(part.squares / phi)) ** (-0.5 * law.size)
            wide = [
                (k * phi * np.exp(part.squares[0] / (k * phi))) ** (-0.5 * law.size)
                for k in (4.0, 16.0, 64.0, 256.0)
            ]
            density = (1 - law.spoiled) * prior @ normal + law.spoiled * np.mean(wide, 0)
            total -= 2 * np.log(density).sum()
        return total

    laws = [LossLaw(*some, size=12) for some in itertools.product(shares, scatters, spoiled)]
    for law in laws:
        assert law.deviance(parts) == pytest.approx(deviance(law), rel=1e-12)
    assert likeliest(parts, shares, scatters, spoiled, size=12) == min(laws, key=deviance)


TWO = """
<mujoco><option timestep="0.01" integrator="implicitfast"/><worldbody><body>
  <joint name="first" axis="0 1 0" damping=".1" armature=".02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".6"/><body pos="0 0 -.4">
  <joint name="second" axis="0 1 0" damping=".1" armature=".02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".3"/></body></body></worldbody>
<actuator><motor name="one" joint="first"/><motor name="two" joint="second"/></actuator></mujoco>
"""


def run_of_two(rng, name, *, share, steps=150, through=lambda u: u):
    """Return a run whose packets, each with both commands, are lost now and then."""
    model = mujoco.MjModel.from_xml_string(TWO)
    data, sent, last, rows = mujoco.MjData(model), rng.normal(size=(steps, 2)), np.zeros(2), []
    for command in sent:
        rows.append(np.r_[data.qpos, data.qvel])
        last = command if rng.random() >= share else last
        data.ctrl[:] = through(last)
        mujoco.mj_step(model, data)
    noise = rng.normal(size=(steps, 4)) * [1e-3, 1e-3, 1e-2, 1e-2]
    state = torch.from_numpy(np.array(rows) + noise)
    return Log(
        name=name,
        time=0.01 * torch.arange(steps).double(),
        qpos=state[:, :2],
        qvel=state[:, 2:],
        ctrl=torch.from_numpy(sent),
        velocity_gain=torch.zeros(2).double(),
        measured=torch.ones(4, dtype=torch.bool),
    )


def test_packets_that_hold_the_commands_of_all_actuators_are_lost_as_one():
    rng = np.random.default_rng(8)
    data = [run_of_two(rng, f"run{i}", share=0.1) for i in range(6)]
    robot = System(task=Task(model=mujoco.MjModel.from_xml_string(TWO), frame_skip=1))
    (found,) = diagnose(robot, None, data, effects=("packet_drop", "action_lag")).effects
    assert (found.name, found.where) == ("packet_drop", "all")
    assert found.ci95[0] < 0.1 < found.ci95[1]


@pytest.mark.parametrize(
    ("gain", "before", "after", "matters"),
    [
        (50.0, 2.0, 1.9, True),  # a hundredth of the gap
        (50.0, 1.0, 0.99, False),
        (150.0, 1.02, 1.02, True),  # test runs do not show what is certain of others
        (50.0, 1.02, 1.02, False),
        (150.0, 1.2, 1.14, True),  # a part of what effects leave
        (150.0, 1.2, 1.17, False),
    ],
)
def test_chance_beside_effects_has_to_matter(gain, before, after, matters):
    def left(effects):
        explained = min((10.0 - effects) / 9.0, 1.0)
        return Shrinkage(50.0, 10.0, effects, explained, (0.9, 1.0), (8.0, 10.0), (0.0, 1.0))

    scatter = SimpleNamespace(found=[SimpleNamespace(gain=gain)])
    assert found_matters(scatter, left(before), left(after)) == matters


@pytest.mark.parametrize(
    ("before", "after", "matters"), [(4.6, 1.03, True), (4.6, 3.6, False), (1.4, 1.0, False)]
)
def test_chance_that_takes_most_of_what_a_large_gaps_effects_leave_matters(before, after, matters):
    """Though it is less than a hundredth of the gap, and not certain."""

    def left(effects):
        explained = (637.0 - effects) / 636.0
        return Shrinkage(3e3, 637.0, effects, explained, (0.9, 1.0), (8.0, 10.0), (0.0, 1.0))

    scatter = SimpleNamespace(found=[SimpleNamespace(gain=81.0)])
    assert found_matters(scatter, left(before), left(after)) == matters


@pytest.mark.parametrize(
    ("gains", "kept"),
    [
        ({"one": 200.0, "two": 60.0, "all": 90.0}, 3),
        ({"one": 200.0, "two": 150.0, "all": 90.0}, 0),  # either, as it seems
        ({"one": 200.0, "two": 150.0, "all": 400.0}, 3),  # both at once
        ({"one": 200.0}, 1),
        ({}, 0),
    ],
)
def test_beside_effects_commands_of_one_drive_are_lost_or_those_of_all(gains, kept):
    """And samples are another matter."""
    robot = System(task=Task(model=mujoco.MjModel.from_xml_string(TWO), frame_skip=1)).robot
    units = {unit.where: unit for unit in units_of([PacketDrop()], robot)}
    samples = Chance(units_of([SensorDropout()], robot)[0], 0.1, 0.01, 150.0, np.ones(3))
    found = [Chance(units[name], 0.1, 0.01, gain, np.ones(3)) for name, gain in gains.items()]
    left = _of_one_drive([*found, samples])
    assert samples in left
    assert len(left) == kept + 1
