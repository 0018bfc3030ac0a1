"""A gap and a spring between motor and joint, against a rotor and a load that MuJoCo simulates."""

from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from apparatus import driven
from rotor_and_link import LINK, ROTOR, gap, one_body, spring, two_bodies

from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.effect import Reach
from torchrl_bayessim.effects.forcing import Forcing, Readings
from torchrl_bayessim.effects.robot import robot_of
from torchrl_bayessim.envs.task import Task

SECONDS, CONTROL = 3.0, 0.02


def commands():
    t = np.arange(0.0, SECONDS, CONTROL)
    return 0.6 * np.sin(5 * t + 1) + 0.4 * np.sin(17 * t) + 0.3 * np.sign(np.sin(9 * t))


def truth(shaft):
    """Return the joint's positions where rotor and load are two bodies."""
    return driven_by(two_bodies(shaft, 2e-5), round(CONTROL / 2e-5))


def driven_by(model, substeps):
    """Return the first joint's positions under the commands, each held for so many steps."""
    data, found = mujoco.MjData(model), []
    for u in commands():
        data.ctrl[0] = u
        mujoco.mj_step(model, data, substeps)
        found.append(data.qpos[0])
    return np.array(found)


def simulated(law, strength, dt):
    """Return them where the rotor is the joint's armature and an effect is between."""
    model, substeps = one_body(dt), round(CONTROL / dt)
    active = [(law, torch.tensor([strength]).double())]
    held = np.repeat(commands(), substeps)[:, None]
    robot = robot_of(Task(model=model, frame_skip=4))
    angles = np.array([data.qpos[0] for data in driven(model, robot, active, held)])
    return angles[substeps - 1 :: substeps]


@cache
def rigid(dt):
    """Return them where the rotor is the joint's armature and the shaft is stiff."""
    return driven_by(one_body(dt), round(CONTROL / dt))


def share_left(real, law, strength, dt, *, finest=2e-4):
    """Return what of the difference that it stands for an effect misses, mean squares.

    Both are differences to a rigid shaft, with the same integrator each.
    """
    difference = real - rigid(finest)
    missed = simulated(law, strength, dt) - rigid(dt) - difference
    return np.mean(missed**2) / np.mean(difference**2)


@pytest.mark.parametrize("dt", [0.001, 0.005])
@pytest.mark.parametrize("hertz", [6.0, 20.0])
def test_a_spring_is_that_of_a_rotor_and_a_load(hertz, dt):
    shaft, compliance = spring(hertz, 0.2)
    law = effect("series_elasticity", damping=0.2)
    assert share_left(truth(shaft), law, compliance, dt) < 0.07


@pytest.mark.parametrize("dt", [0.001, 0.005])
@pytest.mark.parametrize("width", [0.02, 0.1])
def test_a_gap_is_that_of_a_free_rotor(width, dt):
    shaft, _ = gap(width)
    assert share_left(truth(shaft), effect("backlash", rotor=True), width, dt) < 0.2


def with_play(width, compliance, dt=2e-5):
    """Return the joint's positions where a spring is at the sides of a gap between two bodies."""
    model = two_bodies("", dt)
    data, found = mujoco.MjData(model), []
    reduced = ROTOR * LINK / (ROTOR + LINK)
    c = 2 * 0.3 * np.sqrt(reduced / compliance)
    for u in commands():
        data.ctrl[0] = u
        for _ in range(round(CONTROL / dt)):
            apart, speed = data.qpos[1] - data.qpos[0], data.qvel[1] - data.qvel[0]
            over = apart - np.clip(apart, -width / 2, width / 2)
            force = (over / compliance + c * speed) if over else 0.0
            data.qfrc_applied[:] = force, -force
            mujoco.mj_step(model, data)
        found.append(data.qpos[0])
    return np.array(found)


@pytest.mark.parametrize("dt", [0.001, 0.005])
@pytest.mark.parametrize(("width", "wind"), [(0.02, 0.3), (0.02, 1.5), (0.1, 0.05)])
def test_a_gap_with_a_spring_is_that_of_a_rotor_and_a_load(width, wind, dt):
    real = with_play(width, wind * width / 4.0)  # of 2 N m at a gear of 2
    missed, stiff = (
        share_left(real, effect("backlash", rotor=True, wind=w), width, dt, finest=2e-5)
        for w in (wind, 0.0)
    )
    assert missed < 0.15
    assert missed < 0.85 * stiff


