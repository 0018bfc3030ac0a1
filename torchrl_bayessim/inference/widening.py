r"""How wide a fitted posterior, or an average of several, is to be: as held-out pairs like best.

A network is surer of the pairs that it learned from than of others. One factor on all deviations,
learned from the others, undoes most of it (temperature scaling, Guo et al., 2017,
arXiv:1706.04599). An average of networks that disagree is wider than each of them already: the
factor that each would need is too much for it, and the one that it needs may be less than 1.
"""

from __future__ import annotations

__all__ = ["average", "widen"]

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase

from .posterior import MixtureDensityPosterior
from .truncation import TruncatedGaussianMixture
from .weights import weighted_mean, weights_of

_WIDER = (1.0, 1.05, 1.1, 1.15, 1.2, 1.3, 1.4, 1.5, 1.75, 2.0)
_NARROWER = (0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
# the same pairs chose each network's epoch, so they are liked better than others will be
_RESERVE = 1.05


@torch.no_grad()
def widen(networks: Sequence[MixtureDensityPosterior], held_out: TensorDictBase) -> float:
    """Set the factor on all deviations that makes held-out pairs likeliest; return it.

    Args:
        networks: Changed in place; several get the same factor, which suits their average.
        held_out: Pairs ``{"theta", "summary"[, "weight"]}`` that no network learned from.
    """
    first, alone = networks[0], len(networks) == 1
    z = first.prior.standardize(held_out.get(first.theta_key).double())
    weight = weights_of(held_out).to(z)
    scores = {}
    for factor in _WIDER if alone else _NARROWER + _WIDER:
        _set(networks, factor)
        members = [network.get_dist(held_out.copy()).mixture for network in networks]
        scores[factor] = weighted_mean(average(members).log_prob(z), weight).item()
    best = max(scores, key=scores.__getitem__)
    return _set(networks, best if alone else _RESERVE * best)


def _set(networks: Sequence[MixtureDensityPosterior], factor: float) -> float:
    for network in networks:
        network.network.widening.fill_(factor)
    return factor


def average(members: Sequence[TruncatedGaussianMixture]) -> TruncatedGaussianMixture:
    """Return the mixture of mixtures, all with the same weight.

    Example:
        >>> one, two = (
        ...     TruncatedGaussianMixture(torch.zeros(1), torch.full((1, 1), at), torch.eye(1)[None],
        ...                              None)
        ...     for at in (-1.0, 1.0)
        ... )
        >>> both = average([one, two])
        >>> both.logits.exp()
        tensor([0.5000, 0.5000], dtype=torch.float64)
    """
    if len(members) == 1:
        return members[0]
    return TruncatedGaussianMixture(
        torch.cat([member.logits for member in members], -1),
        torch.cat([member.loc for member in members], -2),
        torch.cat([member.scale_tril for member in members], -3),
        members[0].box,
        diagonal=all(member.diagonal for member in members),
        points=members[0].points,
    )
