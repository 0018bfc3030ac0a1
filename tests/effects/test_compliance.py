"""A gap and a spring between motor and joint, against a rotor and a load that MuJoCo simulates."""

from functools import cache

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.forcing import Forcing, Readings
from torchrl_bayessim.effects.robot import robot_of
from torchrl_bayessim.envs.task import Task

ROTOR, SECONDS, CONTROL = 0.01, 3.0, 0.02
DRIVE = """
<mujoco><option timestep="{dt}" integrator="implicitfast"/><worldbody>
  <body><joint name="joint" axis="0 1 0" damping="0.1" armature="{armature}"/>
    <inertial pos="0 0 -.1" mass="0.5" diaginertia=".02 .02 .02"/></body>
  {rotor}
</worldbody>{tendon}
<actuator><motor name="motor" joint="{driven}" gear="2" ctrlrange="-2 2"/></actuator></mujoco>
"""
BEHIND = """<body><joint name="rotor" axis="0 1 0"/>
  <inertial pos="0 0 0" mass="1" diaginertia="{i} {i} {i}"/></body>"""
SHAFT = """<tendon><fixed name="shaft" limited="{limited}" range="{low} {high}" stiffness="{k}"
  damping="{c}" springlength="0" {stiff}>
  <joint joint="rotor" coef="1"/><joint joint="joint" coef="-1"/></fixed></tendon>"""


def commands():
    t = np.arange(0.0, SECONDS, CONTROL)
    return 0.6 * np.sin(5 * t + 1) + 0.4 * np.sin(17 * t) + 0.3 * np.sign(np.sin(9 * t))


def truth(**shaft):
    """Return the joint's positions where rotor and load are two bodies."""
    stiff = 'solreflimit="0.002 1" solimplimit="0.99 0.999 0.001"'
    shaft = {"limited": "false", "low": 0, "high": 0, "k": 0, "c": 0, "stiff": stiff} | shaft
    xml = DRIVE.format(dt=2e-5, armature=0, rotor=BEHIND.format(i=ROTOR), driven="rotor",
                       tendon=SHAFT.format(**shaft))  # fmt: skip
    model = mujoco.MjModel.from_xml_string(xml)
    data, found = mujoco.MjData(model), []
    for u in commands():
        data.ctrl[0] = u
        mujoco.mj_step(model, data, round(CONTROL / 2e-5))
        found.append(data.qpos[0])
    return np.array(found)


def simulated(law, strength, dt):
    """Return them where the rotor is the joint's armature and an effect is between."""
    xml = DRIVE.format(dt=dt, armature=ROTOR, rotor="", tendon="", driven="joint")
    model = mujoco.MjModel.from_xml_string(xml)
    robot = robot_of(Task(model=model, frame_skip=round(CONTROL / dt)))
    forcing, active = Forcing(robot), [(law, torch.tensor([strength]).double())]
    data, found, memories = mujoco.MjData(model), [], None
    for u in commands():
        for _ in range(round(CONTROL / dt)):
            state = Readings(qpos=torch.tensor(data.qpos), qvel=torch.tensor(data.qvel),
                             ctrl=torch.tensor([u]), time=torch.tensor([data.time]))  # fmt: skip
            memories = forcing.start(active, state) if memories is None else memories
            added, memories = forcing(active, memories, state)
            data.ctrl[0] = u + added["ctrl"][0].item()
            data.qfrc_applied[0] = added["qfrc_applied"][0].item()
            mujoco.mj_step(model, data)
        found.append(data.qpos[0])
    return np.array(found)


@cache
def rigid(dt):
    return simulated(effect("series_elasticity"), 0.0, dt)


def share_left(real, law, strength, dt):
    """Return what of the difference that it stands for an effect misses, mean squares.

    Both are differences to a rigid shaft, with the same integrator each.
    """
    difference = real - rigid(2e-4)
    missed = simulated(law, strength, dt) - rigid(dt) - difference
    return np.mean(missed**2) / np.mean(difference**2)


@pytest.mark.parametrize("dt", [0.001, 0.005])
@pytest.mark.parametrize("hertz", [6.0, 20.0])
def test_a_spring_is_that_of_a_rotor_and_a_load(hertz, dt):
    load = 0.02 + 0.5 * 0.1**2
    reduced = ROTOR * load / (ROTOR + load)
    k = reduced * (2 * np.pi * hertz) ** 2
    real = truth(k=k, c=2 * 0.2 * np.sqrt(k * reduced))
    assert share_left(real, effect("series_elasticity", damping=0.2), 1 / k, dt) < 0.1


@pytest.mark.parametrize("dt", [0.001, 0.005])
@pytest.mark.parametrize("gap", [0.02, 0.1])
def test_a_gap_is_that_of_a_free_rotor(gap, dt):
    real = truth(limited="true", low=-gap / 2, high=gap / 2)
    assert share_left(real, effect("backlash", rotor=True), gap, dt) < 0.3


def test_only_motors_with_a_rotor_have_one_in_a_gap():
    xml = DRIVE.format(dt=0.002, armature=0, rotor="", tendon="", driven="joint")
    robot = robot_of(Task(model=mujoco.MjModel.from_xml_string(xml), frame_skip=1))
    assert effect("backlash").targets(robot) == ("motor",)
    assert effect("backlash", rotor=True).targets(robot) == ()


@pytest.mark.parametrize("name", ["series_elasticity", "backlash"])
def test_a_rotor_that_is_most_of_the_inertia_stays_stable(name):
    heavy = DRIVE.format(dt=0.005, armature=1.0, rotor="", tendon="", driven="joint")
    model = mujoco.MjModel.from_xml_string(heavy)
    robot = robot_of(Task(model=model, frame_skip=4))
    law = effect(name, rotor=True) if name == "backlash" else effect(name)
    forcing, active = Forcing(robot), [(law, torch.tensor([0.02]).double())]
    data, memories, ctrl = mujoco.MjData(model), None, []
    for step in range(600):
        state = Readings(qpos=torch.tensor(data.qpos), qvel=torch.tensor(data.qvel),
                         ctrl=torch.tensor([np.sin(step / 40)]),
                         time=torch.tensor([data.time]))  # fmt: skip
        memories = forcing.start(active, state) if memories is None else memories
        added, memories = forcing(active, memories, state)
        ctrl.append(np.sin(step / 40) + added["ctrl"][0].item())
        data.ctrl[0] = ctrl[-1]
        data.qfrc_applied[0] = added["qfrc_applied"][0].item()
        mujoco.mj_step(model, data)
    assert np.abs(data.qvel).max() < 10
