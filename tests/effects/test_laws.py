"""Known answers of the laws, one by one."""

import copy
import math
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from apparatus import ARM, arm, arm_task
from hypothesis import given
from hypothesis import strategies as st

from torchrl_bayessim.effects.catalogue import CATALOGUE, effect
from torchrl_bayessim.effects.effect import ActionEffect, Reach, SensorEffect
from torchrl_bayessim.effects.fields import ModelFields
from torchrl_bayessim.effects.forcing import Forcing
from torchrl_bayessim.effects.friction import PowerLawFriction
from torchrl_bayessim.effects.history import advanced, delayed, empty_line, read_line
from torchrl_bayessim.effects.joints import ViscousFriction
from torchrl_bayessim.effects.laws import two_lags
from torchrl_bayessim.effects.overlay import Overlay
from torchrl_bayessim.effects.robot import Robot, robot_of
from torchrl_bayessim.effects.sequence import (
    command_sequence,
    measured_sequence,
    restored_sequence,
)
from torchrl_bayessim.effects.strength import strength_of
from torchrl_bayessim.effects.units import unit_at
from torchrl_bayessim.envs.model_batch import ModelBatch
from torchrl_bayessim.envs.task import Readings, Task

ROBOT = Robot(
    dt=0.1,
    actuators=("motor",),
    command_scale=torch.tensor([2.0]).double(),
    joint_of_actuator=(-1,),
    channels=("q",),
    channel_scale=torch.tensor([1.0]).double(),
    channel_joint=(-1,),
    channel_kind=("other",),
)


def column(*values):
    return torch.tensor(values, dtype=torch.float64)[:, None]


def changed(name, strength, *values, **options):
    law = effect(name, **options)
    apply = command_sequence if isinstance(law, ActionEffect) else measured_sequence
    return apply(law, column(*values), torch.tensor([strength]).double(), ROBOT)[:, 0].tolist()


@pytest.mark.parametrize(
    ("name", "strength", "given", "expected"),
    [
        ("action_delay", 0.15, (0, 1, 2, 4), (0, 0, 0.5, 1.5)),
        ("action_lag", 0.1 / math.log(2), (0, 1, 1, 1), (0, 0.5, 0.75, 0.875)),
        ("dead_band", 0.3, (-1, -0.2, 0, 0.3, 1), (-0.7, 0, 0, 0, 0.7)),
        ("saturation", 0.25, (-2, -1, 1.6), (-1.5, -1, 1.5)),
        ("action_gain", -0.5, (1, -2), (0.5, -1)),
        ("action_bias", 0.1, (1, -2), (1.1, -1.9)),
        ("battery_sag", 0.5, (2, 2, 2), (2, 1.99, 1.98)),
        ("action_quantization", 0.5, (0.2, 0.3, -1.1), (0, 0.5, -1)),
        ("sensor_delay", 0.2, (5, 1, 2, 4), (5, 5, 5, 1)),
        ("sensor_bias", -0.5, (1, 2), (0.5, 1.5)),
        ("sensor_gain", 0.1, (1, 2), (1.1, 2.2)),
        ("sensor_quantization", 0.1, (0.26, 0.11), (0.3, 0.1)),
        ("sensor_lag", 0.1 / math.log(2), (0, 1, 1), (0, 0.5, 0.75)),
        ("sensor_drift", 2.0, (1, 1, 1), (1, 1.2, 1.4)),
    ],
)
def test_formulas(name, strength, given, expected):
    assert changed(name, strength, *given) == pytest.approx(expected)


def test_a_drive_that_follows_within_the_step_acts_by_its_mean():
    half = 0.1 / math.log(2)  # what is left halves in a step of 0.1 s
    grid = np.linspace(0, 0.1, 10_001)
    mean = 1 - np.trapezoid(np.exp(-grid / half), grid) / 0.1
    values = changed("action_lag", half, 0, 1, 1, 1, held=False)
    assert values == pytest.approx([0, mean, 1 - (1 - mean) / 2, 1 - (1 - mean) / 4])
    assert changed("action_lag", 0.0, 0, 1, 2, held=False) == [0, 1, 2]
    assert effect("action_lag").forms(9.0) == (
        effect("action_lag"),
        effect("action_lag", held=False),
    )


@pytest.mark.parametrize("second", [0.2, 0.5])
def test_two_filters_in_a_row_follow_their_differential_equations(second):
    s, u = 0.17, (0.0, 1.0, 1.0, -0.5)
    first, last, dt, means = 0.0, 0.0, 1e-5, []
    for command in u[1:]:
        reached = []
        for _ in range(10_000):
            first += dt / ((1 - second) * s) * (command - first)
            last += dt / (second * s) * (first - last)
            reached.append(last)
        means.append(np.mean(reached))
    values = changed("action_lag", s, *u, held=False, second=second)
    assert values == pytest.approx([0.0, *means], abs=1e-4)
    assert changed("action_lag", 0.0, *u, held=False, second=second) == list(u)


