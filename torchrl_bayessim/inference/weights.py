"""The weights of pairs, and what they are worth."""

from __future__ import annotations

__all__ = ["effective_sample_size", "weights_of"]

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


def effective_sample_size(weights: Tensor) -> float:
    r"""Return :math:`(\sum w)^2 / \sum w^2`: how many equal weights these are worth (Kish, 1965).

    Example:
        >>> effective_sample_size(torch.tensor([1.0, 1.0, 0.0]))
        2.0
    """
    return (weights.sum().square() / weights.square().sum().clamp_min(1e-30)).item()
