r"""Densities of single parameters under a posterior over several.

Of a correlated Gaussian component restricted to a box, the marginal of coordinate d is not a
truncated Gaussian:

.. math::
    q_d(z_d) = \sum_k \frac{\pi_k}{Z_k}\, N(z_d; \mu_{kd}, \Sigma_{kdd})\,
    P_k(\text{the other coordinates in the box} \mid z_d),

where the other coordinates given :math:`z_d` are Gaussian again, and their mass in the box is that
of :func:`.truncation.log_mass`.
"""

from __future__ import annotations

__all__ = ["marginal_log_prob"]

import torch
from torch import Tensor

from .mixtures import component_log_prob
from .physics_posterior import PhysicsPosterior
from .truncation import TruncatedGaussianMixture, log_mass


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
    prior, mixture = posterior.prior, posterior.mixture
    theta = theta.double()
    z = prior.standardize(theta)
    columns = [_marginal(mixture, z[..., d], d) for d in range(z.shape[-1])]
    # the scaling is per parameter up to a prior's correlation, which has its own volume
    slope = prior.standardization.scale_tril.norm(dim=-1).log()
    log = prior.standardization.log
    volume = slope + torch.where(log, torch.where(log, theta, 1.0).abs().log(), 0.0)
    density = torch.stack(columns, -1) - volume
    return density.to(torch.get_default_dtype())


def _marginal(mixture: TruncatedGaussianMixture, z: Tensor, d: int) -> Tensor:
    """Return the log-density of coordinate d at ``z``, shape ``(*)``."""
    covariance = mixture.scale_tril @ mixture.scale_tril.mT
    deviation = covariance[..., d, d].sqrt()[..., None, None]
    own = component_log_prob(z.unsqueeze(-1), mixture.loc[..., d : d + 1], deviation)
    if mixture.box is None:
        return (mixture.logits + own).logsumexp(-1)
    low, high = mixture.box
    slack = 1e-6 * (high[d] - low[d])
    inside = z.isfinite() & (z >= low[d] - slack) & (z <= high[d] + slack)
    others = [i for i in range(len(low)) if i != d]
    rest = torch.zeros_like(own)
    if others:
        cross = covariance[..., others, d] / covariance[..., d, d].unsqueeze(-1)
        shift = torch.where(inside, z, 0.0)[..., None] - mixture.loc[..., d]
        loc = mixture.loc[..., others] + cross * shift.unsqueeze(-1)
        left = covariance[..., others, :][..., others]
        left = left - cross.unsqueeze(-1) * covariance[..., others, d].unsqueeze(-2)
        # rounding may leave a nearly singular remainder not quite positive
        left = left + 1e-12 * torch.eye(len(others), dtype=left.dtype)
        scale = torch.linalg.cholesky(left).expand(*loc.shape[:-1], *left.shape[-2:])
        box = (low[others], high[others])
        rest = log_mass(loc, scale, box, diagonal=mixture.diagonal or len(others) == 1)
    total = (mixture.logits + own + rest - mixture.log_mass).logsumexp(-1)
    return torch.where(inside, total, -torch.inf)