@pytest.mark.parametrize("second", [0.4999, 0.499999, 0.5])
def test_filters_that_are_nearly_alike_are_as_sure_in_single_precision(second):
    single, double = (
        two_lags(0.1, *((share * torch.tensor([0.15])).to(kind) for share in (1 - second, second)))
        for kind in (torch.float32, torch.float64)
    )
    torch.testing.assert_close([one.double() for one in single], list(double), rtol=1e-5, atol=0)


@pytest.mark.parametrize("name", ["action_lag", "sensor_lag"])
def test_two_filters_in_a_row_are_one_after_the_other(name):
    once = changed(name, 0.15, *changed(name, 0.05, 0, 1, 3, 2))
    assert changed(name, 0.2, 0, 1, 3, 2, second=0.25) == pytest.approx(once)
    nearly = changed(name, 0.2, 0, 1, 3, 2, second=1e-3)
    assert nearly == pytest.approx(changed(name, 0.2, 0, 1, 3, 2), abs=1e-3)


def test_the_second_filter_of_a_sensor_is_moved_by_what_shows_between_readings():
    """A twentieth of 0.2 s is over before the next reading, 0.1 s later; equal ones are a law."""
    one, equal = effect("sensor_lag").forms(5.0)
    assert (one.second, equal.second) == (0.0, 0.5)
    width, least, most = one.free(Reach(1.0, 1.0, 5.0, slides=False))["second"]
    assert (least, most) == (0.0, 0.5)
    for second, shows in ((0.05, False), (width, True)):
        both = changed("sensor_lag", 0.2, 0, 1, 3, 2, second=second)
        first = changed("sensor_lag", (1 - second) * 0.2, 0, 1, 3, 2)
        assert bool(np.abs(np.subtract(both, first)).max() > 0.05) == shows


def test_the_second_filter_of_a_controller_is_moved_by_what_shows_between_commands():
    """A drive's goes on between them, and shows a smaller change, too."""
    widths = {}
    for held in (True, False):
        law = effect("action_lag", held=held)
        widths[held], _, _ = law.free(Reach(1.0, 1.0, 5.0, slides=False))["second"]
        both = changed("action_lag", 0.15, 0, 1, 3, 2, held=held, second=widths[held])
        first = changed("action_lag", (1 - widths[held]) * 0.15, 0, 1, 3, 2, held=held)
        assert np.abs(np.subtract(both, first)).max() > 0.02
    assert widths[False] < widths[True]
    both = changed("action_lag", 0.15, 0, 1, 3, 2, held=True, second=widths[False])
    first = changed("action_lag", (1 - widths[False]) * 0.15, 0, 1, 3, 2, held=True)
    assert np.abs(np.subtract(both, first)).max() < 1e-6


def test_what_two_filters_show_is_undone_twice():
    true = torch.sin(0.1 * torch.arange(60, dtype=torch.float64))[:, None]
    law, strength = effect("sensor_lag", second=0.3), torch.tensor([0.1]).double()
    back = restored_sequence(law, measured_sequence(law, true, strength, ROBOT), strength, ROBOT)
    torch.testing.assert_close(back, true, rtol=0, atol=1e-9)


def test_a_soft_saturation_takes_as_much_of_the_largest_command_and_little_of_small_ones():
    most = float(ROBOT.command_scale[0])
    small, large = changed("saturation", 0.4, 0.01 * most, -most, softness=0.5)
    assert small == pytest.approx(0.01 * most, rel=1e-3)
    assert large == pytest.approx(-0.6 * most)
    assert changed("saturation", 0.0, most, softness=0.5) == [most]
    assert effect("saturation").forms(9.0) == (
        effect("saturation"),
        effect("saturation", softness=0.5),
    )


def test_laws_bend_as_their_options_say():
    most = float(ROBOT.command_scale[0])
    assert changed("dead_band", 0.1, 0.1, -5.0, softness=1.0) == pytest.approx(
        [0.05, -4.9020], 1e-4
    )
    assert changed("action_gain", 0.2, 0.5 * most, bend=-0.5) == pytest.approx([0.575 * most])
    sag = changed("battery_sag", 0.5, *[2.0] * 11, seconds=1.0, bend=1.6)
    assert sag[5] == pytest.approx(2 * (1 - 0.5 * (1 - math.exp(-0.8)) / (1 - math.exp(-1.6))))
    assert sag[10] == pytest.approx(2 * (1 - 0.5))
    drift = changed("sensor_drift", 2.0, *[1.0] * 11, settling=3.0)
    assert drift[10] == pytest.approx(1 + 2.0 * (1 - math.exp(-3.0)) / 3.0)


def test_a_battery_loses_no_more_than_half_again_of_its_sag():
    values = changed("battery_sag", 0.4, *[1.0] * 40, seconds=1.0)
    assert values[10] == pytest.approx(0.6)
    assert values[20] == values[-1] == pytest.approx(0.4)
    runs = [effect("battery_sag").forms(seconds)[0].seconds for seconds in (4.0, 60.0)]
    assert runs == [4.0, 10.0]


