"""What a law has beside its strength is fitted once the effect is in the model."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from rail_cart import cart, ride
from test_diagnose import ARM, FINER, logs
from test_diagnose import system as robot

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.form_fit import (
    _nearest_offered,
    with_forms_anew,
)
from torchrl_bayessim.diagnosis.free_numbers import Shift
from torchrl_bayessim.diagnosis.model import judged
from torchrl_bayessim.diagnosis.objective import Point, Unit, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.diagnosis.refit import refit
from torchrl_bayessim.effects.action import Saturation
from torchrl_bayessim.effects.sensors import SensorDrift
from torchrl_bayessim.effects.transmission import ServoGain
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.system import System

SOME = (
    "cogging", "coulomb_friction", "parallel_spring", "periodic_disturbance", "sensor_drift",
    "viscous_friction",
)  # fmt: skip
FREQUENCY, PHASE, RATE = 1.37, 0.6, 31.0


def known_robot():
    """The arm of which mass and damping are known."""
    known = ARM.replace('mass=".6"', 'mass=".66"').replace('damping=".05"', 'damping=".08"')
    return System(task=Task(model=mujoco.MjModel.from_xml_string(known), frame_skip=5))


def diagnosed(force, seed):
    rng = np.random.default_rng(seed)
    logs = [ride(rng, 300, force, noise=[0.0002, 0.004]) for _ in range(6)]
    return diagnose(cart(), None, logs, effects=SOME)


def test_a_shaking_force_is_found_with_its_frequency_and_phase_and_nothing_beside_it():
    report = diagnosed(lambda t, q: 0.9 * np.sin(2 * np.pi * FREQUENCY * t + PHASE), 1)
    assert [effect.name for effect in report.effects] == ["periodic_disturbance"]
    (found,) = report.strengths
    assert found.frequency == pytest.approx(FREQUENCY, rel=2e-3)
    assert found.phase == pytest.approx(PHASE, abs=0.03)
    assert report.gap.with_effects < 1.1


def test_magnets_along_a_rail_are_found_with_their_distance_and_phase_and_nothing_beside_them():
    report = diagnosed(lambda t, q: 0.5 * np.sin(RATE * q + PHASE), 2)
    assert [effect.name for effect in report.effects] == ["cogging"]
    (found,) = report.strengths
    assert found.number == pytest.approx(RATE, rel=2e-3)
    assert found.phase == pytest.approx(PHASE, abs=0.03)
    assert report.gap.with_effects < 1.3


@pytest.mark.parametrize(("hardening", "within"), [(12.0, 0.1), (0.0, None)])
def test_a_spring_is_found_with_how_it_hardens_and_nothing_beside_it(hardening, within):
    report = diagnosed(lambda t, q: -2.0 * q * (1 + hardening * q**2), 3)
    assert [effect.name for effect in report.effects] == ["parallel_spring"]
    assert report.effects[0].strength == pytest.approx(2.0, rel=0.05)
    (found,) = report.strengths
    expected = 0.0 if within is None else pytest.approx(hardening, rel=within)
    assert found.hardening == expected
    assert report.gap.with_effects < 1.1


@pytest.mark.parametrize("power", [0.7, 1.0])
def test_a_damping_by_a_power_of_speed_is_found_and_nothing_beside_it(power):
    """In proportion to speed it would leave something like dry friction."""
    runs = logs(8, push=lambda q, v: -0.25 * np.sign(v) * np.abs(v) ** power)
    some = [*SOME, "stribeck_friction", "quadratic_drag"]
    report = diagnose(known_robot(), None, runs, effects=some)
    assert [effect.name for effect in report.effects] == ["viscous_friction"]
    (found,) = report.effects
    assert found.form.get("power", 1.0) == pytest.approx(power, abs=0.02)
    assert found.strength == pytest.approx(0.25, rel=0.05)
    assert report.gap.with_effects < 1.5


def test_magnets_behind_a_gear_are_found_with_their_number_per_turn_of_the_hinge():
    runs = logs(push=lambda q, v: 0.15 * np.sin(6.5 * q + 1.0))
    report = diagnose(robot(), None, runs, effects=(*SOME, "gravity_tilt", "action_gain"))
    assert [effect.name for effect in report.effects] == ["cogging"]
    (found,) = report.strengths
    assert found.number == pytest.approx(6.5, abs=0.1)
    assert found.phase == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_a_spring_and_a_shaking_force_are_found_though_no_law_as_offered_predicts_other_runs():
    """Seed 2: a spring as it was offered fits some runs only; one that hardens fits others too."""
    stiffness, hardening, strength = 1.588, 7.62, 0.263
    report = diagnosed(
        lambda t, q: (
            -stiffness * q * (1 + hardening * q**2)
            - strength * np.cos(2 * np.pi * FREQUENCY * t + 0.5)
        ),
        2,
    )
    names = [effect.name for effect in report.effects]
    assert names == ["parallel_spring", "periodic_disturbance"]
    spring = next(law for law in report.strengths if law.name == "parallel_spring")
    assert spring.hardening == pytest.approx(hardening, rel=0.1)
    for effect, true in zip(report.effects, (stiffness, strength), strict=True):
        assert effect.ci95[0] < true < effect.ci95[1]


@pytest.mark.slow
def test_a_form_is_fitted_again_once_a_second_cause_is_in_the_model():
    """Seed 0: alone the spring seems to harden by 7."""
    report = diagnosed(
        lambda t, q: -1.551 * q * (1 + 11.37 * q**2) - 0.108 * np.cos(2 * np.pi * FREQUENCY * t),
        0,
    )
    spring = next(law for law in report.strengths if law.name == "parallel_spring")
    assert spring.hardening == pytest.approx(11.37, rel=0.1)


def test_one_gain_that_bends_is_named_and_not_two_effects_that_imitate_it():
    weaker = logs(act=lambda u, k: u[k] * (1 + 0.3 * (1 - 0.5 * abs(u[k]) / 4)))
    some = ["action_gain", "saturation", "dead_band", "quadratic_drag"]
    report = diagnose(known_robot(), None, weaker, effects=some)
    assert [effect.name for effect in report.effects] == ["action_gain"]
    assert report.effects[0].strength == pytest.approx(0.3, rel=0.1)
    (found,) = report.strengths
    assert found.bend == pytest.approx(-0.5, abs=0.1)


class Bristles:
    """Friction of 0.3 N m that gives way over 30 mrad, in time steps of the recorded robot."""

    def __init__(self):
        self.bent = 0.0

    def __call__(self, q, v):
        slid = 0.03 * np.sign(v)
        self.bent = slid + (self.bent - slid) * np.exp(-abs(v) * 0.002 / FINER / 0.03)
        return -0.3 * self.bent / 0.03


def test_bristles_are_dry_friction_with_the_way_that_they_bend():
    some = ["coulomb_friction", "directional_friction", "viscous_friction", "parallel_spring"]
    report = diagnose(robot(), None, logs(push=Bristles()), effects=some)
    assert [effect.name for effect in report.effects] == ["coulomb_friction"]
    assert report.effects[0].strength == pytest.approx(0.3, rel=0.03)
    (found,) = report.strengths
    assert found.presliding == pytest.approx(0.03, rel=0.15)
    assert report.gap.with_effects < 1.3


def test_friction_that_fades_to_some_of_it_is_one_law():
    """Not Coulomb friction and what fades beside it."""
    some = ["coulomb_friction", "stribeck_friction", "viscous_friction", "parallel_spring"]
    fades = logs(push=lambda _, v: -0.6 * (0.25 + 0.75 * np.exp(-((v / 0.4) ** 2))) * np.sign(v))
    report = diagnose(robot(), None, fades, effects=some)
    assert [effect.name for effect in report.effects] == ["stribeck_friction"]
    (found,) = report.strengths
    assert found.kinetic == pytest.approx(0.25, abs=0.05)
    assert found.speed == pytest.approx(0.4, rel=0.1)
    assert f"{found.kinetic:.0%} of it at any speed" in str(report)


def test_friction_of_one_direction_that_begins_softly_has_the_speed_over_which_it_does():
    some = ["coulomb_friction", "directional_friction", "viscous_friction", "action_bias"]
    soft = logs(10, push=lambda q, v: -0.3 * (1 - np.exp(-v / 0.8)) if v > 0 else 0.0)
    report = diagnose(robot(), None, soft, effects=some)
    assert [effect.name for effect in report.effects] == ["directional_friction"]
    assert report.effects[0].strength == pytest.approx(0.3, rel=0.1)
    (found,) = report.strengths
    assert found.onset == pytest.approx(0.8, rel=0.25)
    assert report.gap.with_effects < 1.5


def test_a_drift_that_was_taken_to_settle_is_steady_again():
    """A number that comes back to where it was offered is no reason to give up what was gained."""
    rng = np.random.default_rng(0)
    rides = [ride(rng, 200, lambda t, q: 0.0, noise=[0.0005, 0.01]) for _ in range(6)]
    rides = [replace(r, qpos=r.qpos + 0.05 * r.time[:, None]) for r in rides]
    steady = next(u for u in units_of([SensorDrift()], cart().robot) if u.where == "rail position")
    settling = replace(steady, effect=SensorDrift(settling=0.5))
    known = prepare(cart(), rides, [steady], generator=np.random.default_rng(0))
    sets = known.sets["train"], known.sets["validation"]
    point = Point(known.nominal.point.z, {settling: 0.05})
    (start,) = judged(*sets, refit(sets[0], [point]))
    again = with_forms_anew(*sets, start, [steady])
    assert again.fit.cost < start.fit.cost - 20
    assert [unit.effect.settling for unit in again.units] == [0.0]


@pytest.mark.parametrize(
    ("softness", "expected"), [(0.22, 0.5), (0.9, 0.5)], ids=["nearly hard", "soft"]
)
def test_what_is_straightened_is_a_law_that_was_offered_and_can_be_fitted(softness, expected):
    shift = Shift(unit_of(Saturation(softness)), "softness", 0.02, 0.1, 1.0)
    offered = [unit_of(Saturation()), unit_of(Saturation(0.5)), unit_of(ServoGain())]
    assert _nearest_offered(shift, offered) == expected
    assert shift.paid(offered)
    assert not Shift(unit_of(Saturation(0.5)), "softness", 0.02, 0.1, 1.0).paid(offered)


def unit_of(effect):
    return Unit(effect, "motor", (1.0,), 0.0, 1.0)


@pytest.mark.slow
def test_a_law_that_was_bent_to_make_up_for_a_second_cause_is_straight_beside_it():
    """Alone, drag grows with the power 2.4 of speed, and no limit helps beside that drag."""
    sent = {}

    def act(u, k):
        sent["u"] = float(u[k])
        return u[k]

    def push(_, v):
        u, limit = sent["u"], 4.0 * max(1.0 - abs(v) / 9.0, 0.05)
        lost = float(np.clip(u, -limit, limit)) - u if u * v > 0 else 0.0
        return lost - 0.03 * v * abs(v)

    names = ("quadratic_drag", "torque_speed_limit", "viscous_friction", "saturation")
    report = diagnose(robot(), None, logs(8, act=act, push=push), effects=names)
    assert {effect.name for effect in report.effects} == {"quadratic_drag", "torque_speed_limit"}
    drag = next(effect for effect in report.effects if effect.name == "quadratic_drag")
    assert drag.strength == pytest.approx(0.03, rel=0.1)
    assert report.gap.with_effects < 1.3
