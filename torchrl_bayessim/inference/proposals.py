r"""Simulating where the posterior is, and correcting for it.

Pairs drawn from a proposal :math:`\tilde p(\theta)` instead of the prior would teach the network
:math:`\tilde p(\theta \mid x)`. Four corrections, ``"importance"`` and ``"truncated"`` right for
any proposal:

* ``"focused"``: a smaller box around the posterior, in which pairs of all rounds are as uniform as
  under the prior and need no weights; the posterior is learned over that box alone. Weights,
  where few of the prior's pairs lie near the posterior, leave those that do next to nothing of
  the loss.
* ``"importance"``: weights :math:`w = p(\theta) / \tilde p(\theta)` in the loss, with
  :math:`\tilde p = \sum_r \tfrac{n_r}{N} \tilde p_r` over all rounds (the balance heuristic, Veach
  & Guibas, 1995). If the prior is part of every proposal, the weights are bounded.
* ``"truncated"``: the prior restricted to the posterior's highest-density region, so that weights
  are constant within every region (Deistler et al., 2022, arXiv:2210.04815).
* ``"analytic"``: the BayesSim paper's division of the learned mixture by a Gaussian proposal
  (arXiv:1906.01728, eq. 14). Only for one Gaussian, and guarded: see
  :func:`analytic_correction`.
"""

from __future__ import annotations

__all__ = [
    "AnalyticCorrection",
    "HighestDensityPrior",
    "analytic_correction",
    "focus",
    "gaussian_proposal",
    "importance_weights",
]

import math
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from scipy.stats import chi2
from torch import Tensor

from ..errors import SimulationError, message
from ..sources import draw
from .mixtures import Mixture, divide, multiply
from .network import WIDEST
from .physics_posterior import PhysicsPosterior
from .priors import BoxPrior, Prior
from .truncation import TruncatedGaussianMixture

_RIM = 0.01  # of a box's width: a posterior that begins there is cut off by its edge


