r"""The standard normal restricted to an interval: log-mass and quantiles, stable in both tails.

Gradients are in closed form, because autograd through ``log_ndtr`` gives NaN far out. All of it is
meant for float64.
"""

from __future__ import annotations

__all__ = ["log_interval", "log_interval_of_arrays", "truncated_quantile"]

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import log_ndtr
from torch import Tensor
from torch.autograd.function import FunctionCtx


def _mirror(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mirror intervals of the upper tail, where differences of Phi would cancel."""
    flip = a > 0
    return flip, torch.where(flip, -b, a), torch.where(flip, -a, b)


def _log_ratio(low: Tensor, high: Tensor, log_high: Tensor) -> Tensor:
    r"""Return :math:`\log\Phi(l) - \log\Phi(h)`, negative, for mirrored limits."""
    # far out log Phi is about -x^2 / 2, whose difference must be formed before it is rounded away
    tail = 0.5 * (high - low) * (high.clamp(max=-1.0) + low)
    near = torch.special.log_ndtr(low) - log_high
    return torch.where(high < -1e3, tail, near).clamp(max=-1e-12)


class _LogInterval(torch.autograd.Function):
    r"""Forward and backward in closed form: autograd through ``log_ndtr`` gives NaN in the tails.

    :math:`\partial_h \log(\Phi(h) - \Phi(l)) = \lambda(h) / (1 - r)` and
    :math:`\partial_l = -r \lambda(l) / (1 - r)` with :math:`r = \Phi(l) / \Phi(h)` and
    :math:`\lambda(x) = \phi(x) / \Phi(x) = \sqrt{2 / \pi} / \operatorname{erfcx}(-x / \sqrt 2)`.
    """

    @staticmethod
    def forward(ctx: FunctionCtx, a: Tensor, b: Tensor) -> Tensor:
        flip, low, high = _mirror(a, b)
        log_high = torch.special.log_ndtr(high)
        log_ratio = _log_ratio(low, high, log_high)
        ctx.save_for_backward(flip, low, high, log_ratio)
        return log_high + torch.log(-torch.expm1(log_ratio))

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, Tensor]:
        flip, low, high, log_ratio = ctx.saved_tensors
        rest = -torch.expm1(log_ratio)
        d_high = _hazard(high) / rest
        d_low = -log_ratio.exp() * _hazard(low) / rest
        return grad * torch.where(flip, -d_high, d_low), grad * torch.where(flip, -d_low, d_high)


class _TruncatedQuantile(torch.autograd.Function):
    r"""Forward through the nearer tail; backward :math:`\partial_a y = (1 - u) \phi(a) / \phi(y)`.

    :math:`\partial_b y = u\, \phi(b) / \phi(y)`; no gradient for u.
    """

    @staticmethod
    def forward(ctx: FunctionCtx, a: Tensor, b: Tensor, u: Tensor) -> Tensor:
        flip, low, high = _mirror(a, b)
        v = torch.where(flip, 1 - u, u)
        # erfc because torch.special.ndtr is 0 below -8.3
        mass_low, mass_high = (0.5 * torch.erfc(-x / math.sqrt(2)) for x in (low, high))
        body = torch.special.ndtri((mass_low + v * (mass_high - mass_low)).clamp(1e-290, 1 - 1e-16))
        # beyond 30 deviations Phi underflows; there log Phi is a parabola to 1 part in 10^4
        rate = high.clamp(max=-1.0).abs()
        rate = rate + 1 / rate
        drop = -torch.log1p((1 - v) * torch.expm1(-(high - low) * (rate + (high - low) / 2)))
        tail = high - 2 * drop / (rate + (rate.square() + 2 * drop).sqrt())
        y = torch.where(high < -30, tail, body)
        y = torch.minimum(torch.maximum(y, low), high)
        y = torch.where(flip, -y, y)
        ctx.save_for_backward(a, b, u, y)
        return y

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        a, b, u, y = ctx.saved_tensors
        d_a = (1 - u) * (0.5 * (y - a) * (y + a)).clamp(max=50.0).exp()
        d_b = u * (0.5 * (y - b) * (y + b)).clamp(max=50.0).exp()
        return (grad * d_a).sum_to_size(a.shape), (grad * d_b).sum_to_size(b.shape), None


def _hazard(x: Tensor) -> Tensor:
    return math.sqrt(2 / math.pi) / torch.special.erfcx(-x / math.sqrt(2))


def log_interval(a: Tensor, b: Tensor) -> Tensor:
    r"""Return :math:`\log(\Phi(b) - \Phi(a))` for :math:`a < b`, stable in both tails."""
    return _LogInterval.apply(*torch.broadcast_tensors(a, b))


def log_interval_of_arrays(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return :func:`log_interval` of arrays, without gradients: of small ones in half the time.

    Example:
        >>> log_interval_of_arrays(-np.ones(1), np.ones(1)).round(4)  # log 0.6827
        array([-0.3817])
    """
    flip = a > 0
    low, high = np.where(flip, -b, a), np.where(flip, -a, b)
    log_high = log_ndtr(high)
    log_ratio = log_ndtr(low) - log_high
    far = high < -1e3  # as in _log_ratio
    if far.any():
        log_ratio[far] = 0.5 * ((high - low) * (high + low))[far]
    return log_high + np.log(-np.expm1(np.minimum(log_ratio, -1e-12)))


def truncated_quantile(a: Tensor, b: Tensor, u: Tensor) -> Tensor:
    r"""Return the ``u``-quantile of a standard normal restricted to :math:`[a, b]`."""
    return _TruncatedQuantile.apply(*torch.broadcast_tensors(a, b), u)
