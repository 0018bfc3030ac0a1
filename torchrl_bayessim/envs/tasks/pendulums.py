"""Poles on a cart: InvertedPendulum and InvertedDoublePendulum (v5).

Formulas and constants are Gymnasium's (https://gymnasium.farama.org/environments/mujoco/).
"""

from __future__ import annotations

__all__ = ["inverted_double_pendulum", "inverted_pendulum"]

import torch
from torch import Tensor

from ..task import Readings, Task, uniform_reset
from .assets import gymnasium_model


def inverted_pendulum() -> Task:
    """InvertedPendulum-v5: keep a pole within 0.2 rad of upright; one point per step."""
    model = gymnasium_model("inverted_pendulum.xml")

    def fallen(now: Readings) -> Tensor:
        return now.qpos[..., 1].abs() > 0.2

    return Task(
        model=model,
        frame_skip=2,
        observation=lambda now: torch.cat([now.qpos, now.qvel], -1),
        reward=lambda before, after, action: (~fallen(after)).double(),  # noqa: ARG005
        termination=fallen,
        reset=uniform_reset(model, 0.01),
        max_steps=1000,
    )


def inverted_double_pendulum() -> Task:
    """InvertedDoublePendulum-v5: keep the tip of two poles above one metre."""
    model = gymnasium_model("inverted_double_pendulum.xml")

    def fallen(now: Readings) -> Tensor:
        return now.site_xpos[..., 0, 2] <= 1.0

    def observation(now: Readings) -> Tensor:
        angles = now.qpos[..., 1:]
        return torch.cat(
            [
                now.qpos[..., :1],
                angles.sin(),
                angles.cos(),
                now.qvel.clamp(-10.0, 10.0),
                now.qfrc_constraint[..., :1].clamp(-10.0, 10.0),
            ],
            -1,
        )

    def reward(_: Readings, after: Readings, action: Tensor) -> Tensor:  # noqa: ARG001
        x, y = after.site_xpos[..., 0, 0], after.site_xpos[..., 0, 2]
        distance = 0.01 * x.square() + (y - 2.0).square()
        speed = 1e-3 * after.qvel[..., 1].square() + 5e-3 * after.qvel[..., 2].square()
        return 10.0 * ~fallen(after) - distance - speed

    return Task(
        model=model,
        frame_skip=5,
        outputs=("qpos", "qvel", "site_xpos", "qfrc_constraint"),
        observation=observation,
        reward=reward,
        termination=fallen,
        reset=uniform_reset(model, 0.1, velocity="normal"),
        max_steps=1000,
    )
