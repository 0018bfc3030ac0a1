"""Lags and delays within a control step: against MuJoCo with commands of its own, and `action`."""

import math

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.effects.action import ActionDelay, ActionLag
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.drive_timing import DriveDelay, DriveLag
from torchrl_bayessim.effects.forcing import Forcing
from torchrl_bayessim.effects.push import Push
from torchrl_bayessim.effects.robot import Robot, robot_of
from torchrl_bayessim.effects.sequence import command_sequence
from torchrl_bayessim.envs.task import Readings, Task
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.transforms.apply_effect import ApplyEffect

STEP, PARTS = 0.05, 5  # of the control step, and how many time steps it has
WHEELS = """<mujoco><option timestep="0.01" gravity="0 0 0" integrator="implicitfast"/><worldbody>
  <body><joint name="a" axis="0 0 1" damping="{damping}"/>
  <inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/></body>
  <body><joint name="b" axis="0 0 1" damping="0"/>
  <inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/></body></worldbody>
  <actuator><motor joint="a" ctrlrange="-2 2"/><motor joint="b" ctrlrange="-2 2"/></actuator>
  </mujoco>"""


def wheels(damping=4.0):
    model = mujoco.MjModel.from_xml_string(WHEELS.format(damping=damping))
    return robot_of(Task(model=model, frame_skip=PARTS))


def sent(steps=12):
    return torch.from_numpy(np.random.default_rng(3).uniform(-1, 1, (steps, 2)))


def acting(law, strength, robot, commands):
    """Return the command that acts in each time step, shape ``(T, PARTS, A)``."""
    forcing, memories, rows = Forcing(robot), None, []
    active = [(law, torch.as_tensor(strength).double())]
    for command in commands:
        for _ in range(PARTS):
            state = Readings(
                qpos=torch.zeros(2).double(),
                qvel=torch.zeros(2).double(),
                ctrl=command,
                time=torch.zeros(1).double(),
            )
            memories = forcing.start(active, state) if memories is None else memories
            added, memories = forcing(active, memories, state)
            rows.append(command + added["ctrl"])
    return torch.stack(rows).reshape(len(commands), PARTS, -1)


@pytest.mark.parametrize("seconds", [0.0, 0.004, 0.013, 0.05, 0.07, 0.1])
def test_a_delay_hands_on_what_was_sent_so_long_ago(seconds):
    commands = sent()
    late = acting(DriveDelay(), [seconds, 0.0], wheels(), commands)
    grid, fine = 1000, 0.01 / 1000
    for k, part in ((0, 0), (2, 0), (3, 1), (7, 4)):
        times = (k * PARTS + part) * 0.01 + (np.arange(grid) + 0.5) * fine - seconds
        at = np.maximum(np.floor(times / STEP + 1e-9), 0).astype(int)
        mean = commands[at, 0].mean()
        assert late[k, part, 0].item() == pytest.approx(mean.item(), abs=2e-3)
    torch.testing.assert_close(late[:, 2, 1], commands[:, 1])  # the other is in time


