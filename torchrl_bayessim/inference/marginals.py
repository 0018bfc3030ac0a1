r"""Densities of single parameters under a posterior over several.

They are those of *scaled parameters*: each one's distance from the prior's mean in the prior's own
deviations of it, logarithms for logarithmic ones,

.. math::
    v_d = (u_d - m_d) / s_d, \qquad s_d^2 = (S S^T)_{dd}, \qquad v = R z, \qquad R = S / s,

with the :math:`u`, :math:`m` and :math:`S` of :mod:`.standardization`. Under a prior without
correlations R is 1 and v is z; under a correlated one no coordinate of z belongs to one parameter.
Without a box the marginal is the mixture of

.. math::
    N(v_d; (R \mu_k)_d, (R \Sigma_k R^T)_{dd}) .

Of a correlated Gaussian component restricted to a box (whose prior has no correlations), it is not
a truncated Gaussian:

.. math::
    q_d(z_d) = \sum_k \frac{\pi_k}{Z_k}\, N(z_d; \mu_{kd}, \Sigma_{kdd})\,
    P_k(\text{the other coordinates in the box} \mid z_d),

where the other coordinates given :math:`z_d` are Gaussian again, and their mass in the box is that
of :func:`.truncation.log_mass`.
"""

from __future__ import annotations

__all__ = ["marginal_log_prob"]

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.distributions import Normal

from .mixtures import component_log_prob
from .physics_posterior import PhysicsPosterior
from .priors import Prior
from .standardization import Standardization
from .truncated_normal import log_interval
from .truncation import INSIDE, TruncatedGaussianMixture, log_mass

_NEGLIGIBLE = 12.0  # nats below the others together: a hundred thousandth of them


def marginal_log_prob(posterior: PhysicsPosterior, theta: Tensor) -> Tensor:
    """Return the log-density of every parameter by itself, in its own units.

    Args:
        posterior: Batch shape ``(*)``.
        theta: Parameters, shape ``(*, D)``.

    Returns:
        Shape ``(*, D)``, ``-inf`` outside the prior's support.

    Example:
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> prior = BoxPrior({"mass": (2.0, 6.0), "drag": (0.0, 1.0)})
        >>> flat = TruncatedGaussianMixture(torch.zeros(1), torch.zeros(1, 2),
        ...     1e3 * torch.eye(2)[None], prior.box)
        >>> marginal_log_prob(PhysicsPosterior(flat, prior), torch.tensor([3.0, 0.5])).exp()
        tensor([0.2500, 1.0000])
    """
    posterior.prior._check_event(theta)
    here = theta.to(posterior.mixture.loc.device).double()
    density = scaled_marginals(posterior, one_by_one(posterior.prior)._inverse(here))
    density = density - log_volume(posterior.prior, here)
    return density.to(theta.device, torch.get_default_dtype())


def one_by_one(prior: Prior) -> Standardization:
    r"""Return the scaling :math:`v \mapsto \theta` of each parameter by itself.

    Example:
        >>> from torchrl_bayessim.inference.priors import GaussianPrior
        >>> rho = torch.tensor([[1.0, 0.6], [0.6, 1.0]])
        >>> prior = GaussianPrior({"a": (0.0, 1.0), "b": (1.0, 2.0)}, correlation=rho)
        >>> one_by_one(prior)(torch.tensor([0.0, 1.0]))
        tensor([0., 3.])
    """
    whole = prior.standardization
    return Standardization(whole.mean, torch.diag(whole.scale_tril.norm(dim=-1)), whole.log)


def turn(prior: Prior) -> Tensor:
    """Return R of ``v = R z``, lower triangular with rows of norm 1, shape ``(D, D)``."""
    scale = prior.standardization.scale_tril
    return scale / scale.norm(dim=-1, keepdim=True)


def scaled_marginals(posterior: PhysicsPosterior, v: Tensor) -> Tensor:
    """Return the log-density of every scaled parameter by itself, float64.

    Args:
        posterior: Batch shape ``(*)``.
        v: Scaled parameters, which are precise where the parameters are rounded; shape ``(*, D)``.

    Returns:
        Shape ``(*, D)``.
    """
    mixture, box = posterior.mixture, posterior.mixture.box
    if box is None:
        return _unbounded(mixture, v, turn(posterior.prior).to(v))
    return torch.stack([_bounded(mixture, box, v[..., d], d) for d in range(v.shape[-1])], -1)