def test_lost_packets_and_samples_repeat_the_last_that_arrived():
    noise = column(0.9, 0.1, 0.9, 0.1, 0.1)
    for name, apply in (("packet_drop", command_sequence), ("sensor_dropout", measured_sequence)):
        strength = torch.tensor([0.3]).double()
        result = apply(effect(name), column(1, 2, 3, 4, 5), strength, ROBOT, noise=noise)
        assert result[:, 0].tolist() == [1, 1, 3, 3, 3]


def test_noise_has_the_standard_deviation_that_it_says():
    record = torch.zeros(20_000, 1, dtype=torch.float64)
    noisy = measured_sequence(
        effect("sensor_noise"), record, torch.tensor([0.2]).double(), ROBOT, seed=1
    )
    assert noisy.std().item() == pytest.approx(0.2, rel=0.03)
    assert noisy.mean().item() == pytest.approx(0.0, abs=0.01)


def test_jitter_stays_within_its_strength():
    record = torch.arange(200, dtype=torch.float64)[:, None]
    late = record - command_sequence(
        effect("action_jitter"), record, torch.tensor([0.2]).double(), ROBOT
    )
    assert late.min() >= 0
    assert 1.8 < late.max() <= 2.0
    assert late.mean().item() == pytest.approx(1.0, abs=0.1)


@given(
    steps=st.floats(0, 8),
    seed=st.integers(0, 99),
)
def test_a_delay_step_by_step_is_the_delay_of_the_whole(steps, seed):
    record = torch.randn(12, 2, generator=torch.Generator().manual_seed(seed)).double()
    line, late = empty_line(record[0], 8), []
    for value in record:
        shown, line = read_line(line, value, torch.tensor(steps).double())
        late.append(shown)
    torch.testing.assert_close(torch.stack(late), delayed(record, torch.tensor([[steps]]).double()))


@given(whole=st.integers(0, 5))
def test_advancing_undoes_a_delay_of_whole_steps_but_for_the_end(whole):
    record = torch.arange(12, dtype=torch.float64)[:, None]
    steps = torch.tensor([[float(whole)]])
    back = advanced(delayed(record, steps), steps)
    assert torch.equal(back[: 12 - whole], record[: 12 - whole])


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [("sensor_bias", 1e-12), ("sensor_gain", 1e-12), ("sensor_lag", 1e-9),
     ("sensor_drift", 1e-12), ("sensor_delay", 0.02)],
)  # fmt: skip
def test_restoring_undoes_a_measurement(name, tolerance):
    t = torch.arange(60, dtype=torch.float64)[:, None] * 0.1
    true = torch.sin(t).expand(3, -1, -1)
    strength = torch.tensor([0.0, 0.02, 0.1]).double()[:, None]
    law = effect(name)
    back = restored_sequence(law, measured_sequence(law, true, strength, ROBOT), strength, ROBOT)
    torch.testing.assert_close(back[:, :-2], true[:, :-2], rtol=0, atol=tolerance)
    assert torch.equal(back[0], true[0])


def test_only_laws_with_an_inverse_restore_anything():
    record = torch.randn(5, 1, generator=torch.Generator().manual_seed(0)).double()
    for name, kind in CATALOGUE.items():
        if issubclass(kind, SensorEffect) and kind.random:
            back = restored_sequence(kind(), record, torch.tensor([0.1]), ROBOT)
            assert torch.equal(back, record), name


# Forces.


def forces(name, strength, *, qvel=0.0, qpos=0.0, ctrl=(0.0, 0.0, 0.0), time=0.0, **options):
    robot = arm()
    state = Readings(
        qpos=torch.full((4,), qpos).double(),
        qvel=torch.full((4,), qvel).double(),
        ctrl=torch.tensor(ctrl).double(),
        time=torch.tensor([time]).double(),
    )
    law = effect(name, **options)
    active = [(law, torch.full((len(law.targets(robot)),), strength).double())]
    forcing = Forcing(robot)
    (added, _) = forcing(active, forcing.start(active, state), state)
    return {key: value.tolist() for key, value in added.items()}


