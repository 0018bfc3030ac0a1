r"""The gradient of a mixture's log-density by the last layer of its network, in closed form.

With responsibilities :math:`r_k = \pi_k (N_k / Z_k) / \sum_j \pi_j (N_j / Z_j)`,

.. math::
    \nabla \log q = \sum_k r_k (\nabla \log \pi_k + \nabla \log N_k - \nabla \log Z_k)

(Bishop, 1994, "Mixture density networks", eq. 36-39, there for Gaussians without a box). As
autograd records them, its hundred small operations take several times as long as the network; in
NumPy a call takes half of what it takes in torch. The pairs of a minibatch are the last axis: a sum
over the few components or parameters is then one over long rows, several times as fast.
"""

from __future__ import annotations

__all__ = ["log_density_and_pullback"]

import math
from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .network import FLOOR, STEEPEST, WIDEST, MixtureDensityNetwork, factor
from .truncated_normal import log_interval_of_arrays
from .truncation import POINTS, log_mass

_Array = NDArray[np.float64]
_HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


class _Parts(NamedTuple):
    """Of each component, or derivatives by it."""

    loc: _Array  # (K, D, N)
    deviation: _Array  # (K, D, N)
    slope: _Array  # of `factor`, (K, D (D - 1) / 2, N), or (K, 0, N) if it is diagonal


_Pull = Callable[[_Array], _Parts]  # the gradient of a sum over components, with weights (K, N)


def log_density_and_pullback(
    network: MixtureDensityNetwork,
    raw: Tensor,
    value: Tensor,
    *,
    box: tuple[Tensor, Tensor] | None,
    points: int = POINTS,
) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Return log-densities of standardised parameters, and what returns their gradient.

    Those before the mixture is widened, as a fit does in its end. Worked out on the processor,
    wherever the values are.

    Args:
        network: Says what its last layer's values mean.
        raw: These values, shape ``(*, P)``: see :meth:`.MixtureDensityNetwork.raw`.
        value: Parameters inside the box, shape ``(*, D)``.
        box: To which every component is restricted; ``None`` for all of R^D.
        points: Quasi-random points that integrate the mass of a correlated component.

    Returns:
        Log-densities of shape ``(*)``, float64, and a function to be called once: from weights of
        that shape to the gradient of the weighted sum by ``raw``, ``(*, P)``; not where autograd is
        switched off.

    Example:
        >>> from torchrl_bayessim.inference.features import ResidualFeatures
        >>> network = MixtureDensityNetwork(ResidualFeatures(3), 2, components=4,
        ...                                 covariance="full", reach=1.7)
        >>> raw = network.raw(torch.ones(5, 3))
        >>> log_q, pullback = log_density_and_pullback(network, raw, torch.zeros(5, 2), box=None)
        >>> pullback(torch.ones(5)).shape == raw.shape
        True
    """
    values = _pairs_last(raw.detach())
    with np.errstate(all="ignore"):  # where a network diverges, its loss says so
        parts, chain = _parts(network, values)
        log_n, pull = _gaussians(_pairs_last(value), parts)
        if box is not None:
            log_n, pull = _restricted(log_n, pull, _masses(parts, box, points))
        logits = values[: network.components]
        weight, log_total = _softmax(logits)
        share, log_q = _softmax(logits + log_n)

    def pullback(upstream: Tensor) -> Tensor:
        times = upstream.double().cpu().numpy().reshape(-1)
        with np.errstate(all="ignore"):
            by_raw = [times * (share - weight)]
            for by_part, derivative in zip(pull(times * share), chain, strict=True):
                by_raw.append((by_part * derivative).reshape(-1, values.shape[1]))
        return torch.as_tensor(np.concatenate(by_raw).T.reshape(raw.shape), device=raw.device)

    found = torch.as_tensor((log_q - log_total).reshape(raw.shape[:-1]), device=raw.device)
    return found, pullback


def _pairs_last(value: Tensor) -> _Array:
    """Return values ``(*, P)`` as an array ``(P, N)``."""
    rows = value.cpu().numpy().reshape(-1, value.shape[-1])
    return np.array(rows.T, np.float64, order="C")


def _softmax(logits: _Array) -> tuple[_Array, _Array]:
    """Return shares ``(K, N)`` and the logarithm of the sum of exponentials ``(N,)``."""
    top = logits.max(0)
    share = np.exp(logits - top)
    total = share.sum(0)
    share /= total
    return share, np.log(total) + top


def _parts(network: MixtureDensityNetwork, raw: _Array) -> tuple[_Parts, _Parts]:
    """Return what the network makes of ``raw`` before it is widened, and the derivatives."""
    first, second, third = accumulate(network.sizes[:-1])
    loc, variance, slope = (
        part.reshape(network.components, -1, raw.shape[-1])
        for part in (raw[first:second], raw[second:third], raw[third:])
    )
    loc = np.tanh(loc / network.reach)
    steepness = np.exp(np.minimum(variance, 0.0))  # the derivative of melu
    deviation = np.sqrt(steepness + np.maximum(variance, 0.0) + FLOOR)
    bent = np.tanh(deviation / WIDEST)
    slope = np.tanh(slope / STEEPEST) if slope.size else slope
    return _Parts(network.reach * loc, WIDEST * bent, STEEPEST * slope), _Parts(
        1 - loc * loc,
        (1 - bent * bent) * steepness * 0.5 / deviation,
        1 - slope * slope,
    )


def _gaussians(value: _Array, parts: _Parts) -> tuple[_Array, _Pull]:
    r"""Return each component's log-density ``(K, N)``, and what pulls gradients back.

    Row d of the factor is :math:`(c_d, 1) / g_d` with slopes :math:`c_d` and
    :math:`g_d = \sqrt{1 + c_d^T c_d} / \sigma_d`: forward substitution is
    :math:`\varepsilon_d = g_d (z_d - \mu_d) - c_d^T \varepsilon_{<d}`, and the adjoint of
    :math:`-\varepsilon^T\varepsilon / 2` runs backward through it.
    """
    loc, deviation, slope = parts
    size = loc.shape[1]
    rows = [slope[:, _row(d)] for d in range(size)] if slope.size else []
    square = np.stack([1 + (row * row).sum(1) for row in rows], 1) if rows else np.ones(())
    scale = np.sqrt(square) / deviation
    scaled = scale * (value - loc)
    noise = scaled.copy() if rows else scaled
    for d, row in enumerate(rows):
        noise[:, d] -= (row * noise[:, :d]).sum(1)
    log_n = (np.log(scale) - 0.5 * noise * noise).sum(1) - size * _HALF_LOG_2_PI

    def pull(share: _Array) -> _Parts:
        share = share[:, None]
        adjoint = -share * noise
        for d in reversed(range(1, len(rows))):
            adjoint[:, :d] -= rows[d] * adjoint[:, d, None]
        by_log_scale = adjoint * scaled + share
        by_slope, by_square = np.empty_like(slope), by_log_scale / square if rows else square
        for d, row in enumerate(rows):
            of_noise = adjoint[:, d, None] * noise[:, :d]
            by_slope[:, _row(d)] = by_square[:, d, None] * row - of_noise
        return _Parts(-adjoint * scale, -by_log_scale / deviation, by_slope)

    return log_n, pull


def _row(d: int) -> slice:
    """Return where the slopes of row d of the factor are."""
    return slice(d * (d - 1) // 2, d * (d + 1) // 2)


def _restricted(log_n: _Array, pull_n: _Pull, mass: tuple[_Array, _Pull]) -> tuple[_Array, _Pull]:
    """Return densities over masses in the box, and what pulls back."""
    log_z, pull_z = mass

    def pull(share: _Array) -> _Parts:
        return _Parts(*(n - z for n, z in zip(pull_n(share), pull_z(share), strict=True)))

    return log_n - log_z, pull


def _masses(parts: _Parts, box: tuple[Tensor, Tensor], points: int) -> tuple[_Array, _Pull]:
    """Return the log of each component's mass in the box ``(K, N)``, and what pulls back."""
    edges = box[0].double().cpu(), box[1].double().cpu()
    return _correlated(parts, edges, points) if parts.slope.size else _independent(parts, edges)