def geared(gear, armature=ROTOR):
    """Return a robot with two motors of that gear, one without a rotor."""
    xml = """<mujoco><option timestep="{dt}"/><worldbody>
      <body><joint name="a" axis="0 1 0" armature="{armature}"/>
        <inertial pos="0 0 -.1" mass="0.5" diaginertia=".02 .02 .02"/></body>
      <body><joint name="b" axis="0 1 0"/>
        <inertial pos="0 0 -.1" mass="0.5" diaginertia=".02 .02 .02"/></body></worldbody>
    <actuator><motor joint="a" gear="{gear}" ctrlrange="-2 2"/>
      <motor joint="b" ctrlrange="-2 2"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml.format(dt=0.01, armature=armature, gear=gear))
    return robot_of(Task(model=model, frame_skip=1))


def passed(law, strengths, commands, *, gear=1.0, timestep=0.01):
    """Return the changes of commands, ``(T, B, 2)``, of joints that are held."""
    robot = geared(gear)
    forcing, active = Forcing(robot), [(law, torch.tensor(strengths).double())]
    memory, found = None, []
    for command in commands:
        state = Readings(
            qpos=torch.zeros(len(strengths), 2).double(),
            qvel=torch.zeros(len(strengths), 2).double(),
            ctrl=torch.full((len(strengths), 2), command).double(),
            time=torch.zeros(len(strengths), 1).double(),
        )
        memory = forcing.start(active, state) if memory is None else memory
        added, memory = forcing(active, memory, state, timestep=timestep)
        found.append(added["ctrl"].numpy())
    return np.array(found)


@pytest.mark.parametrize("wind", [0.05, 0.3, 3.0])
@pytest.mark.parametrize("timestep", [0.002, 0.01, 0.02])
def test_a_rotor_comes_to_rest_at_a_side_however_stiff_the_shaft(wind, timestep):
    """The joint is held, the command turns round once: afterwards all of it passes."""
    widths = np.geomspace(1e-7, 0.1, 25)
    law = effect("backlash", rotor=True, wind=wind)
    commands = [1.0] * 5 + [-1.0] * 600
    changes = passed(law, [[w, w] for w in widths], commands, timestep=timestep)[..., 0]
    assert np.abs(changes[0]).max() < 1e-9  # wound up by the first command
    assert np.abs(changes[5:]).max() > 0.1
    assert np.abs(changes[-50:]).max() < 0.01


def test_a_gap_with_a_spring_is_the_same_beside_stiffer_ones():
    law = effect("backlash", rotor=True, wind=3.0)
    commands = 1.5 * np.sin(0.4 * np.arange(80))
    together = passed(law, [[0.05, 0.0], [1e-4, 0.0], [0.0, 0.0]], commands)
    alone = passed(law, [[0.05, 0.0]], commands)
    np.testing.assert_array_equal(together[:, :1], alone)
    assert np.abs(alone).max() > 0.1
    assert not together[:, 2].any()


def test_a_gap_with_a_spring_is_of_a_shaft_that_gears_stiffen():
    """At the joint: twice the gear is twice the torque, on a shaft that is twice as stiff."""
    law, commands = effect("backlash", rotor=True, wind=1.0), np.sin(0.4 * np.arange(60))
    plus, minus = (passed(law, [[0.02, 0.0]], sign * commands, gear=2 * sign) for sign in (1, -1))
    np.testing.assert_allclose(plus, -minus, atol=1e-12)
    single = passed(law, [[0.01, 0.0]], commands)
    np.testing.assert_allclose(passed(law, [[0.02, 0.0]], commands, gear=2.0), single, atol=1e-9)


def test_a_motor_without_a_rotor_has_no_spring_behind_a_gap():
    law = effect("backlash", rotor=True, wind=1.0)
    assert not passed(law, [[0.02, 0.02]], np.sin(0.4 * np.arange(60)))[..., 1].any()


@pytest.mark.parametrize("wind", [0.05, 1.0])
def test_a_narrow_gap_with_a_spring_changes_as_little(wind):
    law = effect("backlash", rotor=True, wind=wind)
    np.testing.assert_allclose(simulated(law, 0.0, 0.005), rigid(0.005), atol=1e-12)
    for width in (1e-3, 1e-4, 1e-5, 1e-6):
        moved = np.abs(simulated(law, width, 0.005) - rigid(0.005)).max()
        assert moved < 20 * (1 + wind) * width


def test_how_far_a_shaft_winds_up_is_fitted_like_a_strength():
    led, stiff, soft = effect("backlash").forms(5.0)
    reach = Reach(1.0, 1.0, 5.0, slides=False)
    assert (led.rotor, stiff.rotor, soft.rotor) == (False, True, True)
    assert not led.free(reach)
    assert not stiff.free(reach)
    width, least, most = soft.free(reach)["wind"]
    assert 0 < least < width < soft.wind < most
    assert (led.nuisances, stiff.nuisances, soft.nuisances) == ((), (), ("wind",))


def test_only_motors_with_a_rotor_have_one_in_a_gap():
    robot = robot_of(Task(model=one_body(0.002, armature=0), frame_skip=1))
    assert effect("backlash").targets(robot) == ("motor",)
    assert effect("backlash", rotor=True).targets(robot) == ()


CHAIN = """
<mujoco><option timestep="0.005" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0" type="capsule" size=".02" mass=".4"/>
    <joint axis="0 1 0" damping=".05"/></default><worldbody>
  <body><joint name="a" armature="{a}"/><geom fromto="0 0 0 0 0 -.3"/>
    <body pos="0 0 -.3"><joint name="b" armature="{b}"/><geom fromto="0 0 0 0 0 -.3"/>
      <body pos="0 0 -.3"><joint name="c" armature="{c}"/><geom fromto="0 0 0 0 0 -.3"/></body>
  </body></body></worldbody>