def test_friction_laws():
    at = pytest.approx
    assert forces("stribeck_friction", 2.0, qvel=0.2)["dof_frictionloss"] == at([2 / math.e] * 4)
    partly = forces("stribeck_friction", 2.0, qvel=0.2, kinetic=0.3)["dof_frictionloss"]
    assert partly == at([0.6 + 1.4 / math.e] * 4)
    assert forces("stribeck_friction", 2.0, qvel=0.2, kinetic=1.0)["dof_frictionloss"] == [2.0] * 4
    assert forces("quadratic_drag", 2.0, qvel=-3.0)["dof_damping"] == at([6.0] * 4)
    assert forces("quadratic_drag", 2.0, qvel=-3.0, power=2.5)["dof_damping"] == at(
        [2 * 3**1.5] * 4
    )
    thins = forces("viscous_friction", 2.0, qvel=-3.0, power=0.8)["dof_damping"]
    assert thins == at([2 * 3**-0.2] * 4)  # a force of 2 · 3^0.8
    for speed in (0.0, 1e-4, -0.01):
        creeps = forces("viscous_friction", 2.0, qvel=speed, power=0.8)["dof_damping"]
        assert creeps == at([2 * 0.01**-0.2] * 4)
    assert isinstance(effect("viscous_friction", rise=0.1), ViscousFriction)
    assert isinstance(effect("viscous_friction", power=1.2), PowerLawFriction)
    for name in ("viscous_friction", "quadratic_drag"):
        with pytest.raises(ValueError, match="power, of speed"):
            effect(name, power=0.0)
    for strength in (2.0, -2.0):  # the sum is -s, or nothing, by the direction of motion
        one = forces("directional_friction", strength)
        along, helps = np.array(one["dof_frictionloss"]), np.array(one["qfrc_applied"])
        against = np.sign(strength) * along
        np.testing.assert_array_equal(helps - against, [-strength] * 4)
        np.testing.assert_array_equal(helps + against, [0.0] * 4)
    half, most = 2 * (1 - math.exp(-0.5)), 2 * (1 - math.exp(-3))
    cases = (2.0, 0.3, most), (-2.0, 0.3, 0.0), (-2.0, -0.05, half), (2.0, 0.0, 0.0)
    for strength, speed, expected in cases:  # one that begins over 0.1 rad/s
        soft = forces("directional_friction", strength, qvel=speed, onset=0.1)["dof_damping"]
        assert soft == at([expected / abs(speed) if speed else 0.0] * 4)
    with pytest.raises(ValueError, match="onset, a speed over which friction begins"):
        effect("directional_friction", onset=-0.1)
    # gear 2 at the shoulder, a servo of gain 5 that is 1 rad off, gear −1 at the rail
    loads = forces("load_dependent_friction", 0.5, ctrl=(1.5, 1.0, 4.0))["dof_frictionloss"]
    assert loads == at([1.5, 2.5, 2.0, 0.0])
    soft = {"ctrl": (1.5, 1.0, 4.0), "onset": 0.2}  # of it, begun over 0.2 rad/s
    for speed in (0.0, 0.1, -0.1, 0.6):
        begun = forces("load_dependent_friction", 0.5, qvel=speed, **soft)["dof_frictionloss"]
        assert begun == at([s * (1 - math.exp(-abs(speed) / 0.2)) for s in (1.5, 2.5, 2.0, 0.0)])
    with pytest.raises(ValueError, match="onset, a speed over which friction begins"):
        effect("load_dependent_friction", onset=-0.1)


@pytest.mark.parametrize(("rise", "velocity"), [(-0.1, 2.0), (0.05, 3.0), (-0.02, 1.0)])
def test_a_power_of_speed_bends_as_a_damping_does_that_changes_with_it(rise, velocity):
    """Both forces have the same slope there, relative to themselves."""
    power = PowerLawFriction.like(rise, velocity).power
    slope = (1 + 2 * rise * velocity) / (velocity * (1 + rise * velocity))
    assert power / velocity == pytest.approx(slope)
    assert PowerLawFriction.like(10.0, 10.0).power == 1.5  # no more than a diagnosis fits
    for falling in (-0.3, -0.5, -1.0):
        assert PowerLawFriction.like(falling, 2.0).power == 0.5


def test_disturbances():
    assert forces("constant_force", 2.0)["qfrc_applied"] == [2.0] * 4
    wave = forces("periodic_disturbance", 2.0, frequency=0.5, phase=0.1, time=0.3)
    assert wave["qfrc_applied"] == pytest.approx([2 * math.sin(math.pi * 0.3 + 0.1)] * 4)
    ripple = forces("cogging", 2.0, number=4, qpos=0.2)
    assert ripple["qfrc_applied"] == pytest.approx([2 * math.sin(0.8)] * 4)
    robot = arm()
    assert (effect("cogging").bounds(robot)[1] > 0).all()  # slides too


def test_a_motor_loses_torque_with_speed_where_it_drives_only():
    robot = arm()
    fast = 0.7 * robot.velocity_scale[0].item()
    full = (2.0, 0.0, 0.0)
    added = forces("torque_speed_limit", 1.0, qvel=fast, ctrl=full)["ctrl"]
    assert added[0] == pytest.approx((1.2 - 0.7 - 1.0) * 2.0)
    assert forces("torque_speed_limit", 1.0, qvel=-fast, ctrl=full)["ctrl"][0] == 0.0
    assert forces("torque_speed_limit", 1.0, qvel=0.0, ctrl=full)["ctrl"] == [0.0] * 3


@pytest.mark.parametrize("beyond", [2.0, 3.0, 50.0])
def test_a_motor_that_is_asked_for_more_than_it_has_loses_no_less(beyond):
    fast = 0.7 * arm().velocity_scale[0].item()
    added = forces("torque_speed_limit", 1.0, qvel=fast, ctrl=(beyond, 0.0, 0.0))["ctrl"]
    assert beyond + added[0] == pytest.approx((1.2 - 0.7) * 2.0)
    assert law_over_time("backlash", 0.02, [beyond, -beyond, -beyond])[1:] == [0.0, 0.0]


