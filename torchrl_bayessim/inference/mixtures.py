r"""The algebra of Gaussian mixtures: density, moments, product, and division by a Gaussian.

A mixture :math:`\sum_k \alpha_k N(\mu_k, L_k L_k^T)` is the triple ``(logits, loc, scale_tril)`` of
shapes ``(*, K)``, ``(*, K, D)`` and ``(*, K, D, D)``.
"""

from __future__ import annotations

__all__ = [
    "Division",
    "Mixture",
    "component_log_prob",
    "divide",
    "moment_match",
    "multiply",
    "reduce",
]

import math
from typing import NamedTuple

import torch
from torch import Tensor


class Mixture(NamedTuple):
    """A Gaussian mixture.

    Attributes:
        logits: Log-weights (any constant may be added), shape ``(*, K)``.
        loc: Means, shape ``(*, K, D)``.
        scale_tril: Lower Cholesky factors of the covariances, shape ``(*, K, D, D)``.
    """

    logits: Tensor
    loc: Tensor
    scale_tril: Tensor

    @property
    def covariance(self) -> Tensor:
        """The components' covariances, shape ``(*, K, D, D)``."""
        return self.scale_tril @ self.scale_tril.mT


class Division(NamedTuple):
    """The quotient of a mixture by a Gaussian, and what had to be done to it.

    Attributes:
        mixture: The quotient.
        repaired: How many components had an indefinite precision that was repaired.
    """

    mixture: Mixture
    repaired: int


def component_log_prob(value: Tensor, loc: Tensor, scale_tril: Tensor) -> Tensor:
    """Return the log-density of each component at ``value``.

    Args:
        value: Points, shape ``(*, D)``.
        loc: Means, shape ``(*, K, D)``.
        scale_tril: Cholesky factors, shape ``(*, K, D, D)``.

    Returns:
        Log-densities of shape ``(*, K)``.
    """
    centred = value.unsqueeze(-2) - loc
    shape = torch.broadcast_shapes(centred.shape[:-1], scale_tril.shape[:-2])
    noise = torch.linalg.solve_triangular(
        scale_tril.expand(*shape, *scale_tril.shape[-2:]),
        centred.expand(*shape, -1).unsqueeze(-1),
        upper=False,
    ).squeeze(-1)
    log_volume = scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    normaliser = 0.5 * loc.shape[-1] * math.log(2 * math.pi)
    return -0.5 * noise.square().sum(-1) - log_volume - normaliser


def moment_match(mixture: Mixture) -> tuple[Tensor, Tensor]:
    r"""Return mean ``(*, D)`` and covariance ``(*, D, D)`` of the whole mixture.

    .. math::
        m = \sum_k \alpha_k \mu_k, \qquad
        S = \sum_k \alpha_k (\Sigma_k + (\mu_k - m)(\mu_k - m)^T),

    the spread between the components included.
    """
    weight = mixture.logits.softmax(-1).unsqueeze(-1)
    mean = (weight * mixture.loc).sum(-2)
    centred = mixture.loc - mean.unsqueeze(-2)
    second = mixture.covariance + centred.unsqueeze(-1) * centred.unsqueeze(-2)
    return mean, (weight.unsqueeze(-1) * second).sum(-3)


def multiply(first: Mixture, second: Mixture) -> Mixture:
    r"""Return the product of two mixtures of :math:`K_1` and :math:`K_2` components (exact).

    Every pair gives one component, with weight
    :math:`\alpha_i \beta_j N(\mu_i; \mu_j, \Sigma_i + \Sigma_j)`.
    """
    loc_1, loc_2 = torch.broadcast_tensors(first.loc.unsqueeze(-2), second.loc.unsqueeze(-3))
    cov_1, cov_2 = torch.broadcast_tensors(
        first.covariance.unsqueeze(-3), second.covariance.unsqueeze(-4)
    )
    total = torch.linalg.cholesky(cov_1 + cov_2)
    overlap = component_log_prob(loc_1, loc_2.unsqueeze(-2), total.unsqueeze(-3)).squeeze(-1)
    logits = first.logits.unsqueeze(-1) + second.logits.unsqueeze(-2) + overlap
    gain = torch.cholesky_solve(cov_2, total).mT  # Sigma_j (Sigma_i + Sigma_j)^-1
    loc = loc_2 + (gain @ (loc_1 - loc_2).unsqueeze(-1)).squeeze(-1)
    scale = torch.linalg.cholesky(_symmetric(gain @ cov_1))
    return Mixture(logits.flatten(-2), loc.flatten(-3, -2), scale.flatten(-4, -3))


