"""Several networks that were fitted to the same pairs, and answer by the average of their answers.

What one network got wrong another did not: their average is less sure where they disagree (deep
ensembles, Lakshminarayanan, Pritzel & Blundell, 2017, arXiv:1612.01474).
"""

from __future__ import annotations

__all__ = ["AveragedPosterior"]

import warnings
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ..errors import message
from ..kinds import check_kind
from .design_effect import most_of_alike
from .misspecification import doubts
from .mixtures import Mixture, moment_match
from .physics_posterior import PhysicsPosterior
from .placement import check_one_device
from .posterior import MixtureDensityPosterior, Pooling
from .priors import Prior
from .truncation import TruncatedGaussianMixture
from .widening import average

_MODES = 3.0  # deviations apart
_LITTLE = 1 / 3  # deviation of what says little, in those of the prior


class AveragedPosterior:
    r"""The average :math:`\frac{1}{M} \sum_m q_m(\theta \mid x)` of M networks.

    Where they were fitted together their means lie as far apart as held-out pairs like best: see
    :mod:`.widening`. Those pairs say nothing of answers that were multiplied, over several
    trajectories. The average of these errs less than each of them, too, and is as wide as they lie
    apart: their means come half of the way together, unless they are modes, or know little.

    Args:
        networks: One or more, over one prior and of the same keys, fitted by
            :func:`.ensemble.fit_together` or one by one.

    Raises:
        TypeError: One of them is of another kind.
        ValueError: There is none, or they are of different priors or keys, or on several devices.

    Example:
        >>> from torchrl_bayessim.inference.ensemble import fit_together, pairs_of
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> prior = BoxPrior({"mass": (2.0, 6.0)})
        >>> theta = prior.sample((600,))
        >>> networks = [MixtureDensityPosterior(prior, 1, seed=seed) for seed in (0, 1)]
        >>> reports = fit_together(networks, pairs_of(theta, theta), seeds=(0, 1), epochs=20,
        ...                        progress=False)
        >>> posterior = AveragedPosterior(networks).condition(torch.tensor([4.0]))
        >>> abs(posterior.mean.item() - 4) < 0.2
        True
    """

    def __init__(self, networks: Sequence[MixtureDensityPosterior]) -> None:
        if not networks:
            raise ValueError(message("one network or more", "none"))
        for network in networks:
            check_kind("a MixtureDensityPosterior", network, MixtureDensityPosterior)
        first = networks[0]
        for network in networks:
            keys = network.summary_key, network.theta_key
            same = network.prior.settings == first.prior.settings
            if not same or keys != (first.summary_key, first.theta_key):
                expected = f"networks over {first.prior!r}, all with the same keys"
                raise ValueError(message(expected, f"one over {network.prior!r}, keys {keys}"))
        check_one_device(network.device for network in networks)
        self.networks = tuple(networks)
        self.summary_key, self.theta_key = first.summary_key, first.theta_key

    @property
    def prior(self) -> Prior:
        """What all of them are over."""
        return self.networks[0].prior

    @property
    def device(self) -> torch.device:
        """Where their weights are, and what they answer."""
        return self.networks[0].device

    @property
    def seen(self) -> Tensor | None:
        """Summaries that the first was fitted to; ``None`` before a fit."""
        return self.networks[0].seen

    @property
    def held_out(self) -> TensorDictBase | None:
        """Pairs that no network learned from; ``None`` where each held out others."""
        first, *others = (network.held_out for network in self.networks)
        if first is None or any(other is None for other in others):
            return None
        theta = [own.get(self.theta_key) for own in (first, *others) if own is not None]
        return first if all(torch.equal(own, theta[0]) for own in theta) else None

    @property
    def _apart(self) -> Tensor | None:
        """The share that networks fitted together have in common."""
        first, *others = (network.network.apart for network in self.networks)
        return first if all(torch.equal(other, first) for other in others) else None

    def distribution(self, summary: Tensor) -> PhysicsPosterior:
        """Return one posterior per summary, for summaries ``(*, L)``."""
        members = [network.distribution(summary).mixture for network in self.networks]
        return PhysicsPosterior(average(members, self._apart), self.prior)

    def condition(
        self, summaries: Tensor, *, pooling: Pooling = "product", check: bool = True
    ) -> PhysicsPosterior:
        """Return the average of what :meth:`.MixtureDensityPosterior.condition` gives of each."""
        members = [
            network.condition(summaries, pooling=pooling, check=False).mixture
            for network in self.networks
        ]
        multiplied = (
            pooling == "product" and torch.atleast_2d(torch.as_tensor(summaries)).shape[0] > 1
        )
        apart = _of_products(members) if multiplied else self._apart
        found = PhysicsPosterior(average(members, apart), self.prior)
        if check and self.seen is not None:
            for doubt in doubts(self.seen, torch.as_tensor(summaries).to(self.seen), found):
                warnings.warn(doubt, stacklevel=2)
        return found


def _of_products(members: Sequence[TruncatedGaussianMixture]) -> Tensor:
    r"""Return which share of the way to the average of means products keep, ``(D,)``.

    Half. All of it where components lie far more than 3 of their deviations from the average: these
    are modes, and a mean between them says nothing of their places. And all of it where they are
    wider than a third of the prior: what lies apart there is chance, and the only sign of how
    little is known. With w the variance within components (that of the prior is 1) and b between
    them,

    .. math::
        1 - \frac{\max(1 - 9 w, 0)}{2 (1 + (b / (9 w))^2)} .

    Parameters that components cannot tell apart keep what the one of them keeps that keeps most:
    means that lie apart along a ridge stay on it.
    """
    every = average(members)
    mixture = Mixture(every.logits, every.loc, every.scale_tril)
    _, covariance = moment_match(mixture)
    inside = torch.einsum("k,kij->ij", mixture.logits.softmax(-1), mixture.covariance)
    within = inside.diagonal()
    between = covariance.diagonal() - within
    modes = (between / (_MODES**2 * within)).square()
    kept = 1 - 0.5 * (1 - within / _LITTLE**2).clamp_min(0.0) / (1 + modes)
    return most_of_alike(kept, inside[None])