def test_a_servo_at_its_largest_force_loses_torque_with_speed():
    limited = ARM.replace('kp="5"', 'kp="5" forcerange="-1 1"')
    robot = robot_of(Task(model=mujoco.MjModel.from_xml_string(limited), frame_skip=5))
    zero, speed = torch.zeros(4).double(), torch.zeros(4).double()
    speed[1] = 0.7 * robot.velocity_scale[1]
    state = Readings(
        qpos=zero, qvel=speed, ctrl=torch.tensor([0.0, 2.0, 0.0]).double(), time=zero[:1]
    )
    active = [(effect("torque_speed_limit"), torch.ones(3).double())]
    forcing = Forcing(robot)
    added, _ = forcing(active, forcing.start(active, state), state)
    assert 5.0 * (2.0 + added["ctrl"][1].item()) == pytest.approx(1.2 - 0.7)


def law_over_time(name, strength, commands, **options):
    """Return what reaches the shoulder's motor while the arm is held."""
    robot, law = arm(), effect(name, **options)
    forcing, zero = Forcing(robot), torch.zeros(4, dtype=torch.float64)
    active = [(law, torch.full((3,), strength).double())]
    memories, passed = None, []
    for command in commands:
        ctrl = torch.tensor([command, 0.0, 0.0]).double()
        state = Readings(qpos=zero, qvel=zero, ctrl=ctrl, time=zero[:1])
        memories = forcing.start(active, state) if memories is None else memories
        added, memories = forcing(active, memories, state)
        passed.append(command + added["ctrl"][0].item())
    return passed


def test_a_gap_is_crossed_at_the_motor_s_speed_before_force_passes():
    # full speed is 4 rad/s, a time step 2 ms: a gap of 0.02 rad takes 2.5 steps at full force,
    # and in the third of them half of the force passes on average
    passed = law_over_time("backlash", 0.02, [2.0, 2.0, -2.0, -2.0, -2.0, -2.0, -1.0, 0.0, -1.0])
    assert passed == pytest.approx([2.0, 2.0, 0.0, 0.0, -1.0, -2.0, -1.0, 0.0, -1.0])


def test_a_law_called_less_often_takes_longer_steps():
    robot, zero = arm(), torch.zeros(4, dtype=torch.float64)
    state = Readings(qpos=zero, qvel=zero, ctrl=torch.ones(3).double(), time=zero[:1])
    forcing, active = Forcing(robot), [(effect("backlash"), torch.full((3,), 0.05).double())]
    start = [{"gap": torch.full((3,), -0.025).double()}]
    _, (once,) = forcing(active, start, state, timestep=0.006)
    memories = start
    for _ in range(3):
        _, memories = forcing(active, memories, state)
    torch.testing.assert_close(once["gap"], memories[0]["gap"])


def test_a_spring_in_series_rings_at_its_resonance():
    robot = arm()
    stiffness = robot.model.dof_M0[0] * (2 * math.pi * 10) ** 2  # 10 Hz
    passed = law_over_time("series_elasticity", 1 / stiffness, [0.0, *[1.0] * 500], damping=0.05)
    passed = np.array(passed[1:])
    peaks = np.flatnonzero((passed[1:-1] > passed[:-2]) & (passed[1:-1] > passed[2:]))
    assert np.diff(peaks).mean() * 0.002 == pytest.approx(0.1, rel=0.02)
    assert passed.max() > 1.6
    assert passed[-1] == pytest.approx(1.0, abs=0.1)
    assert passed[:3].max() < 0.2  # nothing passes at once


def test_transmissions_have_no_place_on_actuators_of_unknown_force():
    muscle = """
    <mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
    <actuator><general name="a" joint="j" dyntype="filter" dynprm="0.1"/></actuator></mujoco>"""
    robot = robot_of(Task(model=mujoco.MjModel.from_xml_string(muscle), frame_skip=1))
    for name in ("backlash", "torque_speed_limit", "series_elasticity"):
        assert effect(name).targets(robot) == ()


@pytest.mark.parametrize(
    ("damped", "far", "near"),
    # a distance of 0.3 or 0.02 from the target, and a damping that is worth 0.1 of it
    [(True, -0.05, 0.05), (False, -0.05, -0.02)],
)
def test_the_dead_band_of_a_servo_holds_its_damping_too_or_not(damped, far, near):
    robot = servo('kp="20" kv="2"')
    law = effect("dead_band", damped=damped).on(robot)
    added = [band(law, robot, target=0.5 + e, qpos=0.5, qvel=1.0) for e in (0.3, 0.02)]
    assert added == pytest.approx([far, near])


def test_only_servos_with_damping_have_a_dead_band_without_it():
    forms = effect("dead_band").forms(9.0)
    soft = effect("dead_band", softness=0.5)
    assert forms == (effect("dead_band"), effect("dead_band", damped=False), soft)
    for robot, some in (
        (servo('kp="20" kv="2"'), [("servo",), ("servo",), ()]),
        (servo('kp="20"'), [("servo",), (), ()]),
        (ROBOT, [("motor",), (), ("motor",)]),
    ):
        assert [form.on(robot).targets(robot) for form in forms] == some