class Proposal(Protocol):
    """A source whose density is known."""

    def sample(self, shape: torch.Size, /, *_: Any, **__: Any) -> Tensor:
        """Return draws of shape ``(*shape, D)``."""
        ...

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, shape ``(*)``."""
        ...


def importance_weights(
    theta: Tensor, prior: Prior, proposals: Sequence[tuple[Proposal, int]]
) -> Tensor:
    r"""Return :math:`p(\theta) / \sum_r \tfrac{n_r}{N} \tilde p_r(\theta)`, shape ``(N,)``.

    Args:
        theta: Parameters of all rounds together, shape ``(N, D)``.
        prior: The prior p.
        proposals: ``(proposal, number of draws)`` of every round.

    Raises:
        ValueError: If a parameter has density zero under every proposal.

    Example:
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> prior, half = BoxPrior({"a": (0.0, 1.0)}), BoxPrior({"a": (0.0, 0.5)})
        >>> importance_weights(torch.tensor([[0.2], [0.8]]), prior, [(prior, 100), (half, 100)])
        tensor([0.6667, 2.0000])
    """
    total = sum(count for _, count in proposals)
    terms = [p.log_prob(theta) + math.log(count / total) for p, count in proposals if count]
    log_density = torch.stack(terms).logsumexp(0)
    if not log_density.isfinite().all():
        bad = theta[~log_density.isfinite()][0].tolist()
        raise ValueError(message("parameters drawn from the proposals", f"{bad}, of density 0"))
    return (prior.log_prob(theta) - log_density).exp()


def focus(
    prior: BoxPrior,
    posterior: PhysicsPosterior,
    *,
    margin: float = 1.0,
    tail: float = 5e-4,
    seed: int = 0,
) -> BoxPrior:
    """Return the prior on the smallest box around the posterior's draws but their tails, widened.

    The simplest truncated proposal: uniform, so no weights are needed, and a posterior learned on
    the smaller box resolves it better. It is the posterior under the full prior wherever the box
    holds all of that posterior; the margin allows for a first posterior that is too sure. Without
    the tails, as one wide component of negligible weight would keep the box as wide as the prior.
    A posterior that ends at an edge of the box that it was learned over is cut off there: on that
    side the margin is a share of that box.

    Args:
        prior: The full prior.
        posterior: The last round's.
        margin: Widening on either side, as a share of the box around 4,096 draws.
        tail: Share of the draws that may lie below that box before widening, and above, in each
            parameter.
        seed: Of the draws.

    Example:
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> prior = BoxPrior({"mass": (0.0, 100.0)})
        >>> narrow = TruncatedGaussianMixture(
        ...     torch.zeros(1), torch.zeros(1, 1), 0.01 * torch.eye(1)[None], prior.box)
        >>> focused = focus(prior, PhysicsPosterior(narrow, prior))
        >>> 46 < focused.low.item() < 48.5, 51.5 < focused.high.item() < 54
        (True, True)
    """
    u = prior.standardize(draw(posterior, 4096, key=(seed, "focus")).double())
    low, high = torch.quantile(u, torch.tensor([tail, 1 - tail], dtype=u.dtype), 0)
    width = (high - low).clamp_min(1e-4)
    below, above = width, width
    if isinstance(posterior.prior, BoxPrior):
        least, most = prior.standardize(
            torch.stack([posterior.prior.low, posterior.prior.high]).double()
        )
        before = most - least
        # what ends at the edge of the box before may lie beyond: as far as that box is wide
        below = torch.where(low - least < _RIM * before, before, below)
        above = torch.where(most - high < _RIM * before, before, above)
    edges = prior.unstandardize(torch.stack([low - margin * below, high + margin * above]))
    return prior.within(*edges.to(prior.low.dtype))


class HighestDensityPrior:
    r"""The prior restricted to :math:`\{\theta : q(\theta) \geq c\}`, which holds ``mass`` of q.

    Args:
        prior: The prior to restrict.
        posterior: Whose highest-density region is used.
        mass: Probability of the region under the posterior.
        seed: Of the estimates of the threshold c and of the region's prior volume.
        tries: At most so many batches of prior draws per sample; then draws of the posterior,
            resampled to the prior's density, fill the rest, with a warning.
    """

    def __init__(
        self,
        prior: Prior,
        posterior: PhysicsPosterior,
        *,
        mass: float = 0.9999,
        seed: int = 0,
        tries: int = 64,
    ) -> None:
        # in a box prior the search is confined to the box around the posterior
        self.prior = (
            focus(prior, posterior, margin=0.25, tail=0.0, seed=seed)
            if isinstance(prior, BoxPrior)
            else prior
        )
        self.names, self.posterior, self.tries = prior.names, posterior, tries
        draws = draw(posterior, 8192, key=(seed, "region"))
        self.threshold = posterior.log_prob(draws).quantile(1 - mass).item()
        inside = self.contains(draw(self.prior, 65536, key=(seed, "volume")))
        # half a point keeps a region smaller than the sample from having volume zero
        self.log_volume = math.log((inside.sum().item() + 0.5) / (len(inside) + 0.5))

    def contains(self, theta: Tensor) -> Tensor:
        """Return which parameters lie in the region, boolean, shape ``(*)``."""
        return self.prior.contains(theta) & (self.posterior.log_prob(theta) >= self.threshold)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, ``-inf`` outside the region, shape ``(*)``."""
        log_density = self.prior.log_prob(value) - self.log_volume
        return torch.where(self.contains(value), log_density, -torch.inf)

    def sample(self, shape: torch.Size, *, generator: torch.Generator) -> Tensor:
        """Return draws of shape ``(*shape, D)``: the prior's that fall in the region."""
        count = torch.Size(shape).numel()
        kept: list[Tensor] = []
        missing = count
        for _ in range(self.tries):
            theta = self.prior.sample((max(4 * count, 256),), generator=generator)  # pyright: ignore[reportCallIssue]
            kept.append(theta[self.contains(theta)][:missing])
            missing -= len(kept[-1])
            if missing == 0:
                break
        else:
            warnings.warn("the region is too small for prior draws: used q's", stacklevel=2)
            kept.append(self._resampled(missing, generator))
        return torch.cat(kept).reshape(*shape, -1)

    def _resampled(self, count: int, generator: torch.Generator) -> Tensor:
        """Return draws of q in the region, resampled by p / q, which is at most p / c there."""
        theta = self.posterior.sample((max(64 * count, 8192),), generator=generator).cpu()
        theta = theta[self.contains(theta)]
        if len(theta) == 0:
            raise SimulationError(message("draws inside the region", "none"))
        weight = (self.prior.log_prob(theta) - self.posterior.log_prob(theta)).softmax(0)
        weight = weight.to(generator.device)
        index = torch.multinomial(weight, count, replacement=True, generator=generator)
        return theta[index.cpu()]


def gaussian_proposal(posterior: PhysicsPosterior, *, inflate: float = 1.5) -> PhysicsPosterior:
    """Project a posterior onto one Gaussian by its moments, and widen its deviations.

    The one proposal that :func:`analytic_correction` may divide by. In a box prior it is cut off at
    the box, which a division does not notice.
    """
    points, weight = posterior.mixture.quadrature()
    mean = (weight.unsqueeze(-1) * points).sum(0)
    centred = points - mean
    covariance = (weight[:, None, None] * centred[:, :, None] * centred[:, None, :]).sum(0)
    identity = torch.eye(len(mean), device=mean.device)
    scale = inflate * torch.linalg.cholesky(covariance + 1e-10 * identity)
    one = TruncatedGaussianMixture(
        torch.zeros_like(mean[:1]), mean[None], scale[None], posterior.prior.box, diagonal=False
    )
    return PhysicsPosterior(one, posterior.prior)


