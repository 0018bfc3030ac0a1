"""Fetch arms driven by a mocap body: FetchReach, FetchPush, FetchSlide, FetchPickAndPlace (v4).

An action moves the mocap body by 5 cm per unit from where the gripper is; a weld drags the gripper
along. The observation, achieved and desired goal, sparse reward and reset are those of
Gymnasium-Robotics (Plappert et al. 2018, https://arxiv.org/abs/1802.09464).
"""

from __future__ import annotations

__all__ = ["euler", "fetch", "goal_reward", "pick_and_place", "push", "reach", "slide"]

from collections.abc import Callable, Mapping

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..draws import Draws
from ..drive import Drive
from ..task import Readings, Task
from .assets import robotics_model

_FRAME_SKIP = 20
_REACHED = 0.05  # m
_BLOCK = (1.25, 0.53, 0.4, 1.0, 0.0, 0.0, 0.0)
_PUCK = (1.7, 1.1, 0.41, 1.0, 0.0, 0.0, 0.0)
_FINGERS = ("robot0:l_gripper_finger_joint", "robot0:r_gripper_finger_joint")


def fetch(
    scene: str,
    *,
    base: float = 0.405,
    block: tuple[float, ...] | None = _BLOCK,
    lift: float = 0.0,
    locked: bool = True,
    airborne: bool = False,
    goal_offset: float = 0.0,
    object_range: float = 0.15,
    goal_range: float = 0.15,
    dense: bool = False,
) -> Task:
    """Return a Fetch task.

    Args:
        scene: ``reach``, ``push``, ``slide`` or ``pick_and_place``.
        base: Position of the robot along x, in m.
        block: Initial pose of the object, position and quaternion; None for no object.
        lift: Height of the gripper above the table at the start, in m.
        locked: Keep the fingers closed.
        airborne: Put half of the goals above the table (without an object, all).
        goal_offset: Distance of the goals' centre from the gripper along x, in m.
        object_range: Half the side of the square in which the object starts, in m.
        goal_range: Half the side of the square of goals, in m.
        dense: Reward minus the distance instead of -1 until the goal is reached.
    """
    model = robotics_model(f"fetch/{scene}.xml")
    initial, gripper, height = _arrange(model, base, block, lift)
    observe = _observer(model, has_object=block is not None)
    site = model.site("robot0:grip" if block is None else "object0").id

    def reward(_: Readings, after: Readings, action: Tensor) -> Tensor:  # noqa: ARG001
        return goal_reward(after.site_xpos[..., site, :], after.goal, dense=dense)

    def reset(draws: Draws) -> dict[str, NDArray[np.float64]]:
        goal = gripper + draws.uniform(-goal_range, goal_range, size=3)
        if block is None:
            return {"goal": goal}
        goal[:, 0] += goal_offset
        goal[:, 2] = height
        if airborne:
            raised, by = draws.uniform(0.0, 1.0, size=2).T
            goal[:, 2] += np.where(raised < 0.5, 0.45 * by, 0.0)
        away = draws.uniform(
            -object_range,
            object_range,
            size=2,
            accept=lambda offset: np.linalg.norm(offset, axis=1) >= 0.1,
        )
        qpos = np.tile(initial["qpos"], (len(draws), 1))
        start = model.joint("object0:joint").qposadr[0]
        qpos[:, start : start + 2] = gripper[:2] + away
        return {"qpos": qpos, "goal": goal}

    return Task(
        model=model,
        frame_skip=_FRAME_SKIP,
        outputs=_outputs(has_object=block is not None),
        drive=Drive(
            relative=tuple(range(model.nu)),
            weld="robot0:gripper_link",
            pinned=_FINGERS if locked else (),
        ),
        command=_command(model.nu, locked=locked),
        bounds=(-np.ones(4), np.ones(4)),
        initial=initial,
        observation=observe,
        reward=reward,
        reset=reset,
        max_steps=50,
    )


def reach(*, dense: bool = False) -> Task:
    """FetchReach-v4: bring the gripper to a goal in the air."""
    return fetch("reach", base=0.4049, block=None, lift=0.2, airborne=True, dense=dense)


def push(*, dense: bool = False) -> Task:
    """FetchPush-v4: push a block to a goal on the table, fingers closed."""
    return fetch("push", dense=dense)


def slide(*, dense: bool = False) -> Task:
    """FetchSlide-v4: hit a puck so that it stops at a goal out of reach."""
    return fetch(
        "slide",
        base=0.05,
        block=_PUCK,
        lift=-0.02,
        goal_offset=0.4,
        object_range=0.1,
        goal_range=0.3,
        dense=dense,
    )


def pick_and_place(*, dense: bool = False) -> Task:
    """FetchPickAndPlace-v4: bring a block to a goal on the table or in the air."""
    return fetch("pick_and_place", lift=0.2, locked=False, airborne=True, dense=dense)