@pytest.mark.parametrize(("form", "kv"), [(1, 2.6), (2, 2.0)])
def test_a_servo_of_another_gain_is_what_mujoco_makes_of_it(form, kv):
    robot, stiffer = servo('kp="20" kv="2"'), servo(f'kp="26" kv="{kv}"')
    law = effect("action_gain").forms(9.0)[form].on(robot)
    added = band(law, robot, target=0.6, qpos=0.5, qvel=1.5, strength=0.3)
    model = stiffer.require_model()
    data = mujoco.MjData(model)
    data.ctrl[:], data.qpos[:], data.qvel[:] = 0.6, 0.5, 1.5
    mujoco.mj_forward(model, data)
    assert 20 * (0.6 + added - 0.5) - 2 * 1.5 == pytest.approx(data.actuator_force[0])
    assert effect("action_gain", servo=True).targets(ROBOT) == ()
    assert effect("action_gain", **law.form).on(robot) == law


def servo(gains):
    xml = f"""
    <mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
    <actuator><position name="servo" joint="j" {gains}/></actuator></mujoco>"""
    return robot_of(Task(model=mujoco.MjModel.from_xml_string(xml), frame_skip=1))


def band(law, robot, *, target, qpos, qvel, strength=0.05):
    """Return what a band, or another law of servos, adds to the command."""
    values = {"qpos": qpos, "qvel": qvel, "ctrl": target, "time": 0.0}
    state = Readings(**{name: torch.tensor([value]).double() for name, value in values.items()})
    added, _ = Forcing(robot)([(law, torch.tensor([strength]).double())], [{}], state)
    return added["ctrl"].item()


def test_actuator_forces_are_those_of_mujoco():
    robot, rng = arm(), np.random.default_rng(0)
    data = mujoco.MjData(robot.model)
    data.qpos[:], data.qvel[:] = rng.normal(size=4), rng.normal(size=4)
    data.ctrl[:] = [3.0, 0.4, -50.0]  # two beyond their limits
    mujoco.mj_forward(robot.model, data)
    now = Forcing(robot)._now(
        Readings(
            qpos=torch.from_numpy(data.qpos),
            qvel=torch.from_numpy(data.qvel),
            ctrl=torch.from_numpy(data.ctrl),
            time=torch.zeros(1),
        ),
        0.002,
    )
    np.testing.assert_allclose(now.actuator_force, data.actuator_force, rtol=1e-12)
    np.testing.assert_allclose(now.actuator_velocity, data.actuator_velocity, rtol=1e-12)
    np.testing.assert_allclose(now.load, data.qfrc_actuator, rtol=1e-12)


def test_effects_that_follow_see_a_changed_command():
    robot, zero = arm(), torch.zeros(4, dtype=torch.float64)
    state = Readings(qpos=zero, qvel=zero, ctrl=torch.tensor([2.0, 0.0, 0.0]).double(),
                     time=zero[:1])  # fmt: skip
    gap, friction = effect("series_elasticity"), effect("load_dependent_friction")
    active = [(gap, torch.full((3,), 0.1).double()), (friction, torch.ones(4).double())]
    forcing = Forcing(robot)
    memories = forcing.start(active, state)
    memories[0] |= {"load": zero[:3]}
    added, _ = forcing(active, memories, state)
    passed = 2.0 + added["ctrl"][0]
    assert added["dof_frictionloss"][0] == pytest.approx(2 * passed.item())


# Model entries.


def written(name, strength, robot=None, **options):
    robot = robot or arm()
    models = ModelBatch(robot.model, 1)
    law = effect(name, **options)
    fields = ModelFields(models)
    values = strength_of(name, strength, law.targets(robot))
    law.write(fields, values.expand(1, -1), robot)
    fields.finish()
    return models


HELD = """
<mujoco><worldbody><body name="link" euler="0 20 0">
  <joint axis="0 1 0" pos="0 0 .1"/>
  <geom type="capsule" fromto="0 0 .1 .3 0 -.3" size=".02" mass=".6"/>{held}
</body></worldbody></mujoco>"""
POINT = '<geom type="sphere" pos=".3 0 -.3" size="1e-4" mass=".25"/>'


def test_a_payload_at_the_end_is_what_mujoco_makes_of_a_point_mass_there():
    bare, held = (mujoco.MjModel.from_xml_string(HELD.format(held=p)) for p in ("", POINT))
    robot = robot_of(Task(model=bare, frame_skip=1))
    models = written("payload", {"link": 0.25}, robot, at_end=True)
    for field in ("body_mass", "body_ipos", "body_inertia"):
        expected = np.atleast_1d(getattr(held, field)[1])
        shape = getattr(bare, field).shape[1:]
        found = [models.read(field, (1, *at)).item() for at in np.ndindex(shape)]
        assert found == pytest.approx(expected.tolist(), abs=1e-7)