class AnalyticCorrection(NamedTuple):
    """What the division by the proposal gave.

    Attributes:
        posterior: The corrected one.
        repaired: Components that would have been wider than the prior, or than twice the proposal
            where that is narrower: narrowed to that.
        dropped: Components whose quotient lies where the proposal has no draws.
        doubtful: The probability of both kinds under the learned posterior, between 0 and 1.
    """

    posterior: PhysicsPosterior
    repaired: int
    dropped: int
    doubtful: float


def analytic_correction(
    learned: PhysicsPosterior, proposal: PhysicsPosterior
) -> AnalyticCorrection:
    r"""Return :math:`\propto q(\theta \mid x)\, p(\theta) / \tilde p(\theta)`, and the repairs.

    The division extrapolates: a component nearly as wide as the proposal has a quotient that is
    wider than anything simulated, or far away from it, with an enormous weight. So no component
    of the result is wider than the prior, nor than twice the proposal where the prior is wider
    still (see :func:`.mixtures.divide`); and those whose mean lies outside the region that holds
    99 % of the proposal's draws are dropped.

    Args:
        learned: What the network gives when trained on draws of the proposal, unweighted.
        proposal: One Gaussian component, from :func:`gaussian_proposal`.

    Raises:
        ValueError: If the proposal has more than one component: dividing by a mixture term by term
            is wrong.
        SimulationError: If most of the learned posterior would have to be repaired or dropped.
    """
    mixture, divisor = learned.mixture, proposal.mixture
    if divisor.logits.numel() != 1:
        raise ValueError(
            message(
                "a proposal of one Gaussian (a ratio of mixtures is no mixture)",
                f"{divisor.logits.numel()} components",
                hint='correction="importance", which is right for mixtures',
            )
        )
    dividend = mixture.untruncated
    bounded = learned.prior.box is not None
    if not bounded:  # the prior is N(0, I) here, not a constant
        # before the division: a precision may need the prior's to stay positive
        identity = torch.eye(divisor.loc.shape[-1]).to(divisor.loc)
        dividend = _times_standard_normal(dividend, identity)
    mean, covariance = divisor.loc[0], divisor.scale_tril[0] @ divisor.scale_tril[0].mT
    widest = _widest(covariance, of_prior=WIDEST**2 if bounded else 1.0)
    quotient, repaired = divide(dividend, mean, covariance, widest=widest)
    supported = _supported(quotient.loc, mean, divisor.scale_tril[0])
    doubtful = mixture.logits.exp()[repaired | ~supported].sum().item()
    if doubtful > 0.5:
        raise SimulationError(
            message(
                "a learned posterior that is narrower than the proposal, and inside it",
                f"{doubtful:.0%} of it that is not: a division would be extrapolation",
                hint='more simulations, or correction="importance"',
            )
        )
    repaired = repaired & supported
    found = (int(repaired.sum()), int((~supported).sum()))
    if any(found):
        text = (
            f"{found[0]} components with a quotient wider than the prior or twice the proposal "
            f"were narrowed, {found[1]} with one outside the proposal dropped: {doubtful:.1%} of "
            "the learned posterior"
        )
        warnings.warn(text, stacklevel=2)
    parts = Mixture(*(part[supported] for part in quotient))
    corrected = TruncatedGaussianMixture.restrict(*parts, learned.prior.box)
    return AnalyticCorrection(PhysicsPosterior(corrected, learned.prior), *found, doubtful)


def _widest(covariance: Tensor, *, of_prior: float) -> Tensor:
    """Return the proposal's covariance with twice its deviations, at most the prior's variance."""
    values, vectors = torch.linalg.eigh(covariance)
    return vectors @ torch.diag((4 * values).clamp(max=of_prior)) @ vectors.mT


def _supported(loc: Tensor, mean: Tensor, scale_tril: Tensor) -> Tensor:
    """Return which points ``(K, D)`` lie in the ellipsoid of 99 % of a Gaussian's draws."""
    noise = torch.linalg.solve_triangular(scale_tril, (loc - mean).mT, upper=False)
    return noise.square().sum(0) <= chi2.ppf(0.99, len(mean))


def _times_standard_normal(mixture: Mixture, identity: Tensor) -> Mixture:
    zero = torch.zeros_like(identity[:1])
    return multiply(mixture, Mixture(zero[:, 0], zero, identity[None]))
