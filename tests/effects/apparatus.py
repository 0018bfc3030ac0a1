"""A robot that every effect of the catalogue can act on, and one way to see what each does."""

import mujoco
import numpy as np
import torch

from torchrl_bayessim.effects.effect import ActionEffect, ForceEffect, ModelEffect
from torchrl_bayessim.effects.fields import ModelFields
from torchrl_bayessim.effects.forcing import Forcing
from torchrl_bayessim.effects.robot import robot_of
from torchrl_bayessim.effects.sequence import command_sequence, measured_sequence
from torchrl_bayessim.envs.stepper import Stepper
from torchrl_bayessim.envs.task import Readings, Task

ARM = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 -1.6"/>
    <body name="upper" pos="0 0 0">
      <joint name="shoulder" axis="0 1 0" damping="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".04"/>
      <body name="lower" pos="0 0 -.5">
        <joint name="elbow" axis="0 1 0" range="-2 2" limited="true" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/>
      </body>
    </body>
    <body name="sledge" pos="1 0 -1.55">
      <joint name="rail" type="slide" axis="1 0 0"/>
      <joint name="lift" type="slide" axis="0 0 1"/>
      <geom name="block" type="box" size=".1 .1 .052"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="turn" joint="shoulder" gear="2" ctrlrange="-2 2" ctrllimited="true"/>
    <position name="bend" joint="elbow" kp="5" ctrlrange="-2 2" ctrllimited="true"/>
    <motor name="push" joint="rail" gear="-1" ctrlrange="-40 40" ctrllimited="true"/>
  </actuator>
</mujoco>
"""
STEPS = 60


def arm_task():
    return Task(model=mujoco.MjModel.from_xml_string(ARM), frame_skip=5)


def arm():
    return robot_of(arm_task())


def commands(steps=STEPS):
    """Return commands that reverse, rest and pass the limits of no actuator."""
    t = torch.arange(steps, dtype=torch.float64)[:, None] * 0.01
    phase = torch.tensor([0.3, 1.1, 2.0], dtype=torch.float64)
    return torch.tensor([1.9, 0.7, 39.0], dtype=torch.float64) * torch.sin(12 * t + phase)


def seen(effect, strength, robot, *, seed=0):
    """Return what follows from strengths of shape (P, N): commands, values, or positions."""
    if isinstance(effect, ActionEffect):
        return command_sequence(effect, commands(), strength, robot, seed=seed)
    if isinstance(effect, ForceEffect):
        return pushed(effect, strength, robot)
    if isinstance(effect, ModelEffect):
        return rebuilt(effect, strength, robot)
    return measured_sequence(effect, values(robot), strength, robot, seed=seed)


def values(robot):
    t = torch.arange(STEPS, dtype=torch.float64)[:, None] * 0.01
    return torch.sin(9 * t + torch.arange(len(robot.channels)))


def simulated(robot):
    """Return positions and velocities without any effect, from plain MuJoCo."""
    data, record = mujoco.MjData(robot.model), []
    for command in commands():
        data.ctrl[:] = command
        mujoco.mj_step(robot.model, data, nstep=5)
        record.append(torch.from_numpy(np.concatenate([data.qpos, data.qvel])))
    return torch.stack(record)


def driven(model, robot, active, commands):
    """Yield the data after each time step of plain MuJoCo, with force effects as of a robot."""
    forcing, data, memories = Forcing(robot), mujoco.MjData(model), None
    friction, damping = model.dof_frictionloss.copy(), model.dof_damping.copy()
    for command in torch.as_tensor(commands):
        state = Readings(
            qpos=torch.from_numpy(data.qpos.copy()),
            qvel=torch.from_numpy(data.qvel.copy()),
            ctrl=command,
            time=torch.tensor([data.time]).double(),
        )
        memories = forcing.start(active, state) if memories is None else memories
        added, memories = forcing(active, memories, state)
        data.ctrl[:] = command + added.get("ctrl", 0.0)
        data.qfrc_applied[:] = added.get("qfrc_applied", torch.zeros(model.nv))
        model.dof_frictionloss[:] = friction + np.asarray(added.get("dof_frictionloss", 0.0))
        model.dof_damping[:] = damping + np.asarray(added.get("dof_damping", 0.0))
        mujoco.mj_step(model, data)
        yield data


def pushed(effect, strength, robot):
    """Simulate with a force effect in plain MuJoCo."""
    rows, each = [], commands().repeat_interleave(5, 0)
    for one in strength:
        model = mujoco.MjModel.from_xml_string(ARM)
        states = [
            torch.from_numpy(np.concatenate([data.qpos, data.qvel]))
            for data in driven(model, robot, [(effect, one)], each)
        ]
        rows.append(torch.stack(states[4::5]))
    return torch.stack(rows)


def rebuilt(effect, strength, robot):
    """Simulate with a model effect, all strengths at once."""
    stepper = Stepper(robot.model, len(strength), threads=1)
    fields = ModelFields(stepper.models)
    effect.write(fields, strength, robot)
    fields.finish()
    some = commands().numpy()[None].repeat(len(strength), 0)
    return torch.from_numpy(stepper.rollout(some, substeps=5))
