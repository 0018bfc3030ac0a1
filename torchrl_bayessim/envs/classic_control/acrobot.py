"""Acrobot: swing the tip of a two-link arm over the bar by a torque between the links.

The equations of motion of Sutton & Barto (2018, section 11.3 of the first edition; "book" in
gymnasium's ``Acrobot-v1``), integrated by one Runge-Kutta step of order 4 over 0.2 s with the
torque held.

Gymnasium's centres of mass and moments of inertia are parameters of their own: there, changing
a link's length moves neither, and ``LINK_LENGTH_2`` changes nothing at all. With
``coupled=True`` the links are uniform rods instead: centre of mass at ``l_i / 2`` and inertia
``m_i l_i² / 12``.
"""

from __future__ import annotations

__all__ = ["AcrobotEnv"]

import math
from typing import Any

import torch
from torch import Tensor
from torchrl.data.tensor_specs import TensorSpec

from .base import ClassicControlEnv, discrete


class AcrobotEnv(ClassicControlEnv):
    """``N`` acrobots; parameters LINK_LENGTH_1/2, LINK_MASS_1/2, LINK_COM_POS_1/2, LINK_MOI.

    Args:
        num_envs: Number of environments ``N``.
        coupled: Whether centres of mass and inertias follow lengths and masses, as in uniform
            rods. Then only lengths and masses are parameters.
        categorical_action_encoding: Actions as indices ``(N,)`` instead of one-hot ``(N, 3)``.
        **options: ``seed``, ``max_steps``, ``dtype``, ``device``: see `ClassicControlEnv`.

    Example:
        >>> sorted(AcrobotEnv(2, coupled=True).parameters)
        ['LINK_LENGTH_1', 'LINK_LENGTH_2', 'LINK_MASS_1', 'LINK_MASS_2']
    """

    positive = frozenset({"LINK_MASS_1", "LINK_MASS_2", "LINK_LENGTH_1", "LINK_LENGTH_2"})
    _state_size = 4
    _observation_size = 6
    _dt, _gravity = 0.2, 9.8
    _speed_limits = (4 * math.pi, 9 * math.pi)

    def __init__(
        self,
        num_envs: int,
        *,
        coupled: bool = False,
        categorical_action_encoding: bool = False,
        **options: Any,
    ) -> None:
        self.coupled = coupled
        self._categorical = categorical_action_encoding
        names = ["LINK_LENGTH_1", "LINK_LENGTH_2", "LINK_MASS_1", "LINK_MASS_2"]
        self.defaults = dict.fromkeys(names, 1.0)
        if not coupled:
            self.defaults |= {"LINK_COM_POS_1": 0.5, "LINK_COM_POS_2": 0.5, "LINK_MOI": 1.0}
        super().__init__(num_envs, **options)

    def _action_spec(self) -> TensorSpec:
        n = self.batch_size[0]
        return discrete(3, n, categorical=self._categorical, device=self.device)

    def _couple(self) -> None:
        p = self._parameters_now
        l1, l2, m1, m2 = (
            p[f"LINK_{name}"] for name in ("LENGTH_1", "LENGTH_2", "MASS_1", "MASS_2")
        )
        if self.coupled:
            c1, c2 = l1 / 2, l2 / 2
            inertia_1, inertia_2 = m1 * l1.square() / 12, m2 * l2.square() / 12
        else:
            c1, c2 = p["LINK_COM_POS_1"], p["LINK_COM_POS_2"]
            inertia_1 = inertia_2 = p["LINK_MOI"]
        self._coupling = m2 * l1 * c2
        self._inertia_2 = m2 * c2.square() + inertia_2
        self._inertia_1 = m1 * c1.square() + m2 * l1.square() + inertia_1 + self._inertia_2
        self._weight_1 = (m1 * c1 + m2 * l1) * self._gravity
        self._weight_2 = m2 * c2 * self._gravity

    def _initial_state(self, uniform: Tensor) -> Tensor:
        return uniform * 0.2 - 0.1

    def _derivative(self, state: Tensor, torque: Tensor) -> Tensor:
        theta_1, theta_2, dtheta_1, dtheta_2 = state.unbind(-1)
        swing, sin_2 = self._coupling * theta_2.cos(), theta_2.sin()
        d1 = self._inertia_1 + 2 * swing
        d2 = self._inertia_2 + swing
        phi_2 = self._weight_2 * (theta_1 + theta_2).sin()
        phi_1 = (
            phi_2
            + self._weight_1 * theta_1.sin()
            - self._coupling * sin_2 * dtheta_2 * (dtheta_2 + 2 * dtheta_1)
        )
        ddtheta_2 = (
            torque + d2 / d1 * phi_1 - self._coupling * dtheta_1.square() * sin_2 - phi_2
        ) / (self._inertia_2 - d2.square() / d1)
        ddtheta_1 = -(d2 * ddtheta_2 + phi_1) / d1
        return torch.stack([dtheta_1, dtheta_2, ddtheta_1, ddtheta_2], -1)

    def _advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        torque, h = (action - 1).to(state.dtype), self._dt
        k1 = self._derivative(state, torque)
        k2 = self._derivative(state + h / 2 * k1, torque)
        k3 = self._derivative(state + h / 2 * k2, torque)
        k4 = self._derivative(state + h * k3, torque)
        angles, speeds = (state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)).split(2, -1)
        angles = angles - 2 * math.pi * ((angles + math.pi) / (2 * math.pi)).floor()
        limit = speeds.new_tensor(self._speed_limits)
        state = torch.cat([angles, speeds.clamp(-limit, limit)], -1)
        terminated = -angles[:, 0].cos() - angles.sum(-1).cos() > 1.0
        return state, terminated.to(state.dtype) - 1.0, terminated

    def _observe(self, state: Tensor) -> Tensor:
        cos, sin = state[:, :2].cos(), state[:, :2].sin()
        return torch.stack([cos[:, 0], sin[:, 0], cos[:, 1], sin[:, 1], *state[:, 2:].T], -1)
