"""Memories of laws at resets of some of the environments of a batch."""

from __future__ import annotations

__all__ = ["renewed"]

import torch
from torch import Tensor

from .effect import Memory


def renewed(memory: Memory, start: Memory, mask: Tensor) -> Memory:
    """Return the memory, begun anew where ``mask``, shape ``batch``, is true.

    Example:
        >>> renewed({"n": torch.tensor([[3], [4]])}, {"n": torch.zeros(2, 1)}, torch.tensor([1, 0]))
        {'n': tensor([[0.],
                [4.]])}
    """
    mask = mask.bool()
    return {
        name: torch.where(mask.reshape(*mask.shape, *[1] * (value.ndim - mask.ndim)), value, old)
        for name, value in start.items()
        for old in (memory[name],)
    }