def log_volume(prior: Prior, theta: Tensor) -> Tensor:
    r"""Return :math:`\log |\partial\theta_d / \partial v_d|`, shape ``(*, D)``."""
    log = prior.standardization.log.to(theta.device)
    slope = prior.standardization.scale_tril.norm(dim=-1).log().to(theta.device)
    return slope + torch.where(log, torch.where(log, theta, 1.0).abs().log(), 0.0)


def _unbounded(mixture: TruncatedGaussianMixture, v: Tensor, turned: Tensor) -> Tensor:
    deviation = (turned @ mixture.scale_tril).norm(dim=-1)
    each = Normal(mixture.loc @ turned.mT, deviation, validate_args=False)
    return (mixture.logits.unsqueeze(-1) + each.log_prob(v.unsqueeze(-2))).logsumexp(-2)


def _bounded(
    mixture: TruncatedGaussianMixture, box: tuple[Tensor, Tensor], z: Tensor, d: int
) -> Tensor:
    """Return the log-density of coordinate d at ``z``, shape ``(*)``."""
    covariance = mixture.scale_tril @ mixture.scale_tril.mT
    deviation = covariance[..., d, d].sqrt()[..., None, None]
    own = component_log_prob(z.unsqueeze(-1), mixture.loc[..., d : d + 1], deviation)
    low, high = box
    slack = 1e-6 * (high[d] - low[d])
    inside = z.isfinite() & (z >= low[d] - slack) & (z <= high[d] + slack)
    each = mixture.logits + own - mixture.log_mass
    others = [i for i in range(len(low)) if i != d]
    if others:
        cross = covariance[..., others, d] / covariance[..., d, d].unsqueeze(-1)
        shift = torch.where(inside, z, 0.0)[..., None] - mixture.loc[..., d]
        loc = mixture.loc[..., others] + cross * shift.unsqueeze(-1)
        left = covariance[..., others, :][..., others]
        left = left - cross.unsqueeze(-1) * covariance[..., others, d].unsqueeze(-2)
        # rounding may leave a nearly singular remainder not quite positive
        left = left + 1e-12 * torch.eye(len(others)).to(left)
        scale = torch.linalg.cholesky(left).expand(*loc.shape[:-1], *left.shape[-2:])
        diagonal = mixture.diagonal or len(others) == 1
        mass = partial(_mass, box=(low[others], high[others]), diagonal=diagonal)
        each = _reduced(each, lambda which: mass(loc[which], scale[which]))
    return torch.where(inside, each.logsumexp(-1), -torch.inf)


def _reduced(each: Tensor, less: Callable[[Tensor], Tensor]) -> Tensor:
    """Return terms ``(*, K)`` with what reduces them, wherever a term is not negligible anyway.

    Args:
        each: Upper bounds of the terms, logarithms.
        less: Returns what is to be added to some of them, which takes long; at most 0.
    """
    known = torch.zeros_like(each, dtype=torch.bool)
    asked = each > each.amax(-1, keepdim=True) - _NEGLIGIBLE
    while asked.any():
        each, known = each.masked_scatter(asked, each[asked] + less(asked)), known | asked
        sure = torch.where(known, each, -torch.inf).logsumexp(-1, keepdim=True)
        asked = ~known & (each > sure - _NEGLIGIBLE)
    return torch.where(known, each, -torch.inf)


def _mass(loc: Tensor, scale_tril: Tensor, box: tuple[Tensor, Tensor], *, diagonal: bool) -> Tensor:
    """Return the log of the mass inside the box; exact where one coordinate alone is cut off.

    That is so of most components where the data say little of one parameter and much of the rest.
    """
    scale = scale_tril.norm(dim=-1)
    a, b = (box[0] - loc) / scale, (box[1] - loc) / scale
    cut = torch.maximum(a, -b) > -INSIDE
    mass = torch.where(cut, log_interval(a, b), 0.0).sum(-1)
    several = cut.sum(-1) > 1
    if diagonal or not several.any():
        return mass
    found = log_mass(loc[several], scale_tril[several], box, diagonal=False)
    return mass.masked_scatter(several, found)