def divide(
    mixture: Mixture, mean: Tensor, covariance: Tensor, *, max_variance: float = 1e2
) -> Division:
    r"""Divide a mixture by one Gaussian :math:`N(\mu_0, \Sigma_0)` (Papamakarios & Murray, 2016).

    .. math::
        \Sigma'_k = (\Sigma_k^{-1} - \Sigma_0^{-1})^{-1}, \quad
        \mu'_k = \Sigma'_k (\Sigma_k^{-1} \mu_k - \Sigma_0^{-1} \mu_0), \quad
        \log\alpha'_k = \log\alpha_k - \tfrac12 \lambda_k,

    with :math:`\lambda_k = \log\frac{|\Sigma_k|}{|\Sigma_0||\Sigma'_k|} +
    \mu_k^T\Sigma_k^{-1}\mu_k - \mu_0^T\Sigma_0^{-1}\mu_0 - \mu_k'^T\Sigma_k'^{-1}\mu'_k`
    (arXiv:1605.06376, appendix C; the BayesSim paper prints :math:`\Sigma_k^{-1}` for
    :math:`\Sigma'_k` in the mean, a misprint). The precision is indefinite wherever a component
    is wider than the divisor: there its eigenvalues are raised to ``1 / max_variance`` and the
    component is counted as repaired. A *mixture* divisor has no such formula; dividing by it
    component by component is wrong.

    Args:
        mixture: The dividend, in standardised coordinates.
        mean: :math:`\mu_0`, shape ``(*, D)``.
        covariance: :math:`\Sigma_0`, shape ``(*, D, D)``.
        max_variance: Largest variance that a repaired direction may have.

    Example:
        >>> wide = Mixture(torch.zeros(1), torch.zeros(1, 1), 2 * torch.ones(1, 1, 1))
        >>> quotient = divide(wide, torch.ones(1), 8 * torch.ones(1, 1))
        >>> quotient.mixture.loc.item(), quotient.repaired
        (-1.0, 0)
        >>> round(quotient.mixture.covariance.item(), 4)
        8.0
    """
    precision = torch.cholesky_inverse(mixture.scale_tril)
    precision_0 = torch.linalg.inv(covariance)
    shift = (precision @ mixture.loc.unsqueeze(-1)).squeeze(-1)
    shift_0 = (precision_0 @ mean.unsqueeze(-1)).squeeze(-1)
    values, vectors = torch.linalg.eigh(_symmetric(precision - precision_0.unsqueeze(-3)))
    bad = values < 1 / max_variance
    values = torch.where(bad, 1 / max_variance, values)
    new_covariance = _symmetric(vectors @ ((1 / values).unsqueeze(-1) * vectors.mT))
    combined = shift - shift_0.unsqueeze(-2)
    loc = (new_covariance @ combined.unsqueeze(-1)).squeeze(-1)
    log_det = 2 * mixture.scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    log_det_ratio = log_det - torch.logdet(covariance).unsqueeze(-1) + values.log().sum(-1)
    energy = (mixture.loc * shift).sum(-1) - (mean * shift_0).sum(-1).unsqueeze(-1)
    lam = log_det_ratio + energy - (loc * combined).sum(-1)
    quotient = Mixture(
        (mixture.logits - 0.5 * lam).log_softmax(-1), loc, torch.linalg.cholesky(new_covariance)
    )
    return Division(quotient, int(bad.any(-1).sum()))


def reduce(mixture: Mixture, components: int) -> Mixture:
    r"""Return an unbatched mixture of at most ``components``, by merging near pairs.

    Greedy, by the upper bound on the Kullback-Leibler loss of a merge (Runnalls, 2007, "Kullback-
    Leibler approach to Gaussian mixture reduction", IEEE T-AES 43, eq. 16):
    :math:`B_{ij} = \tfrac12[(\alpha_i + \alpha_j)\log|\Sigma_{ij}| - \alpha_i\log|\Sigma_i| -
    \alpha_j\log|\Sigma_j|]`. Components that together hold less than 1e-9 are dropped first.
    """
    logits, order = mixture.logits.log_softmax(-1).sort(descending=True)
    keep = max(1, int((logits.exp().flip(0).cumsum(0).flip(0) > 1e-9).sum()))
    weight = logits[:keep].exp()
    loc, cov = mixture.loc[order[:keep]], mixture.covariance[order[:keep]]
    while weight.numel() > components:
        i, j = _cheapest_merge(weight, loc, cov)
        pair = Mixture(weight[[i, j]].log(), loc[[i, j]], torch.linalg.cholesky(cov[[i, j]]))
        mean, covariance = moment_match(pair)
        rest = [k for k in range(weight.numel()) if k not in {i, j}]
        loc = torch.cat([loc[rest], mean[None]])
        cov = torch.cat([cov[rest], covariance[None]])
        weight = torch.cat([weight[rest], (weight[i] + weight[j])[None]])
    return Mixture(weight.log().log_softmax(-1), loc, torch.linalg.cholesky(cov))


def _cheapest_merge(weight: Tensor, loc: Tensor, cov: Tensor) -> tuple[int, int]:
    total = weight[:, None] + weight[None]
    share = weight[:, None] / total
    between = loc[:, None] - loc[None]
    outer = (share * (1 - share))[..., None, None] * between[..., None] * between[..., None, :]
    merged = share[..., None, None] * cov[:, None] + (1 - share)[..., None, None] * cov[None]
    log_det = torch.logdet(cov)
    cost = total * torch.logdet(merged + outer)
    cost = cost - weight[:, None] * log_det[:, None] - weight[None] * log_det[None]
    cost = cost + torch.diag(torch.full_like(weight, torch.inf))
    flat = int(cost.argmin())
    return flat // weight.numel(), flat % weight.numel()


def _symmetric(matrix: Tensor) -> Tensor:
    return (matrix + matrix.mT) / 2