<actuator>{actuators}</actuator></mujoco>
"""
MOTORS = "".join(f'<motor joint="{j}" ctrlrange="-4 4"/>' for j in "abc")


def chain(rotors, actuators=MOTORS):
    armature = dict(zip("abc", rotors, strict=True))
    return mujoco.MjModel.from_xml_string(CHAIN.format(**armature, actuators=actuators))


def fastest(model, nominal, law, share=0.1):
    """Return the largest velocity within three seconds of driving."""
    robot = robot_of(Task(model=nominal, frame_skip=4))
    strengths = share * law.bounds(robot)[1]
    commands = np.sin(np.arange(600)[:, None] * np.array([0.05, 0.11, 0.17][: model.nu]))
    states = driven(model, robot, [(law, strengths)], commands)
    return max(float(np.abs(data.qvel).max()) for data in states)


LAWS = [effect("series_elasticity"), effect("backlash", rotor=True)]


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("share", [1.0, 0.6, 0.2])
def test_rotors_stay_where_the_simulated_ones_are_lighter_than_the_nominal(law, share):
    rotors = 0.5 * chain([0.0] * 3).dof_M0
    nominal, lighter = chain(rotors), chain(share * rotors)
    rigid = fastest(lighter, nominal, law, share=0.0)
    assert fastest(lighter, nominal, law) < 3 * rigid


@pytest.mark.parametrize("law", LAWS)
def test_servos_have_a_spring_of_the_whole_joint_and_no_free_rotor(law):
    servos = '<position joint="a" kp="20" kv="5"/>'
    model = chain([0.01] * 3, servos)
    robot = robot_of(Task(model=model, frame_skip=4))
    assert (law.targets(robot) == ()) == (law.name == "backlash")
    if law.targets(robot):
        assert law.bounds(robot)[1] == pytest.approx(1 / (model.dof_M0[0] * (4 * np.pi) ** 2))
        assert fastest(model, model, law, share=0.01) < 2 * fastest(model, model, law, share=0.0)


def test_motors_that_share_a_joint_or_have_no_rotor_are_rigid_in_a_gap():
    shared = '<motor joint="a"/><motor joint="a"/><motor joint="b"/>'
    law = effect("backlash", rotor=True)
    robot = robot_of(Task(model=chain([0.01, 0.0, 0.01], shared), frame_skip=4))
    assert law.targets(robot) == ()
    model = chain([0.01, 0.0, 0.01])
    robot = robot_of(Task(model=model, frame_skip=4))
    assert (law.bounds(robot)[1] > 0).tolist() == [True, False, True]
    forcing, zero = Forcing(robot), torch.zeros(3, dtype=torch.float64)
    active = [(law, torch.tensor([0.0, 0.05, 0.0]).double())]
    states = [
        Readings(qpos=zero, qvel=zero, ctrl=zero + u, time=zero[:1]) for u in (1.0, -1.0, -1.0)
    ]
    memories = forcing.start(active, states[0])
    for state in states:
        added, memories = forcing(active, memories, state)
        assert not added["ctrl"].any()
        assert not added["qfrc_applied"].any()


def test_a_rotor_that_is_most_of_the_inertia_is_none_to_these_laws():
    robot = robot_of(Task(model=chain([1.0, 0.01, 0.01]), frame_skip=4))
    high = effect("backlash", rotor=True).bounds(robot)[1]
    assert (high > 0).tolist() == [False, True, True]
    whole = robot.model.dof_M0[0]
    softest = effect("series_elasticity").bounds(robot)[1][0].item()
    assert softest == pytest.approx(1 / (whole * (4 * np.pi) ** 2))


@pytest.mark.parametrize(
    ("name", "options", "error", "match"),
    [
        ("series_elasticity", {"damping": 1.0}, ValueError, "below 1, got 1.0"),
        ("series_elasticity", {"damping": -0.1}, ValueError, "at least 0"),
        ("backlash", {"rotor": "no"}, TypeError, "expected rotor to be true or false"),
        ("backlash", {"rotor": True, "wind": -1.0}, ValueError, "at least 0"),
        ("sensor_lag", {"second": 0.6}, ValueError, "at most 0.5"),
        ("backlash", {"wind": 1.0}, ValueError, "a rotor that winds a shaft up"),
    ],
)
def test_impossible_options_are_refused(name, options, error, match):
    with pytest.raises(error, match=match):
        effect(name, **options)
