"""What a transform beside a simulator can learn about the robot, and where it can act."""

from __future__ import annotations

__all__ = ["add_every_time_step", "robot_of_env"]

import copy
from dataclasses import replace
from typing import Any

import mujoco
import torch
from torchrl.envs import EnvBase

from ..effects.robot import Robot, robot_of
from ..envs.additions import Addition, steps_with
from ..envs.mujoco import BatchedMujocoEnv
from ..envs.task import Task
from ..errors import PhysicsError, message
from ..physics.mujoco_models import models_of
from ..physics.protocol import simulator_of


def robot_of_env(env: Any) -> Robot:
    """Return the robot of a simulator, without transforms.

    Of a MuJoCo environment all that its model says; of others the actions, by number, and the
    control step of Gymnasium's classic tasks.

    Raises:
        ValueError: The environment does not say how long a control step is.

    Example:
        >>> from torchrl.envs import GymEnv
        >>> robot_of_env(GymEnv("Pendulum-v1")).dt
        0.05
    """
    if isinstance(env, BatchedMujocoEnv):
        return robot_of(env.task)
    try:
        model = models_of(env).model
    except PhysicsError:
        return _robot_of_specs(env)
    inner = simulator_of(env)
    steps = getattr(inner, "frame_skip", getattr(inner, "n_substeps", None))
    if steps is None and hasattr(inner, "control_timestep"):  # of dm_control
        steps = round(inner.control_timestep() / model.opt.timestep)
    robot = robot_of(Task(model=copy.copy(model), frame_skip=steps or 1))
    size = env.full_action_spec[env.action_key].shape[-1]
    if size == len(robot.actuators):
        return robot
    # it makes something else of its actions, as the Fetch arms do
    return replace(robot, **_actions(env))


def _robot_of_specs(env: EnvBase) -> Robot:
    inner = simulator_of(env)
    dt = getattr(inner, "dt", getattr(inner, "tau", None))
    if dt is None:
        expected = "an environment that says how long a control step is"
        raise ValueError(message(expected, type(inner).__name__, hint="pass robot=Robot(dt=…)"))
    if not env.full_action_spec[env.action_key].dtype.is_floating_point:
        return Robot(dt=float(dt))
    return Robot(dt=float(dt), **_actions(env))


def _actions(env: EnvBase) -> dict[str, Any]:
    """Return names and scales of the numbers in an action, which move no joint that is known."""
    spec = env.full_action_spec[env.action_key]
    size = spec.shape[-1]
    low, high = getattr(spec.space, "low", None), getattr(spec.space, "high", None)
    scale = torch.ones(size, dtype=torch.float64)
    if low is not None and high is not None:
        most = torch.maximum(low.abs(), high.abs()).double().reshape(-1, size)[0]
        scale = torch.where(most.isfinite() & (most < 1e6), most, scale)
    names = tuple(f"action{i}" for i in range(size))
    return {"actuators": names, "command_scale": scale, "joint_of_actuator": (-1,) * size}


def add_every_time_step(env: Any, key: object, addition: Addition) -> None:
    """Call ``addition`` before every time step of a MuJoCo environment.

    For `BatchedMujocoEnv`, ``GymEnv`` of Gymnasium's and Gymnasium-Robotics' tasks, and
    ``DMControlEnv``.

    Raises:
        PhysicsError: It is another environment.
    """
    if isinstance(env, BatchedMujocoEnv):
        env.add(key, addition)
        return
    known: dict[object, Addition] = env.__dict__.setdefault("_additions", {})
    if not known:
        _wrap(simulator_of(env), known)
    known[key] = addition


def _wrap(inner: Any, additions: dict[object, Addition]) -> None:
    """Replace the one method of a simulator that advances time."""
    physics: Any = getattr(inner, "physics", None)

    def gymnasium(ctrl: Any, n_frames: int) -> None:
        inner.data.ctrl[:] = ctrl
        steps_with(inner.model, inner.data, additions.values(), count=n_frames)
        mujoco.mj_rnePostConstraint(inner.model, inner.data)

    def robotics(_: Any) -> None:
        steps_with(inner.model, inner.data, additions.values(), count=inner.n_substeps)

    def control_suite(nstep: int = 1) -> None:
        model, data = physics.model.ptr, physics.data.ptr
        with physics.check_invalid_state():
            steps_with(model, data, additions.values(), count=nstep)
            if physics.legacy_step:  # which keeps what follows from the state up to date
                mujoco.mj_step1(model, data)

    if hasattr(inner, "_step_mujoco_simulation"):
        inner._step_mujoco_simulation = gymnasium
    elif hasattr(inner, "_mujoco_step"):
        inner._mujoco_step = robotics
    elif hasattr(physics, "check_invalid_state"):
        physics.step = control_suite
    else:
        expected = "an environment that is stepped by MuJoCo, for forces at every time step"
        raise PhysicsError(message(expected, type(inner).__name__))
