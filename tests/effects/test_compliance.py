"""A gap and a spring between motor and joint, against a rotor and a load that MuJoCo simulates."""

from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from apparatus import driven
from rotor_and_link import LINK, ROTOR, gap, one_body, spring, two_bodies

from torchrl_bayessim.effects.catalogue import effect
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


def test_a_gap_with_a_spring_is_nothing_where_there_is_no_gap():
    law = effect("backlash", rotor=True, wind=1.0)
    np.testing.assert_allclose(simulated(law, 0.0, 0.005), rigid(0.005), atol=1e-12)
    nearly = simulated(law, 1e-7, 0.005) - rigid(0.005)
    assert np.abs(nearly).max() < 1e-3


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
        ("backlash", {"wind": 1.0}, ValueError, "a rotor that winds a shaft up"),
    ],
)
def test_impossible_options_are_refused(name, options, error, match):
    with pytest.raises(error, match=match):
        effect(name, **options)
