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
import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from ..counts import check_count
from ..errors import message
from .mixture_checks import check_covariance, check_mixture, check_together, first_marked

_ROUNDING = 1e-9  # of the widest variance
_THINNEST = 1e-12


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
        repaired: Which components would have been wider than allowed, boolean, shape ``(*, K)``.
    """

    mixture: Mixture
    repaired: Tensor


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
    # forward substitution by hand: a library call per matrix costs more where D is small
    noise: list[Tensor] = []
    for d in range(loc.shape[-1]):
        rest = centred[..., d]
        if noise:
            rest = rest - (scale_tril[..., d, :d] * torch.stack(noise, -1)).sum(-1)
        noise.append(rest / scale_tril[..., d, d])
    square = torch.stack(noise, -1).square().sum(-1)
    log_volume = scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    normaliser = 0.5 * loc.shape[-1] * math.log(2 * math.pi)
    return -0.5 * square - log_volume - normaliser


def moment_match(mixture: Mixture) -> tuple[Tensor, Tensor]:
    r"""Return mean ``(*, D)`` and covariance ``(*, D, D)`` of the whole mixture.

    .. math::
        m = \sum_k \alpha_k \mu_k, \qquad
        S = \sum_k \alpha_k (\Sigma_k + (\mu_k - m)(\mu_k - m)^T),

    the spread between the components included.

    Raises:
        ValueError: A parameter is not finite, all weights are 0, or shapes, dtypes and factors are
            those of no mixture.
    """
    check_mixture(*mixture)
    return _moments(mixture)


def _moments(mixture: Mixture) -> tuple[Tensor, Tensor]:
    weight = mixture.logits.softmax(-1).unsqueeze(-1)
    mean = (weight * mixture.loc).sum(-2)
    centred = mixture.loc - mean.unsqueeze(-2)
    second = mixture.covariance + centred.unsqueeze(-1) * centred.unsqueeze(-2)
    return mean, (weight.unsqueeze(-1) * second).sum(-3)


def multiply(first: Mixture, second: Mixture) -> Mixture:
    r"""Return the product of two mixtures of :math:`K_1` and :math:`K_2` components (exact).

    Every pair gives one component, with weight
    :math:`\alpha_i \beta_j N(\mu_i; \mu_j, \Sigma_i + \Sigma_j)`.

    Components that have collapsed to a point are widened, with a warning, to 1e-6 of the mixture's
    own deviation.

    Raises:
        ValueError: As :func:`moment_match`, a mixture is a single point, or they differ in D, dtype
            or device, or in batch shapes that do not broadcast.
    """
    first, second = _spread_out(first), _spread_out(second)
    sizes = first.loc.shape[-1], second.loc.shape[-1]
    if sizes[0] != sizes[1]:
        raise ValueError(message(f"a second mixture of {sizes[0]} dimensions", sizes[1]))
    check_together({"the first mixture": (first.loc, 2), "the second": (second.loc, 2)})
    loc_1, loc_2 = torch.broadcast_tensors(first.loc.unsqueeze(-2), second.loc.unsqueeze(-3))
    cov_1, cov_2 = torch.broadcast_tensors(
        first.covariance.unsqueeze(-3), second.covariance.unsqueeze(-4)
    )
    total = _cholesky(cov_1 + cov_2)
    overlap = component_log_prob(loc_1, loc_2.unsqueeze(-2), total.unsqueeze(-3)).squeeze(-1)
    logits = first.logits.unsqueeze(-1) + second.logits.unsqueeze(-2) + overlap
    gain = torch.cholesky_solve(cov_2, total).mT  # Sigma_j (Sigma_i + Sigma_j)^-1
    loc = loc_2 + (gain @ (loc_1 - loc_2).unsqueeze(-1)).squeeze(-1)
    scale = _cholesky(_symmetric(gain @ cov_1))
    return Mixture(logits.flatten(-2), loc.flatten(-3, -2), scale.flatten(-4, -3))


def divide(mixture: Mixture, mean: Tensor, covariance: Tensor, *, widest: Tensor) -> Division:
    r"""Divide a mixture by one Gaussian :math:`N(\mu_0, \Sigma_0)` (Papamakarios & Murray, 2016).

    .. math::
        \Sigma'_k = (\Sigma_k^{-1} - \Sigma_0^{-1})^{-1}, \quad
        \mu'_k = \Sigma'_k (\Sigma_k^{-1} \mu_k - \Sigma_0^{-1} \mu_0), \quad
        \alpha'_k = \alpha_k \frac{N(\theta; \mu_k, \Sigma_k)}
        {N(\theta; \mu_0, \Sigma_0)\, N(\theta; \mu'_k, \Sigma'_k)}

    at any :math:`\theta`, here at :math:`\mu_k` (arXiv:1605.06376, appendix C; the BayesSim paper
    prints :math:`\Sigma_k^{-1}` for :math:`\Sigma'_k` in the mean, a misprint). The precision is
    indefinite wherever a component is wider than the divisor. A component that would be wider than
    ``widest`` in some direction gets that width there, its mean stays where it was, and it keeps
    its mass times the ratio at its mean: a wide component of the same height would have as much
    more mass as it is wider, and take over. A *mixture* divisor has no such formula; dividing by it
    component by component is wrong.

    Args:
        mixture: The dividend, in standardised coordinates.
        mean: :math:`\mu_0`, shape ``(*, D)``.
        covariance: :math:`\Sigma_0`, shape ``(*, D, D)``.
        widest: The covariance :math:`B` that no component may exceed, shape ``(D, D)``: every
            :math:`B - \Sigma'_k` is positive semidefinite.

    Raises:
        ValueError: As :func:`moment_match`, the dividend is a single point, the divisor or
            ``widest`` has another D, dtype, device or batch shape, or a covariance is asymmetric,
            or indefinite by more than rounding.

    Example:
        >>> wide = Mixture(torch.zeros(1), torch.zeros(1, 1), 2 * torch.ones(1, 1, 1))
        >>> quotient = divide(wide, torch.ones(1), 8 * torch.ones(1, 1), widest=9 * torch.eye(1))
        >>> quotient.mixture.loc.item(), quotient.repaired.item()
        (-1.0, False)
        >>> round(quotient.mixture.covariance.item(), 4)
        8.0
    """
    mixture = _spread_out(mixture)
    given = {"the mixture": (mixture.loc, 2), "the mean of the divisor": (mean, 1)}
    check_together({**given, "its covariance": (covariance, 2), "widest": (widest, 2)})
    size = mixture.loc.shape[-1]
    if mean.shape[-1:] != (size,):
        raise ValueError(message(f"a mean of the divisor of shape (*, {size})", tuple(mean.shape)))
    check_covariance("the covariance of the divisor", covariance, size)
    check_covariance("widest", widest, size)
    if widest.ndim != 2:
        raise ValueError(message(f"one widest, of shape ({size}, {size})", tuple(widest.shape)))
    scale_0 = _cholesky(covariance)
    if not mean.isfinite().all():
        raise ValueError(message("a finite mean of the divisor", mean.tolist()))
    if not mixture.scale_tril.diagonal(dim1=-2, dim2=-1).all():  # thin as a line or a sheet
        mixture = mixture._replace(scale_tril=_cholesky(mixture.covariance))
    precision = torch.cholesky_inverse(mixture.scale_tril)
    precision_0, singular = torch.linalg.inv_ex(covariance)
    thin = singular.bool()[..., None, None]
    precision_0 = torch.where(thin, torch.cholesky_inverse(scale_0), precision_0).unsqueeze(-3)
    shift = precision @ mixture.loc.unsqueeze(-1) - precision_0 @ mean[..., None, :, None]
    # in coordinates where the widest covariance is the identity
    unit = _cholesky(widest)
    values, vectors = torch.linalg.eigh(_symmetric(unit.mT @ (precision - precision_0) @ unit))
    bad = values < 1 - 1e-9
    values = values.clamp_min(1.0)
    # a mean far away, and with it an enormous weight, would be read off a badly known difference
    back = unit @ vectors
    stay = torch.linalg.solve(back, mixture.loc.unsqueeze(-1))
    solved = (back.mT @ shift) / values.unsqueeze(-1)
    loc = (back @ torch.where(bad.unsqueeze(-1), stay, solved)).squeeze(-1)
    scale = _cholesky(_symmetric(back @ (back / values.unsqueeze(-2)).mT))
    own = -mixture.scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    own = own - 0.5 * mixture.loc.shape[-1] * math.log(2 * math.pi)
    at = scale_0[..., None, None, :, :]
    divisor = component_log_prob(mixture.loc, mean[..., None, None, :], at).squeeze(-1)
    raised = component_log_prob(mixture.loc, loc.unsqueeze(-2), scale.unsqueeze(-3)).squeeze(-1)
    repaired = bad.any(-1)
    widening = torch.where(repaired, (own - raised).clamp(max=0.0), own - raised)
    logits = (mixture.logits - divisor + widening).log_softmax(-1)
    return Division(Mixture(logits, loc, scale), repaired)


def reduce(mixture: Mixture, components: int) -> Mixture:
    r"""Return an unbatched mixture of at most ``components``, by merging near pairs.

    Greedy, by the upper bound on the Kullback-Leibler loss of a merge (Runnalls, 2007, "Kullback-
    Leibler approach to Gaussian mixture reduction", IEEE T-AES 43, eq. 16), some pairs at once of
    which each component is the other's nearest:
    :math:`B_{ij} = \tfrac12[(\alpha_i + \alpha_j)\log|\Sigma_{ij}| - \alpha_i\log|\Sigma_i| -
    \alpha_j\log|\Sigma_j|]`. Components that together hold less than 1e-9 are dropped first.

    Raises:
        ValueError: As :func:`moment_match`, the mixture is batched or a single point, or there
            would be no component.
        TypeError: ``components`` is no whole number.
    """
    check_count("components", components)
    if mixture.logits.ndim != 1:
        expected = "an unbatched mixture, logits of shape (K,)"
        raise ValueError(message(expected, tuple(mixture.logits.shape)))
    mixture = _spread_out(mixture)
    logits, order = mixture.logits.log_softmax(-1).sort(descending=True)
    keep = max(1, int((logits.exp().flip(0).cumsum(0).flip(0) > 1e-9).sum()))
    parts = (logits[:keep].exp(), mixture.loc[order[:keep]], mixture.covariance[order[:keep]])
    cost = _merge_cost(parts, parts).fill_diagonal_(torch.inf)
    while len(cost) > components:
        one, other = _nearest_pairs(cost, math.ceil((len(cost) - components) / 6))
        rest = torch.ones(len(cost), dtype=torch.bool, device=cost.device)
        rest[one] = rest[other] = False
        merged = _merge(tuple(part[one] for part in parts), tuple(part[other] for part in parts))
        parts = tuple(torch.cat([part[rest], new]) for part, new in zip(parts, merged, strict=True))
        rows = _merge_cost(merged, parts)
        size = len(cost) - 2 * len(one)
        cost = torch.cat([torch.cat([cost[rest][:, rest], rows[:, :size].mT], 1), rows])
        cost.fill_diagonal_(torch.inf)
    weight, loc, cov = parts
    return Mixture(weight.log().log_softmax(-1), loc, _cholesky(cov))


def _nearest_pairs(cost: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Return pairs of which each is the other's nearest, the best of them, at least one."""
    least, nearest = cost.min(1)
    own = torch.arange(len(cost), device=cost.device)
    first = ((nearest[nearest] == own) & (own < nearest)).nonzero()[:, 0]
    first = first[least[first].argsort()][:most]
    if not len(first):  # ties
        first = least.argmin()[None]
    return first, nearest[first]


def _merge(first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the components into which pairs of them merge, by their moments."""
    (one, loc, cov), (other, its_loc, its_cov) = first, second
    weight = one + other
    share = (one / weight)[:, None]
    between = loc - its_loc
    outer = (share * (1 - share))[..., None] * between[..., None] * between[..., None, :]
    mean = share * loc + (1 - share) * its_loc
    return weight, mean, share[..., None] * cov + (1 - share[..., None]) * its_cov + outer


def _merge_cost(first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> Tensor:
    """Return the bound for every pair of two sets of components, shape ``(K1, K2)``."""
    weight, loc, cov = (part[:, None] for part in first)
    total = weight + second[0]
    share = (weight / total)[..., None, None]
    between = loc - second[1]
    outer = share * (1 - share) * between[..., None] * between[..., None, :]
    cost = total * _log_det(share * cov + (1 - share) * second[2] + outer)
    return cost - weight * _log_det(cov) - second[0] * _log_det(second[2])


def _spread_out(mixture: Mixture) -> Mixture:
    """Return a mixture without points: components of no width get some, with a warning.

    Raises:
        ValueError: It is no mixture, or there is no scale to take a width from.
    """
    check_mixture(*mixture)
    logits, loc, scale = mixture
    points = (mixture.covariance == 0).flatten(-2).all(-1)
    if not points.any():
        return mixture
    size = _moments(mixture)[1].diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True).sqrt()
    alone = points & ~(size > 0)
    if alone.any():
        expected = "a mixture of some width, to which points in it are widened"
        raise ValueError(message(expected, f"a covariance of 0 in {first_marked(alone)}"))
    text = f"{int(points.sum())} of {points.numel()} components have collapsed to points: widened"
    warnings.warn(text, stacklevel=3)
    width = size * max(_THINNEST, 1e2 * torch.finfo(scale.dtype).eps) ** 0.5
    least = width[..., None, None] * torch.eye(scale.shape[-1]).to(scale)
    return Mixture(logits, loc, torch.where(points[..., None, None], least, scale))


def _cholesky(matrix: Tensor) -> Tensor:
    """Return the lower factor of covariances ``(*, D, D)``.

    Where rounding has left one indefinite, as it does where a component has collapsed in some
    direction, it is widened to `_THINNEST` of its widest variance, with a warning.

    Raises:
        ValueError: One is indefinite by more than rounding, wholly 0, or not finite.
    """
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if not failed.any() and factor.isfinite().all():
        return factor
    finite = matrix.isfinite().flatten(-2).all(-1)
    if not finite.all():
        text = f"NaN or infinity in {int((~finite).sum())} of {finite.numel()}"
        raise ValueError(message("covariances that are finite", text))
    bad = failed > 0
    values, vectors = torch.linalg.eigh(_symmetric(matrix))
    widest, rounding = values.amax(-1, keepdim=True), torch.finfo(matrix.dtype).eps
    if ((values < -max(_ROUNDING, 1e3 * rounding) * widest) | (widest <= 0))[bad].any():
        expected = "covariances that are positive definite"
        raise ValueError(message(expected, f"a variance of {values[bad].amin().item():.3g}"))
    values = values.maximum(max(_THINNEST, 1e2 * rounding) * widest)
    widened = (vectors * values.unsqueeze(-2)) @ vectors.mT
    text = f"{int(bad.sum())} of {bad.numel()} covariances are indefinite by rounding: widened"
    warnings.warn(text, stacklevel=3)
    safe = torch.where(
        bad[..., None, None], _symmetric(widened), torch.eye(matrix.shape[-1]).to(matrix)
    )
    return torch.where(bad[..., None, None], torch.linalg.cholesky(safe), factor)


def _log_det(covariance: Tensor) -> Tensor:
    found = torch.logdet(covariance)
    if not found.isfinite().all():
        safe = 2 * _cholesky(covariance).diagonal(dim1=-2, dim2=-1).log().sum(-1)
        found = torch.where(found.isfinite(), found, safe)
    return found


def _symmetric(matrix: Tensor) -> Tensor:
    return (matrix + matrix.mT) / 2
