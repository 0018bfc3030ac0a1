r"""How wide a fitted posterior, or an average of several, is to be: as held-out pairs like best.

A network is surer of the pairs that it learned from than of others, and of a parameter that they
say nothing about most of all. A factor on the deviations of each parameter, learned from the
others, undoes most of it (after temperature scaling, Guo et al., 2017, arXiv:1706.04599). An
average of networks that disagree is wider than each of them already: it may need less than 1. Where
it is sharp it is too wide, and too sure where it is not: a power of the deviations, too, is learned
for an average, :math:`\sigma \to f_d\, m_d (\sigma / m_d)^{c_d}` with :math:`m_d` their geometric
mean. And as it is right for some pairs and off for others, its errors have heavier tails than its
components: it learns how much heavier, a ratio r of :func:`.network.heavy_tailed`.

Networks that err apart have an average of means, :math:`\bar\mu`, that errs less than each of
them; but the average of their answers is as wide as they lie apart, and the truth too often in its
middle. So an average learns, too, which share :math:`a_d` of the way from :math:`\bar\mu` to each
network's mean is left: :math:`\mu_m \to \bar\mu + a (\mu_m - \bar\mu)`. At 0 they have one mean.

Factors, powers, the ratio and shares maximise

.. math::
    \sum_i \log q_{f, c, r, a}(\theta_i \mid x_i) - \sum_d \log(1 + (\log (f_d / f_0) / s)^2)
    - \sum_d \log(1 + (\log c_d / s)^2) - \log(1 + (\log (r / r_0) / s_r)^2)
    - \sum_d \log(1 + ((a_d - 1) / s_a)^2)

over the held-out pairs (by their weights, which sum to the effective number of pairs): they stay
near :math:`f_0`, which is 1 for averages and 1.1 for a network alone, near 1, :math:`r_0` and 1,
unless the pairs say otherwise, and follow them freely where they do, as those of a parameter that
nothing is known about must. :math:`\log r_0 = 0.55` was likeliest for other pairs of three
problems of four and near it for the fourth (Hopper, pendulum, CartPole, mountain car; 3,200 truths
each, of 0, 0.35, 0.55 and 0.75).
"""

from __future__ import annotations

__all__ = ["average", "learn_shared", "widen"]

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from .design_effect import shared_by_neighbours
from .network import Components, widened
from .posterior import TRAINING_POINTS, MixtureDensityPosterior
from .truncation import TruncatedGaussianMixture
from .weights import effective_sample_size, weights_of

_NARROWEST, _WIDEST = 0.5, 10.0
_STEEPEST = 2.0  # power of deviations
_NEAR = 0.15  # s: what a hundred pairs leave unsure
_USUAL_TAILS, _NEAR_TAILS = 0.55, 0.3  # log r_0, and s of log r
_HEAVIEST = 3.0  # r
_NEAR_APART = 0.5  # s of a
_TOO_SURE = 1.1  # what a network alone needs, where the pairs are too few to say
_MOST = 2000  # held-out pairs that are used, those of the largest weight