def test_a_payload_beside_the_end_moves_its_hinge_as_a_point_mass_there_would():
    """``r = (.15, 0, -.2) + (0, 0, -.1)`` from the hinge, and ``y × r`` of it to the side."""
    point = POINT.replace(".3 0 -.3", f"{0.3 - 0.4 * 0.2:.3f} 0 {-0.3 - 0.4 * 0.15:.3f}")
    bare, held = (mujoco.MjModel.from_xml_string(HELD.format(held=p)) for p in ("", point))
    robot = robot_of(Task(model=bare, frame_skip=1))
    models = written("payload", {"link": 0.25}, robot, at_end=True, aside=0.4)
    model = copy.copy(bare)
    for field in ("body_mass", "body_ipos", "body_inertia"):
        values = getattr(model, field)
        for at in np.ndindex(values.shape[1:]):
            values[(1, *at)] = models.read(field, (1, *at)).item()
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for angle in (-0.7, 0.0, 1.2):
        pushed = []
        for one in (model, held):
            data = mujoco.MjData(one)
            data.qpos[0] = angle
            mujoco.mj_forward(one, data)
            mass = np.zeros((1, 1))
            mujoco.mj_fullM(one, data, mass)
            pushed.append((mass.item(), data.qfrc_bias[0]))
        assert pushed[0] == pytest.approx(pushed[1], abs=1e-6)


def test_a_payload_that_is_spread_is_not_beside_an_end():
    with pytest.raises(ValueError, match=r"aside=0\.4, at_end=False.*Try: at_end=True"):
        effect("payload", aside=0.4)


def test_a_body_without_an_end_of_its_own_carries_nothing_there():
    beside = HELD.replace('pos="0 0 .1"', 'pos="0 0 .2"').format(held="")  # not along the capsule
    sliding = HELD.replace("<joint ", '<joint type="slide" ').format(held="")
    for text in (beside, sliding):
        robot = robot_of(Task(model=mujoco.MjModel.from_xml_string(text), frame_skip=1))
        assert effect("payload").targets(robot) == ("link",)
        assert effect("payload", at_end=True).targets(robot) == ()


def test_friction_that_falls_with_speed_brakes_as_it_says():
    model = arm().model
    models = written("viscous_friction", {"rail": 3.0}, rise=-0.25)
    model.dof_damping[2] = models.read("dof_damping", (2,)).item()
    model.dof_dampingpoly[2] = [models.read("dof_dampingpoly", (2, i)).item() for i in (0, 1)]
    data = mujoco.MjData(model)
    for v in (-2.0, 0.5):
        data.qvel[2] = v
        mujoco.mj_forward(model, data)
        assert data.qfrc_damper[2] == pytest.approx(-3.0 * v * (1 - 0.25 * abs(v)))


def test_a_spring_that_hardens_pulls_as_it_says():
    model = arm().model
    models = written("parallel_spring", {"rail": 3.0}, hardening=0.5)
    model.jnt_stiffness[2] = models.read("jnt_stiffness", (2,)).item()
    model.jnt_stiffnesspoly[2] = [models.read("jnt_stiffnesspoly", (2, i)).item() for i in (0, 1)]
    data = mujoco.MjData(model)
    for x in (-0.4, 0.3):
        data.qpos[model.jnt_qposadr[2]] = model.qpos_spring[model.jnt_qposadr[2]] + x
        mujoco.mj_forward(model, data)
        assert data.qfrc_spring[2] == pytest.approx(-3.0 * x * (1 + 0.5 * x**2))


def test_entries():
    model = arm().model
    tilted = written("gravity_tilt", {"y": 0.1})
    gravity = [tilted.read("opt.gravity", (i,)).item() for i in range(3)]
    assert gravity == pytest.approx([-9.81 * math.sin(0.1), 0.0, -9.81 * math.cos(0.1)])
    heavy = written("payload", {"lower": 0.5})
    mass = model.body_mass[2]
    assert heavy.read("body_mass", (2,)).item() == pytest.approx(mass + 0.5)
    assert heavy.read("body_inertia", (2, 0)).item() == pytest.approx(
        model.body_inertia[2, 0] * (mass + 0.5) / mass
    )
    assert heavy.read("body_subtreemass", (1,)).item() == pytest.approx(
        model.body_subtreemass[1] + 0.5
    )
    assert written("com_shift", {"lower x": 0.05}).read("body_ipos", (2, 0)).item() == 0.05
    assert written("link_length", {"lower": 0.1}).read("body_pos", (2, 2)).item() == pytest.approx(
        -0.55
    )
    slippery = written("contact_friction", -0.5)
    assert [slippery.read("geom_friction", (g, 0)).item() for g in range(4)] == [0.5] * 4
    soft = written("contact_softness", 1.0)
    assert soft.read("geom_solref", (0, 0)).item() == pytest.approx(0.04)
    assert written("time_scale", -0.1).read("opt.timestep", ()).item() == pytest.approx(0.0018)
    assert written("armature", {"elbow": 0.2}).read("dof_armature", (1,)) == pytest.approx(0.21)
    assert written("viscous_friction", 0.1).read("dof_damping", (0,)).item() == pytest.approx(0.12)
    assert written("parallel_spring", {"rail": 3.0}).read("jnt_stiffness", (2,)).item() == 3.0


