r"""What the data say about each parameter, in nats and in plain words.

The information gained about parameter d is the Kullback-Leibler divergence of its marginal from the
prior's,

.. math::
    I_d = \operatorname{E}_{q} [\log q_d(\theta_d) - \log p_d(\theta_d)] ,

0 if the data say nothing; each :math:`\log 2 = 0.69` nats halve the range that is left. Parameters
that only act together (a mass times a length) have posteriors that are wide one by one and strongly
correlated.
"""

from __future__ import annotations

__all__ = ["Identifiability", "identifiability"]

from dataclasses import dataclass

import torch
from torch import Tensor

from ..sources import draw
from .marginals import marginal_log_prob
from .physics_posterior import PhysicsPosterior
from .priors import BoxPrior, Prior

_NOTHING = 0.1  # nats: what a network reads into noise
_LITTLE = 0.5
_TOGETHER = 0.8  # correlation from which a pair is named


@dataclass(frozen=True)
class Identifiability:
    """What the data say; ``print`` shows the sentences.

    Attributes:
        names: The parameters' names.
        nats: Information gained about each parameter, shape ``(D,)``.
        narrowing: Posterior over prior standard deviation, shape ``(D,)``.
        correlation: Of the posterior, shape ``(D, D)``.
    """

    names: tuple[str, ...]
    nats: Tensor
    narrowing: Tensor
    correlation: Tensor

    @property
    def pairs(self) -> list[tuple[str, str, float]]:
        """The strongly correlated pairs: names and correlation, strongest first."""
        d = len(self.names)
        found = [(i, j, self.correlation[i, j].item()) for i in range(d) for j in range(i)]
        found = [(self.names[j], self.names[i], r) for i, j, r in found if abs(r) > _TOGETHER]
        return sorted(found, key=lambda pair: -abs(pair[2]))

    def sentences(self) -> list[str]:
        """Return one sentence per parameter and one per correlated pair."""
        rows = zip(self.names, self.nats.tolist(), self.narrowing.tolist(), strict=True)
        said = [_sentence(*row) for row in rows]
        for first, second, r in self.pairs:
            what = "sum" if r < 0 else "difference"
            said.append(
                f"{first} and {second} trade off (correlation {r:.2f}): these data fix something "
                f"like their {what} better than either."
            )
        return said

    def __str__(self) -> str:
        return "\n".join(self.sentences())


def _sentence(name: str, nats: float, narrowing: float) -> str:
    if nats < _NOTHING:
        return f"These data say nothing about {name} ({nats:.2f} nats over the prior)."
    extent = "little" if nats < _LITTLE else "something" if nats < 2 else "much"
    return (
        f"These data say {extent} about {name}: {nats:.2f} nats over the prior, deviation "
        f"{narrowing:.1%} of the prior's."
    )


def identifiability(
    posterior: PhysicsPosterior, *, prior: Prior | None = None, draws: int = 4096
) -> Identifiability:
    """Return what one posterior knows beyond the prior.

    Args:
        posterior: Given real data: batch shape ``()``.
        prior: What was believed before any data; the posterior's own if omitted. (A refined
            posterior's own prior is the smaller box that was simulated last.)
        draws: Posterior draws that the expectations are taken over.

    Example:
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
        >>> prior = BoxPrior({"mass": (2.0, 6.0), "length": (0.0, 1.0)})
        >>> narrow = TruncatedGaussianMixture(torch.zeros(1), torch.zeros(1, 2),
        ...     torch.diag(torch.tensor([0.1, 99.0]))[None], prior.box, diagonal=True)
        >>> print(identifiability(PhysicsPosterior(narrow, prior)))
        These data say much about mass: 2.1... nats over the prior, deviation 9...
        These data say nothing about length (0.00 nats over the prior).
    """
    prior = posterior.prior if prior is None else prior
    theta = draw(posterior, draws, key=("identifiability",))
    gained = marginal_log_prob(posterior, theta) - _prior_marginals(prior, theta)
    # correlations where mixtures live, so that a logarithmic parameter's tail does not rule them
    z = prior.standardize(theta.double())
    correlation = torch.atleast_2d(torch.corrcoef(z.mT))
    return Identifiability(
        prior.names, gained.mean(0).clamp_min(0.0), z.std(0).float(), correlation.float()
    )


def _prior_marginals(prior: Prior, theta: Tensor) -> Tensor:
    """Return the log-density of each parameter under the prior, shape ``(N, D)``."""
    if isinstance(prior, BoxPrior):
        ratio = torch.where(prior.log, (prior.high / prior.low).clamp_min(1e-30).log(), 1.0)
        logarithmic = -(ratio.log() + torch.where(prior.log, theta, 1.0).log())
        return torch.where(prior.log, logarithmic, -(prior.high - prior.low).log())
    return torch.distributions.Normal(prior.mean, prior.stddev).log_prob(theta)
