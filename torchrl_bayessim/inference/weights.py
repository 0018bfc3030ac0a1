"""The weights of pairs, and means by them."""

from __future__ import annotations

__all__ = ["weighted_mean", "weights_of"]

import torch
from tensordict import TensorDictBase
from torch import Tensor


def weights_of(pairs: TensorDictBase) -> Tensor:
    """Return one weight per pair, float64, shape ``(N,)``: 1 where they have none.

    Example:
        >>> from tensordict import TensorDict
        >>> weights_of(TensorDict({"theta": torch.zeros(2, 1)}, [2]))
        tensor([1., 1.], dtype=torch.float64)
    """
    weight = pairs.get("weight", None)
    if weight is None:
        return torch.ones(len(pairs), dtype=torch.float64, device=pairs.device)
    return weight.reshape(len(pairs)).double()


def weighted_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Return the mean by weights ``(N,)``; where a weight is 0 the value may be anything.

    Example:
        >>> weighted_mean(torch.tensor([1.0, torch.nan]), torch.tensor([2.0, 0.0]))
        tensor(1.)
    """
    total = torch.where(weight > 0, weight * values, 0.0).sum()
    return total / weight.sum().clamp_min(torch.finfo(weight.dtype).tiny)