def _independent(parts: _Parts, edges: tuple[Tensor, Tensor]) -> tuple[_Array, _Pull]:
    r"""Return it for diagonal factors, of which :math:`\partial_b \log Z = \phi(b) / Z`."""
    a, b = ((edge.numpy()[:, None] - parts.loc) / parts.deviation for edge in edges)
    each = log_interval_of_arrays(a, b)

    def pull(share: _Array) -> _Parts:
        outer = share[:, None] / parts.deviation
        by_a, by_b = (np.exp(-0.5 * x * x - each - _HALF_LOG_2_PI) for x in (a, b))
        return _Parts(outer * (by_a - by_b), outer * (a * by_a - b * by_b), parts.slope)

    return each.sum(1), pull


def _correlated(parts: _Parts, edges: tuple[Tensor, Tensor], points: int) -> tuple[_Array, _Pull]:
    """Return it by quasi-random points, and its gradient by autograd."""
    loc, deviation, slope = leaves = [
        torch.from_numpy(part).movedim(-1, 0).requires_grad_() for part in parts
    ]
    scale_tril = factor(deviation, slope)
    log_z = log_mass(loc, scale_tril, edges, diagonal=False, points=points)

    def pull(share: _Array) -> _Parts:
        found = torch.autograd.grad(log_z, leaves, torch.from_numpy(share.T))
        return _Parts(*(part.movedim(0, -1).numpy() for part in found))

    return log_z.detach().numpy().T, pull
