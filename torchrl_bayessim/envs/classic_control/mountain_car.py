"""Mountain car: leave a valley by an engine too weak to climb straight out (Moore, 1990).

``v ← v + f − g cos 3x`` and ``x ← x + v``, with ``|v| ≤ 0.07`` and x in [−1.2, 0.6], the left wall
stopping the car. Discrete: ``f = (a − 1) force``, gravity a parameter, goal at 0.5, reward −1 per
step. Continuous: ``f = a power``, g = 0.0025, goal at 0.45, reward ``100 [goal] − 0.1 a²``. As in
gymnasium's ``MountainCar-v0`` and ``MountainCarContinuous-v0`` (whose state is rounded to float32
at every step; here it keeps ``dtype``).
"""

from __future__ import annotations

__all__ = ["MountainCarContinuousEnv", "MountainCarEnv"]

from typing import Any, ClassVar

import torch
from torch import Tensor
from torchrl.data import Bounded
from torchrl.data.tensor_specs import TensorSpec

from .base import ClassicControlEnv, discrete


class MountainCarEnv(ClassicControlEnv):
    """``N`` cars with the actions left, none, right; parameters force, gravity.

    Args:
        num_envs: Number of environments ``N``.
        categorical_action_encoding: Actions as indices ``(N,)`` instead of one-hot ``(N, 3)``.
        **options: ``seed``, ``max_steps``, ``dtype``, ``device``: see `ClassicControlEnv`.

    Example:
        >>> MountainCarEnv(2, max_steps=200).rollout(3)["action"].shape
        torch.Size([2, 3, 3])
    """

    defaults: ClassVar = {"force": 0.001, "gravity": 0.0025}
    positive = frozenset()
    _state_size = _observation_size = 2

    def __init__(
        self, num_envs: int, *, categorical_action_encoding: bool = False, **options: Any
    ) -> None:
        self._categorical = categorical_action_encoding
        super().__init__(num_envs, **options)

    def _action_spec(self) -> TensorSpec:
        n = self.batch_size[0]
        return discrete(3, n, categorical=self._categorical, device=self.device)

    def _couple(self) -> None:
        pass

    def _initial_state(self, uniform: Tensor) -> Tensor:
        return _at_rest(uniform)

    def _advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        p = self._parameters_now
        state = _drive(state, (action - 1) * p["force"], p["gravity"])
        position, velocity = state.unbind(-1)
        return state, torch.full_like(position, -1.0), (position >= 0.5) & (velocity >= 0)

    def _observe(self, state: Tensor) -> Tensor:
        return state.clone()


class MountainCarContinuousEnv(ClassicControlEnv):
    """``N`` cars with a throttle in [−1, 1]; parameter power. Arguments: see `ClassicControlEnv`.

    A throttle beyond ±1 saturates but costs ``0.1 a²`` in full, as in gymnasium.

    Example:
        >>> MountainCarContinuousEnv(2, max_steps=999).rollout(3)["action"].shape
        torch.Size([2, 3, 1])
    """

    defaults: ClassVar = {"power": 0.0015}
    positive = frozenset()
    _state_size = _observation_size = 2

    def _action_spec(self) -> TensorSpec:
        shape = torch.Size((self.batch_size[0], 1))
        return Bounded(-1.0, 1.0, shape=shape, dtype=self._float, device=self.device)

    def _couple(self) -> None:
        pass

    def _initial_state(self, uniform: Tensor) -> Tensor:
        return _at_rest(uniform)

    def _advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        state = _drive(state, action.clamp(-1.0, 1.0) * self._parameters_now["power"], 0.0025)
        position, velocity = state.unbind(-1)
        terminated = (position >= 0.45) & (velocity >= 0)
        return state, 100.0 * terminated - 0.1 * action.square(), terminated

    def _observe(self, state: Tensor) -> Tensor:
        return state.clone()


def _at_rest(uniform: Tensor) -> Tensor:
    """Return states with a position in [−0.6, −0.4) and no velocity."""
    return (uniform * 0.2 - 0.6) * uniform.new_tensor([1.0, 0.0])


def _drive(state: Tensor, push: Tensor, gravity: Tensor | float) -> Tensor:
    position, velocity = state.unbind(-1)
    velocity = (velocity + push - gravity * (3 * position).cos()).clamp(-0.07, 0.07)
    position = (position + velocity).clamp(-1.2, 0.6)
    stopped = (position <= -1.2) & (velocity < 0)
    return torch.stack([position, velocity.masked_fill(stopped, 0.0)], -1)
