"""Bodies that walk, swim or hop: Swimmer, Hopper, Walker2d, HalfCheetah, Ant, Humanoid (v5).

The reward is forward speed, a bonus for being upright, and costs of control and contact; formulas
and constants are Gymnasium's (https://gymnasium.farama.org/environments/mujoco/).
"""

from __future__ import annotations

__all__ = ["ant", "half_cheetah", "hopper", "humanoid", "swimmer", "walker2d"]

from collections.abc import Callable

import mujoco
import torch
from torch import Tensor

from ..drive import Drive
from ..task import Readings, Task, uniform_reset
from .assets import gymnasium_model


def _forward_reward(
    control_cost: float, bonus: Callable[[Readings], Tensor] | float
) -> Callable[[Readings, Readings, Tensor], Tensor]:
    """Return ``ẋ + bonus - c ‖a‖²`` with ẋ the finite difference over a control step."""

    def reward(before: Readings, after: Readings, action: Tensor) -> Tensor:
        speed = (after.qpos[..., 0] - before.qpos[..., 0]) / after.dt
        extra = bonus(after) if callable(bonus) else bonus
        return speed + extra - control_cost * action.square().sum(-1)

    return reward


def _inside(value: Tensor, low: float, high: float) -> Tensor:
    return (value > low) & (value < high)


def _planar_observation(now: Readings) -> Tensor:
    return torch.cat([now.qpos[..., 1:], now.qvel.clamp(-10.0, 10.0)], -1)


def _legged(model: mujoco.MjModel, healthy: Callable[[Readings], Tensor]) -> Task:
    """Return the task of legs in the plane that run until they are not healthy."""
    return Task(
        model=model,
        frame_skip=4,
        observation=_planar_observation,
        reward=_forward_reward(1e-3, healthy),
        termination=lambda now: ~healthy(now),
        reset=uniform_reset(model, 5e-3),
        max_steps=1000,
    )


def hopper() -> Task:
    """Hopper-v5: one leg in the plane, hopping forward without falling."""
    model = gymnasium_model("hopper.xml")

    def healthy(now: Readings) -> Tensor:
        rest = torch.cat([now.qpos[..., 2:], now.qvel], -1).abs() < 100.0
        upright = _inside(now.qpos[..., 2], -0.2, 0.2)
        return rest.all(-1) & upright & (now.qpos[..., 1] > 0.7)

    return _legged(model, healthy)


def walker2d() -> Task:
    """Walker2d-v5: two legs in the plane, walking without falling."""
    model = gymnasium_model("walker2d_v5.xml")

    def healthy(now: Readings) -> Tensor:
        upright = _inside(now.qpos[..., 2], -1.0, 1.0)
        return upright & _inside(now.qpos[..., 1], 0.8, 2.0)

    return _legged(model, healthy)


def half_cheetah() -> Task:
    """HalfCheetah-v5: two legs and a spine in the plane, running; it cannot fall."""
    model = gymnasium_model("half_cheetah.xml")
    return Task(
        model=model,
        frame_skip=5,
        observation=lambda now: torch.cat([now.qpos[..., 1:], now.qvel], -1),
        reward=_forward_reward(0.1, 0.0),
        reset=uniform_reset(model, 0.1, velocity="normal"),
        max_steps=1000,
    )


def swimmer() -> Task:
    """Swimmer-v5: three links in a viscous fluid."""
    model = gymnasium_model("swimmer.xml")
    return Task(
        model=model,
        frame_skip=4,
        observation=lambda now: torch.cat([now.qpos[..., 2:], now.qvel], -1),
        reward=_forward_reward(1e-4, 0.0),
        reset=uniform_reset(model, 0.1),
        max_steps=1000,
    )


def ant() -> Task:
    """Ant-v5: four legs; contact forces are observed, clipped to [-1, 1], and cost."""
    model = gymnasium_model("ant.xml")

    def healthy(now: Readings) -> Tensor:
        height = now.qpos[..., 2]
        return (height >= 0.2) & (height <= 1.0)

    def observation(now: Readings) -> Tensor:
        forces = now.cfrc_ext[..., 1:, :].clamp(-1.0, 1.0).flatten(-2)
        return torch.cat([now.qpos[..., 2:], now.qvel, forces], -1)

    def reward(before: Readings, after: Readings, action: Tensor) -> Tensor:
        speed = (after.xpos[..., 1, 0] - before.xpos[..., 1, 0]) / after.dt
        contact = after.cfrc_ext.clamp(-1.0, 1.0).square().sum((-2, -1))
        return speed + healthy(after) - 0.5 * action.square().sum(-1) - 5e-4 * contact

    return Task(
        model=model,
        frame_skip=5,
        outputs=("qpos", "qvel", "xpos", "cfrc_ext"),
        drive=Drive(contact_forces=True),
        observation=observation,
        reward=reward,
        termination=lambda now: ~healthy(now),
        reset=uniform_reset(model, 0.1, velocity="normal"),
        max_steps=1000,
    )


def humanoid() -> Task:
    """Humanoid-v5: it observes inertias, velocities and forces of its bodies too."""
    model = gymnasium_model("humanoid.xml")

    def healthy(now: Readings) -> Tensor:
        return _inside(now.qpos[..., 2], 1.0, 2.0)

    def observation(now: Readings) -> Tensor:
        bodies = [now.cinert, now.cvel]
        return torch.cat(
            [
                now.qpos[..., 2:],
                now.qvel,
                *(body[..., 1:, :].flatten(-2) for body in bodies),
                now.qfrc_actuator[..., 6:],
                now.cfrc_ext[..., 1:, :].flatten(-2),
            ],
            -1,
        )

    def reward(before: Readings, after: Readings, action: Tensor) -> Tensor:
        speed = (after.subtree_com[..., 0, 0] - before.subtree_com[..., 0, 0]) / after.dt
        contact = (5e-7 * after.cfrc_ext.square().sum((-2, -1))).clamp(max=10.0)
        return 1.25 * speed + 5.0 * healthy(after) - 0.1 * action.square().sum(-1) - contact

    return Task(
        model=model,
        frame_skip=5,
        outputs=("qpos", "qvel", "subtree_com", "cinert", "cvel", "qfrc_actuator", "cfrc_ext"),
        drive=Drive(contact_forces=True),
        observation=observation,
        reward=reward,
        termination=lambda now: ~healthy(now),
        reset=uniform_reset(model, 1e-2),
        max_steps=1000,
    )