def test_stiffness_and_damping_of_a_contact_soften_like_its_time_constant():
    box = """
    <mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 1"><joint type="slide"/>
    <geom size=".1" solref="-{} -{}"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(box.format(1000, 20))
    robot, models = robot_of(Task(model=model, frame_skip=1)), ModelBatch(model, 1)
    fields = ModelFields(models)
    effect("contact_softness").write(fields, torch.ones(1, 1), robot)
    assert models.read("geom_solref", (1, 0)).item() == -250.0
    assert models.read("geom_solref", (1, 1)).item() == -10.0


def test_a_centre_of_mass_that_mujoco_takes_for_fixed_is_no_target():
    assert not any(t.startswith("sledge") for t in effect("com_shift").targets(arm()))


def test_a_robot_that_touches_nothing_has_no_contacts_to_change():
    pole = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    robot = robot_of(Task(model=mujoco.MjModel.from_xml_string(pole), frame_skip=1))
    assert effect("contact_friction").targets(robot) == ()
    robot = arm()
    assert effect("contact_friction").targets(robot) == ("all",)
    robot.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert effect("contact_friction").targets(robot) == ()


def test_units_are_those_of_the_joint_or_channel():
    robot = arm()
    units = {
        name: [unit_at(effect(name), robot, i) for i in range(len(effect(name).targets(robot)))]
        for name in ("viscous_friction", "backlash", "sensor_bias", "sensor_drift", "payload",
                     "gravity_tilt")
    }  # fmt: skip
    assert units["viscous_friction"] == ["N m s/rad", "N m s/rad", "N s/m", "N s/m"]
    assert units["backlash"] == ["rad", "rad", "m"]
    assert units["sensor_bias"] == ["rad", "rad", "m", "m", "rad/s", "rad/s", "m/s", "m/s"]
    assert units["sensor_drift"][::4] == ["rad/s", "rad/s²"]
    assert units["payload"] == ["kg"] * 3
    assert units["gravity_tilt"] == ["rad", "rad"]
    bare = Robot(dt=0.1, channels=("a",), channel_joint=(-1,), channel_kind=("other",))
    assert unit_at(effect("sensor_bias"), bare, 0) == "channel"


def test_an_overlay_never_compounds_and_yields_to_what_was_written_since():
    robot = robot_of(arm_task())
    models = ModelBatch(robot.model, 2)
    overlay, law = Overlay(models), effect("payload")
    strength = strength_of("payload", {"lower": 1.0}, law.targets(robot)).expand(2, -1)
    both, second = np.array([True, True]), np.array([False, True])
    nominal = robot.model.body_mass[2]
    for _ in range(3):
        overlay.remove(both)
        overlay.put(law, strength, robot, both)
    np.testing.assert_allclose(models.read("body_mass", (2,)), nominal + 1.0)
    models.write("body_mass", (2,), np.array([9.0, 9.0]), second)
    overlay.remove(both)
    np.testing.assert_allclose(models.read("body_mass", (2,)), [nominal, 9.0])
    overlay.put(law, strength, robot, second)
    np.testing.assert_allclose(models.read("body_mass", (2,)), [nominal, 10.0])
    overlay.remove(both)
    np.testing.assert_allclose(models.read("body_mass", (2,)), [nominal, 9.0])


# Errors.


def test_errors_say_what_is_wrong():
    with pytest.raises(ValueError, match="a robot with a MuJoCo model"):
        Forcing(ROBOT)
    with pytest.raises(KeyError, match=r"a target of payload.*did you mean"):
        strength_of("payload", {"foott": 1.0}, ("foot", "thigh"))
    with pytest.raises(ValueError, match="one strength of payload for each"):
        strength_of("payload", torch.zeros(3), ("foot", "thigh"))
    with pytest.raises(ValueError, match="finite strengths of payload"):
        strength_of("payload", [0.0, math.inf], ("foot", "thigh"))
    with pytest.raises(ValueError, match="something that payload can act on"):
        strength_of("payload", 1.0, ())


def test_laws_of_one_s_own_are_short():
    class Hysteresis(ActionEffect):
        name, unit, group = "hysteresis", "fraction", "gain"

        def command(self, action, strength, memory, now):
            return action * (1 - strength * (memory["last"] * action < 0)), {"last": action}

        def start(self, action):
            return {"last": torch.zeros_like(action)}

        def bounds(self, robot):
            return torch.zeros(len(robot.actuators)), torch.ones(len(robot.actuators))

    sequence = command_sequence(Hysteresis(), column(1, -1, -1), torch.tensor([0.5]), ROBOT)
    assert sequence[:, 0].tolist() == [1.0, -0.5, -1.0]
    now = SimpleNamespace(robot=ROBOT)
    assert Hysteresis().command(column(1)[0], torch.zeros(1), {"last": column(1)[0]}, now)[0] == 1
