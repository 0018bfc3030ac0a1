"""What a transform stands before and beside, and which environments a reset concerns."""

from __future__ import annotations

__all__ = ["resets", "simulator", "transforms_of"]

from collections.abc import Iterator
from typing import Any, TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform, TransformedEnv

_T = TypeVar("_T", bound=Transform)


def simulator(env: EnvBase | None) -> Any:
    """Return the environment under all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def transforms_of(env: EnvBase | None, kind: type[_T]) -> Iterator[_T]:
    """Yield the transforms of one kind, of an environment and of those that it wraps."""
    while isinstance(env, TransformedEnv):
        yield from (m for m in env.transform.modules() if isinstance(m, kind))
        env = env.base_env


def resets(env: EnvBase | None, tensordict: TensorDictBase) -> Tensor:
    """Return which environments a reset concerns, boolean, of the tensordict's batch size."""
    batch, keys = tensordict.batch_size, [] if env is None else env.reset_keys
    masks = [tensordict.get(key, None) for key in keys]
    masks = [mask.reshape(*batch, -1).any(-1) for mask in masks if mask is not None]
    if not masks:
        return torch.ones(batch, dtype=torch.bool)
    return torch.stack(masks).any(0).cpu()
