"""Batches from a hindsight replay buffer, as the losses of actor and critic read them."""

from __future__ import annotations

__all__ = ["ReplayedBatches"]

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ..randomness import isolated
from .goal_networks import GoalState
from .hindsight import HindsightReplayBuffer

_AT_ONCE = 160  # batches sampled in one go


class ReplayedBatches:
    """Draws batches: states as the networks see them, actions in [-1, 1], noise of TD3's actions.

    Args:
        buffer: Holds transitions, in the environment's units.
        state: The networks' input.
        bounds: Lowest and highest action, shape ``(A,)`` each.
        batch_size: Transitions in a batch.
        seed: With the key it decides what is drawn.
    """

    def __init__(
        self,
        buffer: HindsightReplayBuffer,
        state: GoalState,
        bounds: tuple[Tensor, Tensor],
        *,
        batch_size: int,
        seed: int,
    ) -> None:
        self._buffer, self._state, self._bounds = buffer, state, bounds
        self._batch_size, self._seed = batch_size, seed

    def __call__(self, count: int, *, key: tuple[int | str, ...]) -> Iterator[TensorDictBase]:
        """Yield so many batches; a few hundred are drawn in one go, when the first is due."""
        for first in range(0, count, _AT_ONCE):
            rows = min(_AT_ONCE, count - first) * self._batch_size
            with isolated(self._seed, "ddpg update", *key, first):
                steps = self._steps(self._buffer.sample(rows))
                # relabelled ones come first in the sample
                batches: Any = steps[torch.randperm(rows)].split(self._batch_size)
            yield from batches

    def _steps(self, sample: TensorDictBase) -> TensorDictBase:
        low, high = self._bounds
        after: Any = sample["next"]
        action = 2 * (sample["action"] - low) / (high - low) - 1
        entries = {
            "state": self._state.full(sample),
            "action": action,
            "noise": torch.randn_like(action),
            "next": {
                "state": self._state.full(after),
                **{key: after[key] for key in ("reward", "done", "terminated")},
            },
        }
        return TensorDict(entries, batch_size=sample.batch_size)
