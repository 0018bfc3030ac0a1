"""What an effect may ask about the robot it acts on: names, places and scales, no simulator.

An effect acts at *targets*: actuators, scalar joints, channels of the observation, or the robot as
a whole. Scales say how large a command, a generalised force or a measured value is on this robot,
so that one catalogue serves arms and legs; they bound the priors of strengths and nothing else.
"""

from __future__ import annotations

__all__ = ["Robot", "robot_of"]

from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np
import torch
from torch import Tensor

from ..envs.task import Task
from ..errors import message

_FAST = 0.25  # of a velocity, that a control step changes
_SLIDE = int(
    mujoco.mjtJoint.mjJNT_SLIDE
)  # slides and hinges have one coordinate, the others several


def _none() -> Tensor:
    return torch.zeros(0, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Robot:
    """Names, places and scales.

    Attributes:
        dt: Seconds per control step.
        actuators: Names of the ``A`` commands: of actuators, or ``action0`` and so on where a task
            makes something else of its actions.
        command_scale: Largest command of each, shape ``(A,)``.
        joints: Names of the ``J`` hinges and slides.
        force_scale: A typical largest generalised force at each joint, N m or N, shape ``(J,)``.
        position_scale: A typical range of each joint's position, rad or m, shape ``(J,)``.
        velocity_scale: A typical largest velocity of each joint, shape ``(J,)``.
        channels: Names of the ``C`` measured values.
        channel_scale: A typical range of each, shape ``(C,)``.
        channel_joint: The joint whose position or velocity a channel measures, -1 for others,
            shape ``(C,)``.
        channel_kind: ``position``, ``velocity`` or ``other``, one per channel.
        joint_of_actuator: The joint that each actuator moves, -1 for others, shape ``(A,)``.
        qpos_index: Where each joint's position is in ``qpos``, shape ``(J,)``.
        dof_index: Where each joint's velocity is in ``qvel``, shape ``(J,)``.
        model: The nominal MuJoCo model, where there is one.
    """

    dt: float
    actuators: tuple[str, ...] = ()
    command_scale: Tensor = field(default_factory=_none)
    joints: tuple[str, ...] = ()
    force_scale: Tensor = field(default_factory=_none)
    position_scale: Tensor = field(default_factory=_none)
    velocity_scale: Tensor = field(default_factory=_none)
    channels: tuple[str, ...] = ()
    channel_scale: Tensor = field(default_factory=_none)
    channel_joint: tuple[int, ...] = ()
    channel_kind: tuple[str, ...] = ()
    joint_of_actuator: tuple[int, ...] = ()
    qpos_index: tuple[int, ...] = ()
    dof_index: tuple[int, ...] = ()
    model: mujoco.MjModel | None = None

    def require_model(self) -> mujoco.MjModel:
        """Return the model.

        Raises:
            ValueError: There is none.
        """
        if self.model is None:
            raise ValueError(message("a robot with a MuJoCo model", "none", hint="robot_of(task)"))
        return self.model

    @cached_property
    def fast(self) -> bool:
        """Whether damping changes a driven joint's velocity much within one control step.

        At the model's initial position: ``Δ d_i (M⁻¹)_ii > 0.25`` for one of them.
        """
        if self.model is None:
            return False
        driven = [self.dof_index[j] for j in self.joint_of_actuator if j >= 0]
        if not driven:
            return False
        data, inertia = mujoco.MjData(self.model), np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_forward(self.model, data)
        mujoco.mj_fullM(self.model, data, inertia)
        rates = self.model.dof_damping * np.diag(np.linalg.inv(inertia))
        return bool(self.dt * rates[driven].max() > _FAST)

    @cached_property
    def passive(self) -> Tensor:
        """Which joints of two moving bodies nothing drives, boolean, shape ``(J,)``.

        Those of a base that moves freely join it to nothing, and mocap bodies may drag any.
        """
        model = self.require_model()
        parents = model.body_parentid[model.dof_bodyid[list(self.dof_index)]]
        undriven = [j not in self.joint_of_actuator for j in range(len(self.joints))]
        moving = (model.body_weldid[parents] != 0) & (model.nmocap == 0)
        return torch.from_numpy(moving) & torch.tensor(undriven, dtype=torch.bool)

    @cached_property
    def actuator_limits(self) -> tuple[Tensor, Tensor, Tensor]:
        """The largest force, the no-load speed and the gear of each actuator, shape ``(A,)``.

        Force and speed in the actuator's own coordinate.
        """
        model = self.require_model()
        gear = torch.from_numpy(model.actuator_gear[:, 0].copy())
        force = torch.from_numpy(model.actuator_gainprm[:, 0]).abs() * self.command_scale
        # a servo is rarely further than a fifth of its range from its target
        force = torch.where(torch.from_numpy(model.actuator_biastype) != 0, 0.2 * force, force)
        limited = torch.from_numpy(model.actuator_forcelimited).bool()
        range_ = torch.from_numpy(model.actuator_forcerange).abs().amax(-1)
        speed = self.velocity_scale[list(self.joint_of_actuator)] * gear.abs()
        return torch.where(limited, range_, force), speed, gear


def robot_of(task: Task) -> Robot:
    """Return the description of a task's robot, with scales from its MuJoCo model.

    Channels are the positions of all joints, then their velocities, by joint name:
    ``hinge position``, ``hinge velocity``.

    Example:
        >>> from torchrl_bayessim.envs.tasks.catalogue import known_task
        >>> robot = robot_of(known_task("InvertedPendulum-v5"))
        >>> robot.joints, robot.actuators
        (('slider', 'hinge'), ('slide',))

    Raises:
        ValueError: The model has no joint.
    """
    model = task.model
    if model.njnt == 0:
        raise ValueError(message("a model with joints", "none", hint="add <joint> to a body"))
    scalar = [j for j in range(model.njnt) if model.jnt_type[j] >= _SLIDE]
    joints = tuple(model.joint(j).name or f"joint{j}" for j in scalar)
    qpos = tuple(int(model.jnt_qposadr[j]) for j in scalar)
    dofs = tuple(int(model.jnt_dofadr[j]) for j in scalar)
    # an action that is not an actuator's is not the force of one joint
    known = task.of_actuators
    moved = [_moved_joint(model, i) if known else -1 for i in range(len(task.action_names))]
    position = torch.tensor([_span(model, j) for j in scalar], dtype=torch.float64)
    velocity = position / 0.25
    return Robot(
        dt=task.dt,
        actuators=task.action_names,
        command_scale=_action_scale(task),
        joints=joints,
        force_scale=_force_scale(model, scalar),
        position_scale=position,
        velocity_scale=velocity,
        channels=tuple(f"{n} position" for n in joints) + tuple(f"{n} velocity" for n in joints),
        channel_scale=torch.cat([position, velocity]),
        channel_joint=tuple(range(len(joints))) * 2,
        channel_kind=("position",) * len(joints) + ("velocity",) * len(joints),
        joint_of_actuator=tuple(scalar.index(j) if j in scalar else -1 for j in moved),
        qpos_index=qpos,
        dof_index=dofs,
        model=model,
    )


def _moved_joint(model: mujoco.MjModel, actuator: int) -> int:
    kinds = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT
    return (
        int(model.actuator_trnid[actuator, 0]) if model.actuator_trntype[actuator] in kinds else -1
    )


def _span(model: mujoco.MjModel, joint: int) -> float:
    """Half the joint's range; without limits a radian, or a metre."""
    if model.jnt_limited[joint]:
        return float(np.clip(np.diff(model.jnt_range[joint])[0] / 2, 0.05, np.pi))
    return 1.0


def _command_scale(model: mujoco.MjModel, actuator: int) -> float:
    if model.actuator_ctrllimited[actuator]:
        return float(np.abs(model.actuator_ctrlrange[actuator]).max())
    return 1.0


def _action_scale(task: Task) -> Tensor:
    largest = np.abs(np.stack(task.action_bounds)).max(0)
    return torch.from_numpy(np.where(np.isfinite(largest), largest, 1.0))


def _force_scale(model: mujoco.MjModel, joints: list[int]) -> Tensor:
    """Return the larger of what actuators and what gravity at full stretch can exert."""
    data = mujoco.MjData(model)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    scale = []
    for j in joints:
        dof = model.jnt_dofadr[j]
        body = model.jnt_bodyid[j]
        mass = model.body_subtreemass[body]
        if model.jnt_type[j] == _SLIDE:
            largest = 0.5 * mass * 9.81
        else:
            # half of m g l with l = sqrt(I / m): the moment of the weight of a compact body
            largest = 0.5 * 9.81 * np.sqrt(max(inertia[dof, dof], 1e-12) * mass)
        for i in range(model.nu):
            if _moved_joint(model, i) == j:
                largest = max(largest, abs(model.actuator_gear[i, 0]) * _actuator_force(model, i))
        scale.append(float(largest))
    return torch.tensor(scale, dtype=torch.float64)


def _actuator_force(model: mujoco.MjModel, actuator: int) -> float:
    if model.actuator_forcelimited[actuator]:
        return float(np.abs(model.actuator_forcerange[actuator]).max())
    gain = abs(float(model.actuator_gainprm[actuator, 0]))
    servo = model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_NONE
    # a servo is rarely further than a fifth of its range from its target
    return gain * _command_scale(model, actuator) * (0.2 if servo else 1.0)
