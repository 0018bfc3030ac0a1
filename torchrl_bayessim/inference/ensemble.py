"""A posterior from pairs: networks fitted to them, conditioned on the real data, and averaged.

One network is sure of what it cannot know where pairs are few. Several, with other initial weights
and minibatches, disagree there, and their average is less sure (deep ensembles, Lakshminarayanan,
Pritzel & Blundell, 2017, arXiv:1612.01474). Three is the default of `PosteriorRefinement` and
`sequential`: two were too sure on PyBullet's Hopper, and four take a fifth of the time of ``sbi``'s
best network on Acrobot, more than a fit is to take (``recipes/posterior_recovery.py``).
"""

from __future__ import annotations

__all__ = [
    "NETWORKS",
    "PosteriorMaker",
    "fit_apart",
    "fit_together",
    "learn",
    "pairs_of",
    "real_summaries",
]

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ..errors import message
from ..kinds import check_kind, real_numbers
from .averaged_posterior import AveragedPosterior
from .fit import FitReport, fit, fit_several
from .physics_posterior import PhysicsPosterior
from .posterior import MixtureDensityPosterior
from .priors import Prior
from .usable_pairs import usable_pairs

NETWORKS = 3  # of an average, unless others are asked for
PosteriorMaker = Callable[[Prior, int], MixtureDensityPosterior]


def learn(
    pairs: TensorDictBase,
    prior: Prior,
    observed: Tensor,
    *,
    make_posterior: PosteriorMaker,
    seeds: Sequence[int],
    fit_options: Mapping[str, Any],
) -> tuple[AveragedPosterior, PhysicsPosterior, FitReport]:
    """Return the networks, the posterior given ``observed``, and what the first fit did.

    Args:
        pairs: ``{"theta", "summary"[, "weight"]}``, batch size ``[N]``.
        prior: What the networks are to know.
        observed: Summaries of the real trajectories, shape ``(L,)`` or ``(n, L)``.
        make_posterior: Prior and summary size to a fresh network.
        seeds: Of the fits, one for each network.
        fit_options: Passed to :func:`.fit.fit`; a seed there takes the place of those above.
    """
    pairs, dropped = usable_pairs(pairs)  # once, not once for each network
    observed = torch.atleast_2d(observed.to(pairs["summary"]))
    networks = [_made(make_posterior, prior, pairs["summary"].shape[-1], seed) for seed in seeds]
    # of an average of products, over several trajectories, held-out pairs say nothing; and networks
    # that begin alike need other pairs to disagree: each is as wide then as it needs by itself
    together = len(observed) == 1 and not _alike(networks)
    fitted = fit_together if together else fit_apart
    reports = fitted(networks, pairs, seeds=seeds, **fit_options)
    averaged = AveragedPosterior(networks)
    posterior = averaged.condition(observed, check=False)
    return averaged, posterior, replace(reports[0], dropped=dropped)


def _made(
    make_posterior: PosteriorMaker, prior: Prior, size: int, seed: int
) -> MixtureDensityPosterior:
    """Return a fresh network; of the default ones each begins with weights of its own."""
    if make_posterior is MixtureDensityPosterior:
        return MixtureDensityPosterior(prior, size, seed=seed)
    return make_posterior(prior, size)


def _alike(networks: Sequence[MixtureDensityPosterior]) -> bool:
    """Return whether some begin with the same weights."""
    first = [torch.nn.utils.parameters_to_vector(n.parameters()).detach() for n in networks]
    pairs = combinations(first, 2)
    return any(a.shape == b.shape and torch.equal(a, b) for a, b in pairs)


def fit_apart(
    networks: Sequence[MixtureDensityPosterior],
    pairs: TensorDictBase,
    *,
    seeds: Sequence[int],
    **options: Any,
) -> list[FitReport]:
    """Fit each network on a split of its own, one seed each; what is left goes to `.fit.fit`."""
    return [
        fit(network, pairs, **{"seed": seed, **options})
        for network, seed in zip(networks, seeds, strict=True)
    ]


