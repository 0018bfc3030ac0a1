"""Steps of AdamW under one cycle of the learning rate, with the gradient clipped."""

from __future__ import annotations

__all__ = ["Steps"]

import math

import torch
from torch.optim.adamw import adamw

from .stacked import OneNetwork, StackedNetworks

_WARM_UP = 0.1  # share of the steps in which the learning rate rises
_CLIP = 10.0  # of the gradient's norm
_BETAS = 0.9, 0.95  # squares of gradients are forgotten within a fit of some hundred steps
_EPS = 1e-8


class Steps:
    """What makes one step after another down the gradients of networks.

    As a function: the class takes longer to look after its state than a small network to learn.

    Args:
        networks: Changed in place.
        count: Steps of the whole cycle.
        lr: Highest learning rate.
        weight_decay: Decoupled (Loshchilov & Hutter, 2019, "Decoupled weight decay regularization",
            arXiv:1711.05101, algorithm 2).
    """

    def __init__(
        self,
        networks: OneNetwork | StackedNetworks,
        count: int,
        *,
        lr: float,
        weight_decay: float,
    ) -> None:
        self._networks, self._count, self._lr = networks, count, lr
        self._weight_decay, self._made = weight_decay, 0
        parameters = networks.parameters
        self._means = [torch.zeros_like(parameter) for parameter in parameters]
        self._squares = [torch.zeros_like(parameter) for parameter in parameters]
        self._counts = [torch.zeros((), device=parameter.device) for parameter in parameters]

    def __call__(self) -> None:
        """Make the next step."""
        self._networks.clip_gradients(_CLIP)
        adamw(
            self._networks.parameters,
            self._networks.gradients,
            self._means,
            self._squares,
            [],
            self._counts,
            fused=True,
            amsgrad=False,
            beta1=_BETAS[0],
            beta2=_BETAS[1],
            lr=self._lr * _rate(self._made, self._count),
            weight_decay=self._weight_decay,
            eps=_EPS,
            maximize=False,
        )
        self._made += 1


def _rate(step: int, steps: int) -> float:
    """Return the share of the highest learning rate."""
    rise = max(1.0, _WARM_UP * steps)
    if step < rise:
        return 0.1 + 0.9 * step / rise
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (step - rise) / max(1.0, steps - rise))))
