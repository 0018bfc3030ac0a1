r"""How much less n trajectories say together than n independent answers would.

A network's answer to a trajectory leaves two things open: what this trajectory does not say, which
the next one may, and what the network does not know, which it leaves open again. A product of n
answers takes all of it for the first. Of observations that share a part :math:`\rho` of their
variance (the intraclass correlation), n are worth

.. math::
    \frac{n}{1 + (n - 1) \rho}

independent ones; the denominator is the design effect (Kish, 1965, *Survey Sampling*, section 5.4).
Here the observations are the answers' scores

.. math::
    s = \frac{\partial}{\partial \theta} \log \frac{q(\theta \mid x)}{p(\theta)} .

At the true parameters those of a right posterior have mean 0 over trajectories, whatever the
parameters are; what is not 0 on average is the network's. So each answer is made wider in every
parameter by the root of the design effect before they are multiplied.

Two lower bounds of :math:`\rho` need no further simulations, and the larger one is taken:

* **Neighbours** of a fit: pairs of nearly the same parameters have scores at their own parameters
  that are nearly those of two trajectories of one system.
* **Rows**: answers to the n real trajectories scatter by what differs between these. Answers that
  lie much closer together than each of them is wide leave the rest open together; where a parameter
  does nothing, they leave all of it.
"""

from __future__ import annotations

__all__ = ["shared_by_neighbours", "shared_by_rows", "widened"]

import torch
from scipy.stats import chi2
from torch import Tensor

from .mixtures import Mixture, moment_match

_NEIGHBOURS = 3
_FARTHEST = 3.0  # deviations, beyond which a score says no more
_SURE = 0.05  # chance of rows that share nothing to lie so close together


def shared_by_neighbours(each: Mixture, z: Tensor, *, bounded: bool) -> Tensor:
    """Return the share of the scores' mean square that pairs of near parameters have in common.

    Args:
        each: The answer to every pair's summary, whatever a box cuts off, batch shape ``(N,)``.
        z: Its parameters in standardised coordinates, shape ``(N, D)``.
        bounded: Whether the prior is a box (constant in these coordinates) or N(0, I).

    Returns:
        One share in ``[0, 1]`` for each parameter, shape ``(D,)``.

    Example:
        >>> z = torch.linspace(-1, 1, 200, dtype=torch.float64)[:, None]
        >>> g = torch.Generator().manual_seed(0)
        >>> noise = torch.randn(2, 200, 1, generator=g, dtype=torch.float64) / 2**0.5
        >>> scale = torch.ones(200, 1, 1, 1, dtype=torch.float64)
        >>> answers = lambda loc: Mixture(0 * loc, loc[:, None], scale)
        >>> own = shared_by_neighbours(answers(z + noise.sum(0)), z, bounded=True)
        >>> common = shared_by_neighbours(answers(z + noise[0] + 0.7), z, bounded=True)
        >>> own.item() < 0.1, 0.4 < common.item() < 0.6
        (True, True)
    """
    if len(z) < 2:
        return z.new_zeros(z.shape[-1])
    score = _score(each, z, bounded=bounded).clamp(-_FARTHEST, _FARTHEST)
    apart = torch.cdist(z, z).fill_diagonal_(torch.inf)
    near = apart.topk(min(_NEIGHBOURS, len(z) - 1), largest=False).indices
    common = (score.unsqueeze(1) * score[near]).mean((0, 1))
    return (common / score.square().mean(0).clamp_min(1e-12)).clamp(0.0, 1.0)


def _score(mixture: Mixture, z: Tensor, *, bounded: bool) -> Tensor:
    """Return the scores of answers at ``z``, times the answers' deviations, ``(N, D)``."""
    precision = torch.cholesky_inverse(mixture.scale_tril)
    away = (z.unsqueeze(-2) - mixture.loc).unsqueeze(-1)
    pull = -(precision @ away).squeeze(-1)
    height = 0.5 * (pull * away.squeeze(-1)).sum(-1)
    height = height - mixture.scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    share = (mixture.logits + height).softmax(-1)
    score = (share.unsqueeze(-1) * pull).sum(-2) + (0 if bounded else z)
    _, covariance = moment_match(mixture)
    return score * covariance.diagonal(dim1=-2, dim2=-1).sqrt()


def shared_by_rows(each: Mixture, *, bounded: bool) -> Tensor:
    r"""Return the least share that answers to n trajectories of one system have in common.

    In Gaussian terms, with :math:`\Lambda_i` and :math:`\mu_i` of each answer, scores at one point
    have the variance :math:`(1 - \rho) \bar\Lambda` over trajectories. It is the least :math:`\rho`
    that :math:`(n - 1) V / (1 - \rho) \bar\Lambda \sim \chi^2_{n-1}` allows at 5 %.

    Args:
        each: The answers, batch shape ``(n,)``.
        bounded: As of :func:`shared_by_neighbours`.

    Returns:
        One share in ``[0, 1]`` for each parameter, shape ``(D,)``.

    Example:
        >>> scale = torch.ones(20, 1, 1, 1, dtype=torch.float64)
        >>> answers = lambda loc: Mixture(0 * loc[:, None], loc[:, None, None], scale)
        >>> x = torch.randn(20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> shared_by_rows(answers(x), bounded=True).item()
        0.0
        >>> shared_by_rows(answers(x / 10), bounded=True).item() > 0.9
        True
    """
    mean, covariance = moment_match(each)
    n, size = mean.shape
    if n < 2:
        return mean.new_zeros(size)
    precision = torch.linalg.inv(covariance)
    middle = torch.linalg.solve(precision.sum(0), (precision @ mean.unsqueeze(-1)).sum(0))
    score = (precision @ (mean.unsqueeze(-1) - middle)).squeeze(-1)
    claimed = precision.diagonal(dim1=-2, dim2=-1).mean(0) - (0.0 if bounded else 1.0)
    most = (n - 1) * score.var(0) / float(chi2.ppf(_SURE, n - 1))
    share = (1 - most / claimed.clamp_min(1e-12)).clamp(0.0, 1.0)
    return torch.where(claimed > 0, share, torch.zeros_like(share))


def widened(each: Mixture, shared: Tensor, *, bounded: bool) -> Mixture:
    r"""Return answers to n trajectories of which the product is as sure as they are together.

    The likelihood of each component, :math:`N(\mu, \Lambda^{-1}) / p`, is made wider by the root of
    the design effect: :math:`\Lambda \to F \Lambda F` with :math:`F = \operatorname{diag}(1 + (n -
    1) \rho)^{-1/2}`, for a Gaussian prior :math:`I - F^2 + F \Lambda F`.

    Args:
        each: The answers, batch shape ``(n,)``.
        shared: The share :math:`\rho` of each parameter, shape ``(D,)``.
        bounded: As of :func:`shared_by_neighbours`.
    """
    wider = (1 + (len(each.loc) - 1) * shared.to(each.loc)).sqrt()
    if (wider == 1).all():
        return each
    scale = wider.unsqueeze(-1) * each.scale_tril
    if bounded:
        return each._replace(scale_tril=scale)
    precision = torch.cholesky_inverse(scale)
    pull = precision @ each.loc.unsqueeze(-1)
    total = precision + torch.diag(1 - wider.pow(-2))
    loc = torch.linalg.solve(total, pull).squeeze(-1)
    return Mixture(each.logits, loc, torch.linalg.cholesky(torch.linalg.inv(total)))
