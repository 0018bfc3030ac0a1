"""Formulas that several laws share, each exact where the strength is zero."""

from __future__ import annotations

__all__ = ["decay", "quantized", "within"]

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
