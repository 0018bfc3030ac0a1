"""CartPole: balance a pole on a cart that is pushed left or right.

With half length ``l``, masses ``m`` (pole) and ``M = m + masscart``, and the force ``F``::

    temp    = (F + m l θ'² sin θ) / M
    θ''     = (g sin θ − cos θ temp) / (l (4/3 − m cos² θ / M))
    x''     = temp − m l θ'' cos θ / M

integrated by explicit Euler, as in gymnasium's ``CartPole-v1`` (Barto, Sutton & Anderson, 1983;
equations after Florian, 2007).
"""

from __future__ import annotations

__all__ = ["CartPoleEnv"]

import math
from typing import Any, ClassVar

import torch
from torch import Tensor
from torchrl.data.tensor_specs import TensorSpec

from .base import ClassicControlEnv, discrete


class CartPoleEnv(ClassicControlEnv):
    """``N`` cart-poles; parameters gravity, masscart, masspole, length, force_mag, tau.

    ``length`` is half the pole's length, as in gymnasium; the total mass follows the masses.

    Args:
        num_envs: Number of environments ``N``.
        categorical_action_encoding: Actions as indices ``(N,)`` instead of one-hot ``(N, 2)``.
        **options: ``seed``, ``max_steps``, ``dtype``, ``device``: see `ClassicControlEnv`.

    Example:
        >>> env = CartPoleEnv(3, max_steps=500)
        >>> heavy = torch.tensor([True, False, False])
        >>> env.set_parameters({"masspole": torch.full((3,), 0.7)}, heavy)
        >>> env.parameters["masspole"]
        tensor([0.7000, 0.1000, 0.1000])
        >>> env.rollout(5)["observation"].shape
        torch.Size([3, 5, 4])
    """

    defaults: ClassVar = {
        "gravity": 9.8,
        "masscart": 1.0,
        "masspole": 0.1,
        "length": 0.5,
        "force_mag": 10.0,
        "tau": 0.02,
    }
    positive = frozenset({"masscart", "masspole", "length"})
    _state_size = _observation_size = 4
    _theta_limit = 12 * 2 * math.pi / 360
    _x_limit = 2.4

    def __init__(
        self, num_envs: int, *, categorical_action_encoding: bool = False, **options: Any
    ) -> None:
        self._categorical = categorical_action_encoding
        super().__init__(num_envs, **options)

    def _action_spec(self) -> TensorSpec:
        n = self.batch_size[0]
        return discrete(2, n, categorical=self._categorical, device=self.device)

    def _couple(self) -> None:
        p = self._parameters_now
        self._total_mass = p["masspole"] + p["masscart"]
        self._polemass_length = p["masspole"] * p["length"]

    def _initial_state(self, uniform: Tensor) -> Tensor:
        return uniform * 0.1 - 0.05

    def _advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        p, total, ml = self._parameters_now, self._total_mass, self._polemass_length
        x, x_dot, theta, theta_dot = state.unbind(-1)
        force = torch.where(action == 1, p["force_mag"], -p["force_mag"])
        cos, sin = theta.cos(), theta.sin()
        temp = (force + ml * theta_dot.square() * sin) / total
        theta_acc = (p["gravity"] * sin - cos * temp) / (
            p["length"] * (4.0 / 3.0 - p["masspole"] * cos.square() / total)
        )
        x_acc = temp - ml * theta_acc * cos / total
        velocity = torch.stack([x_dot, x_acc, theta_dot, theta_acc], -1)
        state = state + p["tau"][:, None] * velocity
        terminated = (state[:, 0].abs() > self._x_limit) | (state[:, 2].abs() > self._theta_limit)
        return state, torch.ones_like(x), terminated

    def _observe(self, state: Tensor) -> Tensor:
        return state.clone()
