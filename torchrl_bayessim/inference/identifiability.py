r"""What the data say about each parameter, in nats and in plain words.

The information gained about parameter d is the Kullback-Leibler divergence of its marginal from the
prior's,

.. math::
    I_d = \operatorname{E}_{q} [\log q_d(\theta_d) - \log p_d(\theta_d)] ,

0 if the data say nothing; each :math:`\log 2 = 0.69` nats halve the range that is left. Parameters
that only act together (a mass times a length) have posteriors that are wide one by one and strongly
correlated. Under a correlated prior, what the data say about one parameter they also say about
those that go with it.
"""

from __future__ import annotations

__all__ = ["Identifiability", "identifiability"]

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Normal

from ..counts import check_count
from ..errors import message
from ..randomness import generator
from .marginals import log_volume, one_by_one, scaled_marginals, turn
from .physics_posterior import PhysicsPosterior
from .priors import BoxPrior, Prior

_NOTHING = 0.1  # nats: what a network reads into noise
_LITTLE = 0.5
_TOGETHER = 0.8  # correlation from which a pair is named
_STRATA = 256  # of the draws of a parameter


@dataclass(frozen=True)
class Identifiability:
    """What the data say; ``print`` shows the sentences.

    Attributes:
        names: The parameters' names.
        nats: Information gained about each parameter, shape ``(D,)``.
        narrowing: Posterior over prior standard deviation, of the logarithm of a logarithmic
            parameter, shape ``(D,)``.
        correlation: Of the posterior, of logarithms likewise, shape ``(D, D)``; 0 with a parameter
            that is known to the last digit.
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

    Raises:
        ValueError: ``posterior`` is several, or not finite, or ``prior`` is over other parameters
            or has them in another order.

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
    if prior.names != posterior.names:
        expected = f"a prior over {posterior.names} in this order, as the posterior"
        raise ValueError(message(expected, prior.names))
    v, theta = _draws(posterior, draws)
    gained = _gained(posterior, prior, v)
    # as the prior scales them, so that a logarithmic parameter's tail does not rule correlations
    _, scale, log = one_by_one(prior)._at(theta)
    u = torch.where(log, torch.where(log, theta, 1.0).log(), theta)
    narrowing = u.std(0) / scale.diagonal()
    return Identifiability(
        prior.names,
        gained.mean(0).clamp_min(0.0).float(),
        narrowing.float(),
        _correlation(u).float(),
    )


def _gained(posterior: PhysicsPosterior, prior: Prior, v: Tensor) -> Tensor:
    """Return log posterior minus log prior of each parameter, at the middles of equal shares.

    Marginals are expensive, and a draw of every share says as much of a mean as all of them.

    Args:
        posterior: Of batch shape ``()``.
        prior: What was believed before any data.
        v: Draws, scaled, shape ``(N, D)``.

    Returns:
        Shape ``(S, D)``, ``S`` about 256 or all N.
    """
    step = max(1, len(v) // _STRATA)
    v = v.sort(0).values[step // 2 :: step]
    theta = one_by_one(posterior.prior)._call(v)
    density = scaled_marginals(posterior, v) - log_volume(posterior.prior, theta)
    return density - _prior_marginals(prior, theta)


def _draws(posterior: PhysicsPosterior, count: int) -> tuple[Tensor, Tensor]:
    """Return draws as scaled parameters and as parameters, float64, each of shape ``(N, D)``.

    In float32 the draws of a narrow posterior would lie many of its deviations apart from it.
    """
    check_count("draws", count, least=2)
    if posterior.batch_shape:
        hint = "posterior.condition(summaries of the real trajectories)"
        shape = tuple(posterior.batch_shape)
        raise ValueError(message("one posterior, of batch shape ()", shape, hint=hint))
    z = posterior.mixture.sample((count,), generator=generator("identifiability"))
    v = z @ turn(posterior.prior).to(z).mT
    if not v.isfinite().all():
        raise ValueError(message("a posterior of finite draws", "NaN or infinity among them"))
    return v, one_by_one(posterior.prior)._call(v)


def _correlation(u: Tensor) -> Tensor:
    """Return the correlation of draws ``(N, D)``, 0 with columns that vary by rounding alone."""
    varies = u.std(0) > 16 * torch.finfo(u.dtype).eps * u.abs().amax(0)
    both = varies & varies.unsqueeze(-1)
    identity = torch.eye(len(both), device=u.device)
    return torch.where(both, torch.atleast_2d(torch.corrcoef(u.mT)), identity)


def _prior_marginals(prior: Prior, theta: Tensor) -> Tensor:
    """Return the log-density of each parameter under the prior, shape ``(N, D)``."""
    if isinstance(prior, BoxPrior):
        low, high, log = (part.to(theta.device) for part in (prior.low, prior.high, prior.log))
        low, high = low.double(), high.double()
        ratio = torch.where(log, (high / low).clamp_min(1e-30).log(), 1.0)
        logarithmic = -(ratio.log() + torch.where(log, theta, 1.0).log())
        return torch.where(log, logarithmic, -(high - low).log())
    mean, scale, _ = one_by_one(prior)._at(theta)
    return Normal(mean, scale.diagonal()).log_prob(theta)
