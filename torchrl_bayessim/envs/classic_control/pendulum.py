"""Pendulum: swing up and hold, by a torque too weak to lift at once.

``θ'' = 3 g / (2 l) sin θ + 3 u / (m l²)`` with ``|u| ≤ 2`` and ``|θ'| ≤ 8``, semi-implicit Euler
with step ``dt``; reward ``−(θ² + 0.1 θ'² + 0.001 u²)`` of the state before the step, θ wrapped to
[−π, π). As in gymnasium's ``Pendulum-v1``.
"""

from __future__ import annotations

__all__ = ["PendulumEnv"]

import math
from typing import ClassVar

import torch
from torch import Tensor
from torchrl.data import Bounded
from torchrl.data.tensor_specs import TensorSpec

from .base import ClassicControlEnv


class PendulumEnv(ClassicControlEnv):
    """``N`` pendulums; parameters g, m, l, dt. Arguments: see `ClassicControlEnv`.

    A torque beyond ±2 N m saturates, as in gymnasium.

    Example:
        >>> env = PendulumEnv(2, max_steps=200)
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([2, 3, 1])
    """

    defaults: ClassVar = {"g": 10.0, "m": 1.0, "l": 1.0, "dt": 0.05}
    positive = frozenset({"m", "l"})
    _state_size = 2
    _observation_size = 3

    def _action_spec(self) -> TensorSpec:
        shape = torch.Size((self.batch_size[0], 1))
        return Bounded(-2.0, 2.0, shape=shape, dtype=self._float, device=self.device)

    def _couple(self) -> None:
        p = self._parameters_now
        self._gravity_gain = 3 * p["g"] / (2 * p["l"])
        self._torque_gain = 3.0 / (p["m"] * p["l"] ** 2)

    def _initial_state(self, uniform: Tensor) -> Tensor:
        return (2 * uniform - 1) * uniform.new_tensor([math.pi, 1.0])

    def _advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        theta, theta_dot = state.unbind(-1)
        dt, u = self._parameters_now["dt"], action.clamp(-2.0, 2.0)
        wrapped = torch.remainder(theta + math.pi, 2 * math.pi) - math.pi
        cost = wrapped.square() + 0.1 * theta_dot.square() + 0.001 * u.square()
        acceleration = self._gravity_gain * theta.sin() + self._torque_gain * u
        theta_dot = (theta_dot + acceleration * dt).clamp(-8.0, 8.0)
        state = torch.stack([theta + theta_dot * dt, theta_dot], -1)
        return state, -cost, torch.zeros_like(cost, dtype=torch.bool)

    def _observe(self, state: Tensor) -> Tensor:
        theta, theta_dot = state.unbind(-1)
        return torch.stack([theta.cos(), theta.sin(), theta_dot], -1)