def fit_together(
    networks: Sequence[MixtureDensityPosterior],
    pairs: TensorDictBase,
    *,
    seeds: Sequence[int],
    **options: Any,
) -> list[FitReport]:
    """Fit networks whose answers are averaged: one split, and as wide as their average needs.

    To be asked of one trajectory: of several, :func:`fit_apart` is right, since what an average
    needs of single ones says nothing of products.

    Args:
        networks: Changed in place.
        pairs: ``{"theta", "summary"[, "weight"]}``, batch size ``[N]``.
        seeds: Of the minibatches, one for each network; the split is the first's.
        options: Passed to :func:`.fit.fit`; a seed there takes the place of those above.

    Example:
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> prior = BoxPrior({"a": (0.0, 1.0)})
        >>> theta = torch.linspace(0, 1, 600)[:, None]
        >>> networks = [MixtureDensityPosterior(prior, 1, seed=seed) for seed in (0, 1)]
        >>> reports = fit_together(networks, pairs_of(theta, theta), seeds=(0, 1), epochs=3,
        ...                        progress=False)
        >>> torch.equal(*(network.network.widening for network in networks))
        True
    """
    seed = options.pop("seed", None)
    seeds = seeds if seed is None else [seed] * len(networks)
    return fit_several(networks, pairs, seeds=seeds, together=True, **options)


def pairs_of(theta: Tensor, summary: Tensor) -> TensorDict:
    """Return ``{"theta", "summary"}`` of parameters ``(N, D)`` and what was simulated at them.

    Both lie where the parameters do.

    Raises:
        ValueError: There is not one summary for each.

    Example:
        >>> pairs_of(torch.zeros(3, 2), torch.zeros(3, 5)).batch_size
        torch.Size([3])
    """
    check_kind("parameters of shape (N, D), a tensor", theta, Tensor)
    if theta.ndim != 2 or theta.is_complex():
        got = f"{theta.dtype} of shape {tuple(theta.shape)}"
        raise ValueError(message("real parameters of shape (N, D)", got))
    got = tuple(summary.shape) if isinstance(summary, Tensor) else type(summary).__name__
    if not isinstance(got, tuple) or len(got) != 2 or got[0] != len(theta):
        raise ValueError(message(f"one summary per simulation, shape ({len(theta)}, L)", got))
    if summary.is_complex():
        raise TypeError(message("statistics that are real numbers", str(summary.dtype)))
    # counts are statistics too
    summary = summary.detach() if summary.is_floating_point() else summary.to(theta.dtype)
    summary = summary.to(theta.device)
    return TensorDict({"theta": theta, "summary": summary}, batch_size=[len(theta)])


def real_summaries(observed: Any) -> Tensor:
    """Return what was observed, lists and NumPy arrays too, as a tensor ``(L,)`` or ``(n, L)``.

    Raises:
        TypeError: It is not made of numbers.
        ValueError: It has another shape, or values that are not finite.

    Example:
        >>> real_summaries([[0.25, 1.0]])
        tensor([[0.2500, 1.0000]])
    """
    observed = real_numbers("numbers, the summaries of real trajectories", observed).detach()
    if observed.ndim not in {1, 2} or not observed.numel():
        expected = "summaries of the real trajectories, shape (L,) or (n, L)"
        raise ValueError(message(expected, tuple(observed.shape)))
    bad = ~torch.atleast_2d(observed).isfinite()
    if bad.any():
        raise ValueError(
            message(
                "finite statistics of the real trajectories",
                f"NaN or infinity in statistics {bad.any(0).nonzero().flatten().tolist()}",
                hint="drop the trajectories that diverged, or repair their logs",
            )
        )
    return observed if observed.is_floating_point() else observed.to(torch.get_default_dtype())
