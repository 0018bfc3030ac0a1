r"""The gradient of a mixture's log-density by the last layer of its network, in closed form.

With responsibilities :math:`r_k = \pi_k (N_k / Z_k) / \sum_j \pi_j (N_j / Z_j)`,

.. math::
    \nabla \log q = \sum_k r_k (\nabla \log \pi_k + \nabla \log N_k - \nabla \log Z_k)

(Bishop, 1994, "Mixture density networks", eq. 36-39, there for Gaussians without a box). As
autograd records them, its hundred small operations take several times as long as the network.
"""

from __future__ import annotations

__all__ = ["log_density_and_gradient"]

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from .network import FLOOR, STEEPEST, WIDEST, MixtureDensityNetwork, factor
from .truncated_normal import log_interval_and_slopes
from .truncation import POINTS, log_mass


class _Parts(NamedTuple):
    """Of each component, or the gradient by it."""

    loc: Tensor  # (*, K, D)
    deviation: Tensor  # (*, K, D)
    slope: Tensor  # of factor(), (*, K, D (D - 1) / 2)


_ONE = torch.ones((), dtype=torch.float64)
_Pull = Callable[[Tensor], _Parts]  # the gradient of a sum over components, with weights (*, K)


@torch.no_grad()
def log_density_and_gradient(
    network: MixtureDensityNetwork,
    raw: Tensor,
    value: Tensor,
    *,
    box: tuple[Tensor, Tensor] | None,
    points: int = POINTS,
) -> tuple[Tensor, Tensor]:
    """Return log-densities of standardised parameters, and their gradients by the last layer.

    Args:
        network: Says what its last layer's values mean.
        raw: These values, shape ``(*, P)``: see :meth:`.MixtureDensityNetwork.raw`.
        value: Parameters inside the box, shape ``(*, D)``.
        box: To which every component is restricted; ``None`` for all of R^D.
        points: Quasi-random points that integrate the mass of a correlated component.

    Returns:
        Log-densities of shape ``(*)``, and gradients of the shape of ``raw``, both float64.

    Example:
        >>> from torchrl_bayessim.inference.features import ResidualFeatures
        >>> network = MixtureDensityNetwork(ResidualFeatures(3), 2, components=4,
        ...                                 covariance="full", reach=1.7)
        >>> raw = network.raw(torch.ones(5, 3))
        >>> log_q, gradient = log_density_and_gradient(network, raw, torch.zeros(5, 2), box=None)
        >>> gradient.shape == raw.shape
        True
    """
    raw = raw.double()
    logits, *parts = network.parts(raw, network.widening)
    parts = _Parts(*parts)
    log_pi = logits.log_softmax(-1)
    log_n, pull = _gaussians(value.double(), parts)
    if box is not None:
        log_n, pull = _restricted(log_n, pull, _masses(parts, box, points))
    each = log_pi + log_n
    log_q = each.logsumexp(-1)
    share = (each - log_q.unsqueeze(-1)).exp()
    by_raw = _chain(network, raw, parts, pull(share))
    return log_q, torch.cat([share - log_pi.exp(), *(part.flatten(-2) for part in by_raw)], -1)


def _gaussians(value: Tensor, parts: _Parts) -> tuple[Tensor, _Pull]:
    r"""Return each component's log-density ``(*, K)``, and what pulls gradients back.

    Row d of the factor is :math:`(c_d, 1) / g_d` with slopes :math:`c_d` and
    :math:`g_d = \sqrt{1 + c_d^T c_d} / \sigma_d`: forward substitution is
    :math:`\varepsilon_d = g_d (z_d - \mu_d) - c_d^T \varepsilon_{<d}`, and the adjoint of
    :math:`-\varepsilon^T\varepsilon / 2` runs backward through it.
    """
    size = parts.loc.shape[-1]
    centred = value.unsqueeze(-2) - parts.loc
    # views of shape (*, K, d); none for a diagonal factor
    rows = parts.slope.split(list(range(size)), -1) if parts.slope.shape[-1] else ()
    square = torch.stack([1 + row.square().sum(-1) for row in rows], -1) if rows else _ONE
    scale = square.sqrt() / parts.deviation
    scaled = scale * centred
    noise = scaled
    if rows:
        found = [scaled[..., 0]]
        for d in range(1, size):
            found.append(scaled[..., d] - (rows[d] * torch.stack(found, -1)).sum(-1))
        noise = torch.stack(found, -1)
    log_n = scale.log().sum(-1) - 0.5 * (noise.square().sum(-1) + size * math.log(2 * math.pi))

    def pull(share: Tensor) -> _Parts:
        share = share.unsqueeze(-1)
        adjoint = -share * noise
        for d in reversed(range(1, len(rows))):
            adjoint[..., :d] -= rows[d] * adjoint[..., d : d + 1]
        by_log_scale = adjoint * scaled + share
        by_slope = [
            by_log_scale[..., d : d + 1] / square[..., d : d + 1] * row
            - adjoint[..., d : d + 1] * noise[..., :d]
            for d, row in enumerate(rows)
        ]
        return _Parts(
            -adjoint * scale,
            -by_log_scale / parts.deviation,
            torch.cat(by_slope, -1) if rows else parts.slope,
        )

    return log_n, pull


def _restricted(log_n: Tensor, pull_n: _Pull, mass: tuple[Tensor, _Pull]) -> tuple[Tensor, _Pull]:
    """Return densities and what pulls back, both over the mass in the box."""
    log_z, pull_z = mass

    def pull(share: Tensor) -> _Parts:
        return _Parts(*(n - z for n, z in zip(pull_n(share), pull_z(share), strict=True)))

    return log_n - log_z, pull


def _masses(parts: _Parts, box: tuple[Tensor, Tensor], points: int) -> tuple[Tensor, _Pull]:
    """Return the log of each component's mass in the box ``(*, K)``, and what pulls back."""
    low, high = (edge.to(parts.loc) for edge in box)
    if parts.slope.shape[-1]:
        with torch.enable_grad():
            leaves = _Parts(*(part.detach().requires_grad_() for part in parts))
            scale_tril = factor(leaves.deviation, leaves.slope)
            found = log_mass(leaves.loc, scale_tril, (low, high), diagonal=False, points=points)
        return found.detach(), lambda share: _Parts(*torch.autograd.grad(found, leaves, share))
    a, b = (low - parts.loc) / parts.deviation, (high - parts.loc) / parts.deviation
    each, by_a, by_b = log_interval_and_slopes(a, b)

    def pull(share: Tensor) -> _Parts:
        outer = -share.unsqueeze(-1) / parts.deviation
        return _Parts(outer * (by_a + by_b), outer * (a * by_a + b * by_b), parts.slope)

    return each.sum(-1), pull


def _chain(
    network: MixtureDensityNetwork, raw: Tensor, parts: _Parts, by_parts: _Parts
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradient by what :meth:`.MixtureDensityNetwork.parts` made the parts of."""
    # of tanh, by its value; of the square root of melu, whose derivative is exp(min(z, 0))
    variance_raw = raw.split(network.sizes, -1)[2].reshape(parts.deviation.shape)
    ratio = parts.deviation / WIDEST
    steepness = variance_raw.clamp(max=0.0).exp()
    variance = steepness + variance_raw.relu() + FLOOR
    by_variance = 0.5 * network.widening * steepness / variance.sqrt() * (1 - ratio.square())
    return (
        by_parts.loc * (1 - (parts.loc / network.reach).square()),
        by_parts.deviation * by_variance,
        by_parts.slope * (1 - (parts.slope / STEEPEST).square()),
    )