def goal_reward(achieved: Tensor, desired: Tensor, *, dense: bool = False) -> Tensor:
    """Return -1 until the goal is reached within 5 cm, then 0; ``(*, 3), (*, 3) -> (*,)``.

    With ``dense``, minus the distance in m. For hindsight, which asks what another goal would
    have earned.
    """
    distance = (achieved - desired).norm(dim=-1)
    missed = ~(distance <= _REACHED)  # so is a goal that is not a number
    return -distance if dense else -missed.to(distance.dtype)


def euler(matrix: Tensor) -> Tensor:
    """Return the XYZ Euler angles of rotation matrices, ``(*, 3, 3) -> (*, 3)``, in radians."""
    m = [row.unbind(-1) for row in matrix.unbind(-2)]
    cosine = (m[2][2].square() + m[1][2].square()).sqrt()
    regular = cosine > 4.0 * torch.finfo(torch.float64).eps
    z = torch.where(regular, -torch.atan2(m[0][1], m[0][0]), -torch.atan2(-m[1][0], m[1][1]))
    y = -torch.atan2(-m[0][2], cosine)
    x = torch.where(regular, -torch.atan2(m[1][2], m[2][2]), 0.0)
    return torch.stack([x, y, z], -1)


def _outputs(*, has_object: bool) -> tuple[str, ...]:
    outputs = ("qpos", "qvel", "site_xpos", "site_xmat", "site_velocity[robot0:grip]")
    return (*outputs, "site_velocity[object0]") if has_object else outputs


def _observer(
    model: mujoco.MjModel, *, has_object: bool
) -> Callable[[Readings], dict[str, Tensor]]:
    """Return the observation and goals as a function; velocities are per control step."""
    robot = [j for j in range(model.njnt) if model.joint(j).name.startswith("robot")]
    fingers, finger_speeds = (a[robot[-2:]] for a in (model.jnt_qposadr, model.jnt_dofadr))
    hand = model.site("robot0:grip").id
    site = model.site("object0").id if has_object else hand

    def observe(now: Readings) -> dict[str, Tensor]:
        read, dt = vars(now), now.dt[..., None]
        grip = now.site_xpos[..., hand, :]
        place = now.site_xpos[..., site, :]
        width = now.qpos[..., fingers]
        grip_speed = read["site_velocity[robot0:grip]"][..., :3] * dt
        parts = [grip, width, grip_speed]
        if has_object:
            angles = euler(now.site_xmat[..., site, :].unflatten(-1, (3, 3)))
            linear, angular = (read["site_velocity[object0]"] * dt).split(3, -1)
            parts = [grip, place, place - grip, width, angles, linear - grip_speed, angular]
            parts.append(grip_speed)
        parts.append(now.qvel[..., finger_speeds] * dt)
        return {
            "observation": torch.cat(parts, -1),
            "achieved_goal": place,
            "desired_goal": now.goal.expand_as(place),
        }

    return observe


def _command(nu: int, *, locked: bool) -> Callable[[Tensor], Tensor]:
    """Return ``action (*, 4) -> (finger targets, step of the mocap position, of its quaternion)``.

    The quaternion's step keeps the gripper pointing down; MuJoCo normalises the sum.
    """

    def command(action: Tensor) -> Tensor:
        action = action.clamp(-1.0, 1.0)
        fingers = action[..., 3:].expand(*action.shape[:-1], nu)
        fingers = torch.zeros_like(fingers) if locked else fingers
        turn = action.new_tensor([1.0, 0.0, 1.0, 0.0]).expand(*action.shape[:-1], 4)
        return torch.cat([fingers, action[..., :3] * 0.05, turn], -1)

    return command


def _arrange(
    model: mujoco.MjModel, base: float, block: tuple[float, ...] | None, lift: float
) -> tuple[Mapping[str, NDArray[np.float64]], NDArray[np.float64], float]:
    """Free the welds' offsets and move the gripper above the table, as the original does.

    Returns:
        The state at the start of an episode, the gripper's position, and the object's height.
    """
    data = mujoco.MjData(model)
    joints = {"robot0:slide0": base, "robot0:slide1": 0.48, "robot0:slide2": 0.0}
    for name, value in joints.items():
        data.joint(name).qpos[:] = value
    if block is not None:
        data.joint("object0:joint").qpos[:] = block
    welds = model.eq_type == mujoco.mjtEq.mjEQ_WELD
    model.eq_data[welds, :7] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    mujoco.mj_forward(model, data)
    target = np.array([-0.498, 0.005, -0.431 + lift]) + data.site("robot0:grip").xpos
    data.mocap_pos[0] = target
    data.mocap_quat[0] = (1.0, 0.0, 1.0, 0.0)
    mujoco.mj_step(model, data, nstep=10 * _FRAME_SKIP)
    state = {"time": np.array([data.time]), "qpos": data.qpos.copy(), "qvel": data.qvel.copy()}
    height = 0.0 if block is None else float(data.site("object0").xpos[2])
    return state, data.site("robot0:grip").xpos.copy(), height
