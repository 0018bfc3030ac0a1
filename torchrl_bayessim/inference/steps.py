"""Steps of AdamW under one cycle of the learning rate, with the gradient clipped."""

from __future__ import annotations

__all__ = ["Steps"]

import math
from collections.abc import Callable

import torch

from .stacked import OneNetwork, StackedNetworks

_WARM_UP = 0.1  # share of the steps in which the learning rate rises
_CLIP = 10.0  # of the gradient's norm
_BETAS = 0.9, 0.95  # squares of gradients are forgotten within a fit of some hundred steps
_EPS = 1e-8  # torch's own
_fused_adamw = torch.ops.aten._fused_adamw_  # what torch's optimizer calls


class Steps:
    """What makes one step after another down the gradients of networks.

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
        self._networks, self._count, self._lr, self._made = networks, count, lr, 0
        self._step = (
            _of_stacked(networks, weight_decay)
            if isinstance(networks, StackedNetworks)
            else _of_any(networks, weight_decay)
        )

    def __call__(self) -> None:
        """Make the next step."""
        self._networks.clip_gradients(_CLIP)
        self._step(self._lr * _rate(self._made, self._count))
        self._made += 1


def _of_any(network: OneNetwork, weight_decay: float) -> Callable[[float], None]:
    """Return what makes a step at a rate, whatever becomes of the parameters in between."""
    optimizer = torch.optim.AdamW(
        network.parameters, betas=_BETAS, weight_decay=weight_decay, fused=True
    )

    def step(lr: float) -> None:
        optimizer.param_groups[0]["lr"] = lr
        optimizer.step()

    return step


def _of_stacked(networks: StackedNetworks, weight_decay: float) -> Callable[[float], None]:
    """Return the same for one tensor that stays where it is.

    By the kernel alone: what the class and the function around it look after takes longer than
    small networks take to learn.
    """
    parameters, gradients = [networks.parameters], [networks.gradient]
    means, squares = [torch.zeros_like(parameters[0])], [torch.zeros_like(parameters[0])]
    # the kernel reads it in single precision, whatever the default is
    made = torch.zeros((), dtype=torch.float32, device=parameters[0].device)

    def step(lr: float) -> None:
        made.add_(1)
        _fused_adamw(
            parameters,
            gradients,
            means,
            squares,
            [],
            [made],
            amsgrad=False,
            beta1=_BETAS[0],
            beta2=_BETAS[1],
            lr=lr,
            weight_decay=weight_decay,
            eps=_EPS,
            maximize=False,
        )

    return step


def _rate(step: int, steps: int) -> float:
    """Return the share of the highest learning rate."""
    rise = max(1.0, _WARM_UP * steps)
    if step < rise:
        return 0.1 + 0.9 * step / rise
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (step - rise) / max(1.0, steps - rise))))
