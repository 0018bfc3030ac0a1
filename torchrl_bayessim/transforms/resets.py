"""Which simulator a transform stands before, and which environments a reset concerns."""

from __future__ import annotations

__all__ = ["resets", "simulator"]

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv


def simulator(env: EnvBase | None) -> Any:
    """Return the environment under all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def resets(env: EnvBase | None, tensordict: TensorDictBase) -> Tensor:
    """Return which environments a reset concerns, boolean, of the tensordict's batch size."""
    batch, keys = tensordict.batch_size, [] if env is None else env.reset_keys
    masks = [tensordict.get(key, None) for key in keys]
    masks = [mask.reshape(*batch, -1).any(-1) for mask in masks if mask is not None]
    if not masks:
        return torch.ones(batch, dtype=torch.bool)
    return torch.stack(masks).any(0).cpu()
