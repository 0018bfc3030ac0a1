"""Formulas that several laws share, each exact where the strength is zero."""

from __future__ import annotations

__all__ = ["bent", "decay", "quantized", "within"]

import torch
from torch import Tensor


def within(scale: Tensor, low: float, high: float) -> tuple[Tensor, Tensor]:
    """Return bounds that are multiples of a scale."""
    return scale * low, scale * high


def decay(dt: float, time_constant: Tensor) -> Tensor:
    """Return ``e^{−dt/T}``, what is left after ``dt``; zero for a time constant of zero."""
    return torch.exp(-dt / time_constant.clamp(min=0.0))


def quantized(value: Tensor, step: Tensor) -> Tensor:
    """Return the nearest multiple of ``step``, or the value itself where that is zero."""
    some = torch.where(step > 0, step, 1.0)
    return torch.where(step > 0, some * torch.round(value / some), value)


def bent(value: Tensor, limit: Tensor, softness: float) -> Tensor:
    """Return values that bend into ``±limit``: ``v (1 + |v / l|^(1/σ))^(−σ)``, at σ = 0 cut there.

    Example:
        >>> one = torch.tensor(1.0)
        >>> [round(bent(one, one, softness).item(), 3) for softness in (0.0, 0.5, 1.0)]
        [1.0, 0.707, 0.5]
    """
    if not softness:
        return value.clamp(-limit, limit)
    some = torch.where(limit > 0, limit, 1.0)
    over = (value / some).abs()
    # of the larger of the two, so that no power overflows
    large = over.clamp(min=1.0)
    bend = large * ((over / large) ** (1 / softness) + large ** (-1 / softness)) ** softness
    return torch.where(limit > 0, value / bend, 0.0)
