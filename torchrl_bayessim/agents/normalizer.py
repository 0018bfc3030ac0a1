"""Running normalisation of a network's inputs, as part of the network."""

from __future__ import annotations

__all__ = ["Normalizer"]

import torch
from torch import Tensor, nn


class Normalizer(nn.Module):
    """``(x − mean) / std``, clipped, with statistics that change only in `observe`.

    Mean and variance over all observed rows are merged batch by batch (Chan, Golub & LeVeque,
    1983). A feature that never varied is only centred.

    Args:
        size: Number of features ``D``.
        clip: Largest magnitude that is handed on.
        least_std: Standard deviations below it count as it, in the features' units: noise of a
            feature that hardly varies is then not blown up.

    Example:
        >>> normalizer = Normalizer(1)
        >>> normalizer.observe(torch.tensor([[1.0], [3.0]]))
        >>> normalizer(torch.tensor([[2.0], [4.0]])).squeeze(-1)
        tensor([0., 2.])
    """

    count: Tensor
    mean: Tensor
    variance: Tensor
    shift: Tensor
    scale: Tensor

    def __init__(self, size: int, *, clip: float = 10.0, least_std: float = 0.0) -> None:
        super().__init__()
        self.clip, self.least_std = clip, least_std
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise ``x`` of shape ``(*, D)``."""
        return ((x.to(self.shift.dtype) - self.shift) * self.scale).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def observe(self, x: Tensor) -> None:
        """Take ``x`` of shape ``(*, D)`` into the statistics."""
        x = x.reshape(-1, x.shape[-1]).double()
        variance, mean = torch.var_mean(x, 0, correction=0)
        share = len(x) / (self.count + len(x))
        gap = mean - self.mean
        if self.count == 0:
            self.mean.copy_(mean)
            self.variance.copy_(variance)
        else:
            self.mean += share * gap
            self.variance.lerp_(variance, share).add_(share * (1 - share) * gap.square())
        self.count += len(x)
        varies = self.variance > 1e-12
        self.shift.copy_(self.mean)
        least = self.variance.clamp(min=self.least_std**2)
        self.scale.copy_(torch.where(varies, least.rsqrt(), 1.0))
