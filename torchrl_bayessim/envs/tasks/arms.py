"""Arms that reach and push: Reacher and Pusher (v5).

Formulas and constants are Gymnasium's (https://gymnasium.farama.org/environments/mujoco/).
"""

from __future__ import annotations

__all__ = ["pusher", "reacher"]

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..draws import Draws
from ..task import Readings, Task
from .assets import gymnasium_model


def reacher() -> Task:
    """Reacher-v5: bring the tip of a two-link arm to a target in the plane."""
    model = gymnasium_model("reacher.xml")
    tip, target = model.body("fingertip").id, model.body("target").id

    def offset(now: Readings) -> Tensor:
        return now.xpos[..., tip, :] - now.xpos[..., target, :]

    def observation(now: Readings) -> Tensor:
        angles = now.qpos[..., :2]
        parts = [angles.cos(), angles.sin(), now.qpos[..., 2:], now.qvel[..., :2]]
        return torch.cat([*parts, offset(now)[..., :2]], -1)

    def reset(draws: Draws) -> dict[str, NDArray[np.float64]]:
        qpos = model.qpos0 + draws.uniform(-0.1, 0.1, size=model.nq)
        qpos[:, -2:] = draws.uniform(
            -0.2, 0.2, size=2, accept=lambda goal: np.linalg.norm(goal, axis=1) < 0.2
        )
        qvel = draws.uniform(-0.005, 0.005, size=model.nv)
        qvel[:, -2:] = 0.0
        return {"qpos": qpos, "qvel": qvel}

    return Task(
        model=model,
        frame_skip=2,
        outputs=("qpos", "qvel", "xpos"),
        observation=observation,
        reward=lambda _, after, action: -offset(after).norm(dim=-1) - action.square().sum(-1),
        reset=reset,
        max_steps=50,
    )


def pusher() -> Task:
    """Pusher-v5: a seven-joint arm pushes a cylinder to a goal on the table."""
    model = gymnasium_model("pusher_v5.xml")
    tip, cylinder, goal = (model.body(name).id for name in ("tips_arm", "object", "goal"))

    def observation(now: Readings) -> Tensor:
        bodies = [now.xpos[..., body, :] for body in (tip, cylinder, goal)]
        return torch.cat([now.qpos[..., :7], now.qvel[..., :7], *bodies], -1)

    def reward(_: Readings, after: Readings, action: Tensor) -> Tensor:
        place = after.xpos
        near = (place[..., cylinder, :] - place[..., tip, :]).norm(dim=-1)
        far = (place[..., cylinder, :] - place[..., goal, :]).norm(dim=-1)
        return -far - 0.1 * action.square().sum(-1) - 0.5 * near

    def reset(draws: Draws) -> dict[str, NDArray[np.float64]]:
        qpos = np.tile(model.qpos0, (len(draws), 1))
        qpos[:, -4:-2] = draws.uniform(
            np.array([-0.3, -0.2]),
            np.array([0.0, 0.2]),
            size=2,
            accept=lambda place: np.linalg.norm(place, axis=1) > 0.17,
        )
        qpos[:, -2:] = 0.0
        qvel = draws.uniform(-0.005, 0.005, size=model.nv)
        qvel[:, -4:] = 0.0
        return {"qpos": qpos, "qvel": qvel}

    return Task(
        model=model,
        frame_skip=5,
        outputs=("qpos", "qvel", "xpos"),
        observation=observation,
        reward=reward,
        reset=reset,
        max_steps=100,
    )