@pytest.mark.parametrize("second", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("seconds", [0.003, 0.02, 0.12])
def test_a_lag_within_the_step_is_on_average_the_one_of_the_step(seconds, second):
    robot, commands = wheels(), sent()
    strength = torch.tensor([seconds, 0.0]).double()
    inside = acting(DriveLag(second=second), strength, robot, commands)
    law = ActionLag(held=False, second=second)
    torch.testing.assert_close(inside.mean(1), command_sequence(law, commands, strength, robot))
    if not second:  # and goes towards the command within it; what has two may swing past
        behind = (inside[5, :, 0] - commands[5, 0]).abs()
        assert (behind.diff() <= 1e-12).all()
        assert behind[0] > behind[-1]


@pytest.mark.parametrize("seconds", [0.0, 0.013, 0.05, 0.07])
def test_a_delay_within_the_step_is_on_average_the_one_of_the_step(seconds):
    robot, commands = wheels(), sent()
    strength = torch.tensor([seconds, 0.0]).double()
    inside = acting(DriveDelay(), strength, robot, commands)
    whole = command_sequence(ActionDelay(), commands, strength, robot)
    torch.testing.assert_close(inside.mean(1), whole)


def test_only_a_robot_that_its_damping_stops_within_a_step_has_them():
    fast, slow = wheels(damping=0.6), wheels(damping=0.4)
    assert (fast.fast, slow.fast) == (True, False)  # 0.05 s · d / 0.1 kg m² above 0.25
    assert ActionLag(held=False, second=0.2).on(fast) == DriveLag(second=0.2)
    assert ActionDelay(inside=True).on(fast) == DriveDelay()
    for law in (ActionLag(), ActionDelay()):
        assert law.on(fast) is law
    for law in (DriveLag(second=0.2), DriveDelay()):  # as a report has them, and makes them anew
        assert effect(law.name, **law.form).on(fast) == law
    for law in (ActionLag(held=False), ActionDelay(inside=True)):
        assert law.on(slow) is law
    assert ActionDelay(inside=True).targets(slow) == ()
    names = "HalfCheetah-v5", "Hopper-v5", "Ant-v5", "InvertedPendulum-v5"
    assert [robot_of(known_task(n)).fast for n in names] == [True, False, False, False]


def test_a_wheel_ends_a_step_where_the_last_part_of_its_command_has_moved_it():
    """``I q̈ = u(t) − d q̇`` under a step of the command that a lag of 20 ms smooths."""
    robot, lag, damping = wheels(damping=4.0), 0.02, 4.0
    model = robot.require_model()
    model.opt.timestep = 0.001
    fine = robot_of(Task(model=model, frame_skip=50))
    push = Push(DriveLag(), fine, lambda: torch.tensor([lag, 0.0]).double())
    data = mujoco.MjData(model)
    speeds = []
    for command in (0.0, 1.0, 1.0):
        for _ in range(50):
            added = push(
                Readings(
                    qpos=torch.from_numpy(data.qpos.copy()),
                    qvel=torch.from_numpy(data.qvel.copy()),
                    ctrl=torch.full((2,), command).double(),
                    time=torch.tensor([data.time]).double(),
                )
            )
            data.ctrl[:] = command + added["ctrl"].numpy()
            mujoco.mj_step(model, data)
        speeds.append(data.qvel[0])
    # from rest: v = (1 − e^{−rt}) / d − (e^{−t/T} − e^{−rt}) / (I (r − 1/T)), r = d / I
    rate = damping / 0.1
    for speed, t in ((speeds[1], 0.05), (speeds[2], 0.1)):
        risen = (1 - math.exp(-rate * t)) / damping
        lost = (math.exp(-t / lag) - math.exp(-rate * t)) / (0.1 * (rate - 1 / lag))
        assert speed == pytest.approx(risen - lost, rel=0.02)


def test_what_is_looked_for_is_what_a_catalogue_offers():
    robot = wheels()
    offered = [law for name in ("action_lag", "action_delay") for law in effect(name).forms(1.0)]
    assert [law.on(robot) for law in offered[1::2]] == [DriveLag(), DriveDelay()]
    for law, most in ((DriveLag(), 0.15), (DriveDelay(), 0.1)):
        low, high = law.bounds(robot)
        assert (low.tolist(), high.tolist()) == ([0.0, 0.0], [most, most])
        assert law.targets(robot) == robot.actuators
        assert [law.joint(robot, i) for i in range(2)] == list(robot.joint_of_actuator)
    assert list(DriveLag().free(None)) == ["second"]
    long = acting(DriveDelay(), [5 * STEP, 0.0], robot, sent())  # beyond what is looked for
    torch.testing.assert_close(long[5:, 0, 0], sent()[:-5, 0])


def test_a_robot_without_a_model_or_joints_is_not_fast_and_has_no_load():
    plain = Robot(
        dt=0.01,
        actuators=("m",),
        command_scale=torch.ones(1).double(),
        joints=("a",),
        joint_of_actuator=(0,),
    )
    assert not plain.fast
    assert ActionLag(held=False).on(plain) == ActionLag(held=False)
    assert effect("load_dependent_friction").targets(plain) == ()
    ball = "<body><joint type='ball'/><geom size='.1'/></body>"
    ball = f"<mujoco><worldbody>{ball}</worldbody></mujoco>"
    none = robot_of(Task(model=mujoco.MjModel.from_xml_string(ball), frame_skip=1))
    assert not none.fast
    assert none.passive.tolist() == []
    assert [b.tolist() for b in effect("load_dependent_friction").bounds(none)] == [[], []]


def test_a_transform_that_is_told_the_robot_knows_its_law_at_once():
    robot = robot_of(known_task("HalfCheetah-v5"))
    assert ApplyEffect(ActionDelay(inside=True), 0.02, robot=robot).effect == DriveDelay()
    assert ApplyEffect(ActionLag(held=False), 0.02, robot=robot).targets == robot.actuators