def widen(networks: Sequence[MixtureDensityPosterior], held_out: TensorDictBase) -> Tensor:
    """Set what is done to deviations so that held-out pairs are likeliest; return the factors.

    Args:
        networks: Changed in place; several get the same, which suits their average. One alone is
            never made surer.
        held_out: Pairs ``{"theta", "summary"[, "weight"]}`` that no network learned from.

    Returns:
        Factors on the geometric means of the parameters' deviations, shape ``(D,)``.
    """
    first, alone = networks[0], len(networks) == 1
    weight = weights_of(held_out)
    counting = (-weight).argsort(stable=True)[: min(_MOST, int((weight > 0).sum()))]
    held_out, weight = held_out[counting], weight[counting]
    z = first.prior.standardize(held_out.get(first.theta_key).double())
    weight, pairs = (weight / weight.sum()).to(z), effective_sample_size(weight)
    with torch.no_grad():
        summary = held_out.get(first.summary_key)
        said = [n.network.components_of(n.network.raw(n.network.scaled(summary))) for n in networks]
        middle = torch.stack([_log_mean(own, weight) for own in said]).mean(0)
        together, nearer = _as_one(said)
    size = len(middle)
    usual = torch.tensor(_usual(size, alone=alone)).to(z)
    near = torch.tensor([_NEAR] * (2 * size) + [_NEAR_TAILS] + [_NEAR_APART] * size).to(z)

    def scales(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what is to be done to deviations: a factor, before that a power, and tails."""
        log_factors, log_powers, tails, _ = values.split([size, size, 1, size])
        powers = log_powers.exp()
        return (log_factors + (1 - powers) * middle).exp(), powers, tails[: 0 if alone else 1]

    def loss(given: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        with torch.enable_grad():
            values = torch.as_tensor(given).to(z).requires_grad_()
            *scaling, shares = *scales(values), values[-size:]
            moved = together._replace(loc=together.loc + (1 - shares).to(nearer) * nearer)
            mixture = TruncatedGaussianMixture(
                *widened(moved, *(scale.to(nearer) for scale in scaling)),
                first.prior.box,
                diagonal=not together.slope.shape[-1],
                points=TRAINING_POINTS,
            )
            away = (values - usual) / near
            total = away.square().log1p().sum() / pairs
            total = total - (mixture.formula(z) * weight).sum()
            (gradient,) = torch.autograd.grad(total, values)
        return total.item(), gradient.double().cpu().numpy().ravel()

    options = {"maxiter": 15, "ftol": 1e-6}
    start = usual.double().cpu().numpy().copy()
    start[: 2 * size] = 0.0  # and not at 0 for tails, where the loss does not change with them
    found = minimize(
        loss,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=_bounds(size, alone=alone),
        options=options,
    )
    values = torch.as_tensor(found.x).to(z)
    widening, contrast, tails = scales(values)
    for network in networks:
        network.network.widening.copy_(widening)
        network.network.contrast.copy_(contrast)
        network.network.tails = tails.to(network.network.tails)
        network.network.apart.copy_(values[-size:])
    return values[:size].exp()


@torch.no_grad()
def learn_shared(posterior: MixtureDensityPosterior, pairs: TensorDictBase) -> None:
    """Set how much of what its answers leave open several trajectories leave open together.

    Args:
        posterior: As wide as it is to be; changed in place.
        pairs: Some of those of its fit: see :func:`.design_effect.shared_by_neighbours`.
    """
    summary = pairs.get(posterior.summary_key)
    with torch.autocast(posterior.device.type, enabled=False):
        each = posterior.distribution(summary, points=TRAINING_POINTS).mixture.untruncated
    z = posterior.prior.standardize(pairs.get(posterior.theta_key)).to(each.loc)
    bounded = posterior.prior.box is not None
    shared, at_edges = shared_by_neighbours(each, z, bounded=bounded)
    posterior.network.shared.copy_(shared)
    posterior.network.shared_at_edges.copy_(at_edges)


def _usual(size: int, *, alone: bool) -> list[float]:
    """Return the logarithms of factors, powers and ratio, and shares, of pairs that say nothing."""
    factor, tails = (math.log(_TOO_SURE), 0.0) if alone else (0.0, _USUAL_TAILS)
    return [factor] * size + [0.0] * size + [tails] + [1.0] * size


def _bounds(size: int, *, alone: bool) -> list[tuple[float, float]]:
    """Return the least and the largest of them."""
    if alone:
        return [(0.0, math.log(_WIDEST))] * size + [(0.0, 0.0)] * (size + 1) + [(1.0, 1.0)] * size
    factors = [(math.log(_NARROWEST), math.log(_WIDEST))] * size
    steepest = math.log(_STEEPEST)
    powers, shares = [(-steepest, steepest)] * size, [(0.0, 1.0)] * size
    return [*factors, *powers, (0.0, math.log(_HEAVIEST)), *shares]


def _log_mean(said: Components, weight: Tensor) -> Tensor:
    """Return the mean logarithm of each parameter's deviations, ``(D,)``."""
    each = said.logits.softmax(-1).unsqueeze(-1) * said.deviation.log()
    return weight @ each.sum(-2).to(weight)


def _as_one(said: Sequence[Components]) -> tuple[Components, Tensor]:
    """Return the components of all networks, and the way from their means to that of all.

    What networks say is the same whatever is done to it: one mixture of all of them is made of it
    again and again, in a third of the time that one for each takes.
    """
    ways = _ways(said)
    correlated = max(own.slope.shape[-1] for own in said)
    together = Components(
        torch.cat([own.logits.log_softmax(-1) for own in said], -1),
        torch.cat([own.loc for own in said], -2),
        torch.cat([own.deviation for own in said], -2),
        torch.cat([pad(own.slope, (0, correlated - own.slope.shape[-1])) for own in said], -2),
    )
    return together, torch.cat(
        [w.expand_as(own.loc) for w, own in zip(ways, said, strict=True)], -2
    )


def average(
    members: Sequence[TruncatedGaussianMixture], apart: Tensor | None = None
) -> TruncatedGaussianMixture:
    """Return the mixture of mixtures, all with the same weight.

    Args:
        members: Of the same box and batch shape.
        apart: Which share of the way from the average of their means to its own each keeps, in
            every parameter, shape ``(D,)``; default all of it.

    Example:
        >>> one, two = (
        ...     TruncatedGaussianMixture(torch.zeros(1), torch.full((1, 1), at), torch.eye(1)[None],
        ...                              None)
        ...     for at in (-1.0, 1.0)
        ... )
        >>> both = average([one, two])
        >>> both.logits.exp()
        tensor([0.5000, 0.5000], dtype=torch.float64)
        >>> average([one, two], torch.tensor([0.2])).loc.flatten()
        tensor([-0.2000,  0.2000], dtype=torch.float64)
    """
    if len(members) == 1:
        return members[0]
    loc = [member.loc for member in members]
    if apart is not None:
        ways = _ways(members)
        nearer = (1 - apart.to(ways)) * ways
        loc = [own + by for own, by in zip(loc, nearer, strict=True)]
    return TruncatedGaussianMixture(
        torch.cat([member.logits for member in members], -1),
        torch.cat(loc, -2),
        torch.cat([member.scale_tril for member in members], -3),
        members[0].box,
        diagonal=all(member.diagonal for member in members),
        points=members[0].points,
    )


def _ways(members: Sequence[Components] | Sequence[TruncatedGaussianMixture]) -> Tensor:
    """Return the way from each member's mean to the mean of all, ``(M, *, 1, D)``.

    Means of components' means: what a box cuts off is no matter.
    """
    each = [(member.logits.softmax(-1).unsqueeze(-1) * member.loc).sum(-2) for member in members]
    means = torch.stack(each)
    return (means.mean(0) - means).unsqueeze(-2)
