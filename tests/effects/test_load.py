"""Friction under load: which joints have one, and what a passive joint and a driven one lose."""

import math

import mujoco
import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.forcing import Forcing
from torchrl_bayessim.effects.robot import robot_of
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.task import Readings, Task
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.transforms.apply_effect import ApplyEffect

NAME = "load_dependent_friction"
# a weight of 2 kg at 0.5 m, turned by a motor: m g l = 9.81 N m
CRANE = """
<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
<joint name="boom" axis="0 -1 0"/><geom type="sphere" size=".01" pos=".5 0 0" mass="2"/>
</body></worldbody><actuator><motor joint="boom"/></actuator></mujoco>
"""


def friction(robot, strength, *, bias, ctrl, **options):
    law = effect(NAME, **options)
    size = robot.require_model().nv
    state = Readings(
        qpos=torch.zeros(size).double(),
        qvel=torch.zeros(size).double(),
        ctrl=torch.tensor(ctrl).double(),
        time=torch.zeros(1).double(),
        **({} if bias is None else {"qfrc_bias": torch.tensor(bias).double()}),
    )
    active = [(law, torch.tensor(strength).double())]
    forcing = Forcing(robot)
    (added, _) = forcing(active, forcing.start(active, state), state)
    return added["dof_frictionloss"].tolist()


def test_a_load_is_the_actuators_force_or_that_minus_the_force_from_outside():
    robot = robot_of(known_task("InvertedPendulum-v5"))  # gear 100 at the slider
    assert robot.passive.tolist() == [False, True]
    both = pytest.approx([0.1 * 50.0, 0.2 * 3.0])
    assert friction(robot, [0.1, 0.2], bias=[-8.0, -3.0], ctrl=[0.5]) == both
    outside = friction(robot, [0.1, 0.2], bias=[-8.0, -3.0], ctrl=[0.5], external=True)
    assert outside == pytest.approx([0.1 * 42.0, 0.2 * 3.0])
    # where only what a motor drives rubs, nobody asks for the force from outside
    assert friction(robot, [0.1, 0.0], bias=None, ctrl=[0.5]) == pytest.approx([5.0, 0.0])
    with pytest.raises(AttributeError, match="something that the task reads, got 'qfrc_bias'"):
        friction(robot, [0.1, 0.0], bias=None, ctrl=[0.5], external=True)


@pytest.mark.parametrize(
    ("task", "loaded"),
    [
        ("InvertedPendulum-v5", ("slider", "hinge")),
        ("Hopper-v5", ("thigh_joint", "leg_joint", "foot_joint")),  # not a torso that flies
        ("FetchPush-v4", ()),  # nor what a mocap body drags
    ],
)
def test_joints_of_two_bodies_have_a_load_and_a_free_base_has_none(task, loaded):
    robot = robot_of(known_task(task))
    for external in (False, True):
        low, high = effect(NAME, external=external).bounds(robot)
        assert not low.any()
        names = [n for n, most in zip(robot.joints, high.tolist(), strict=True) if most == 0.4]
        # at a joint without an actuator both forms are the same, which is offered once
        both = tuple(n for n in loaded if not (external and n == "hinge"))
        assert tuple(names) == both


@pytest.mark.parametrize(("external", "torque"), [(False, 9.81 / 0.8), (True, 9.81 * 1.2 / 0.8)])
def test_a_crane_lifts_from_a_torque_on_that_overcomes_its_own_friction(external, torque):
    """It begins to lift at τ = m g l + s F, with F = τ, or τ + m g l: friction that jams."""
    task = Task(
        model=mujoco.MjModel.from_xml_string(CRANE),
        frame_skip=10,
        bounds=(-torch.full((1,), 99.0), torch.full((1,), 99.0)),
    )
    for share, lifts in ((0.9, False), (1.1, True)):
        law = ApplyEffect(effect(NAME, external=external), strength=0.2)
        env = BatchedMujocoEnv(task, 1, threads=1).append_transform(law)
        now = env.reset()
        for _ in range(20):
            action = torch.full((1, 1), share * torque).double()
            now = env.step(now.update(TensorDict({"action": action}, [1])))["next"]
        angle = float(now["observation"][0, 0])
        assert (angle > 0.01) == lifts
        assert angle > -math.radians(0.5)  # held, but for what a soft constraint lets through
