"""Which effects have to be asked for others to remember the same."""

import mujoco
import numpy as np
import torch

from torchrl_bayessim.effects.disturbance import ConstantForce
from torchrl_bayessim.effects.forcing import Forcing
from torchrl_bayessim.effects.friction import DirectionalFriction
from torchrl_bayessim.effects.robot import robot_of
from torchrl_bayessim.effects.sequence import forces_in_stages
from torchrl_bayessim.effects.series_elasticity import SeriesElasticity
from torchrl_bayessim.effects.transmission import ServoGain
from torchrl_bayessim.envs.task import Readings, Task

SERVO = """<mujoco><worldbody><body><joint name="a" axis="0 0 1"/>
  <inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/></body></worldbody>
  <actuator><position joint="a" kp="5" ctrlrange="-2 2"/></actuator></mujoco>"""
STRENGTHS = {ServoGain(): 0.4, SeriesElasticity(): 0.02}
OTHERS = {ConstantForce(): 0.3, DirectionalFriction(): 0.2}


def state(step):
    rng = np.random.default_rng(step)
    drawn = {name: torch.from_numpy(rng.normal(size=1)) for name in ("qpos", "qvel", "ctrl")}
    return Readings(**drawn, time=torch.zeros(1).double(), qfrc_bias=torch.zeros(1).double())


def remembered(forcing, active, steps=6):
    memories = forcing.start(active, state(0))
    for step in range(steps):
        _, memories = forcing(active, memories, state(step))
    return memories


def test_memories_are_the_same_with_those_alone_that_last():
    forcing = Forcing(robot_of(Task(model=mujoco.MjModel.from_xml_string(SERVO), frame_skip=1)))
    strengths = {**STRENGTHS, **OTHERS}
    effects = forces_in_stages(strengths)
    active = [(one, torch.tensor([strengths[one]]).double()) for one in effects]
    kept = forcing.lasting(active, forcing.start(active, state(0)), state(0))
    assert {effects[i] for i in kept} == set(STRENGTHS)
    every = remembered(forcing, active)
    alone = remembered(forcing, [active[i] for i in kept])
    for i, memory in zip(kept, alone, strict=True):
        assert {n: v.tolist() for n, v in memory.items()} == {
            n: v.tolist() for n, v in every[i].items()
        }
    # what a gain does to commands is in what the spring remembers
    spring = [i for i in kept if active[i][0] == SeriesElasticity()]
    ungained = remembered(forcing, [active[i] for i in spring])
    assert ungained[0]["load"].tolist() != every[spring[0]]["load"].tolist()
