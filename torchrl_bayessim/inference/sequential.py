"""Sequential inference: rounds of simulations, each drawn where the last posterior is.

For a simulator given as a function. With an environment and a policy in the loop, see
:mod:`torchrl_bayessim.loop`, which uses the same parts.
"""

from __future__ import annotations

__all__ = ["Correction", "SequentialRound", "sequential"]

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ..counts import check_count
from ..errors import SimulationError
from ..kinds import check_choice, check_function
from ..randomness import seed_from
from ..sources import Defensive, check_prior_share, draw
from .ensemble import learn, pairs_of, real_summaries
from .fit import FitReport, check_fit_options
from .misspecification import doubts
from .physics_posterior import PhysicsPosterior
from .posterior import MixtureDensityPosterior
from .priors import Prior, check_prior
from .proposals import (
    HighestDensityPrior,
    Proposal,
    analytic_correction,
    effective_sample_size,
    gaussian_proposal,
    importance_weights,
)

Correction = Literal["importance", "truncated", "analytic"]


@dataclass(frozen=True)
class SequentialRound:
    """One round of sequential inference.

    Attributes:
        index: From 0.
        posterior: Given the observed summaries.
        fit: What the fit did.
        effective_pairs: Effective number of pairs after weighting, of those that are finite.
        repaired: Components narrowed or dropped by the analytic correction.
        refused: Whether the analytic correction was refused; ``posterior`` is the last round's
            then, and its pairs are kept for the next.
    """

    index: int
    posterior: PhysicsPosterior
    fit: FitReport
    effective_pairs: float
    repaired: int = 0
    refused: bool = False


def sequential(
    simulator: Callable[[Tensor], Tensor],
    prior: Prior,
    observed: Any,
    *,
    rounds: int,
    simulations: int,
    correction: Correction = "importance",
    prior_share: float = 0.2,
    networks: int = 2,
    make_posterior: Callable[[int], MixtureDensityPosterior] | None = None,
    seed: int = 0,
    **fit_options: Any,
) -> Iterator[SequentialRound]:
    """Refine a posterior round after round; a generator, so that the caller owns the loop.

    Args:
        simulator: Parameters ``(N, D)`` to summaries ``(N, L)``.
        prior: The prior.
        observed: Summaries of the real trajectories, ``(n, L)``, or of one, ``(L,)``.
        rounds: Number of rounds.
        simulations: Simulations per round.
        correction: See :mod:`.proposals`. ``"importance"`` and ``"truncated"`` train on the pairs
            of all rounds; ``"analytic"`` on the last round's, and if it has to refuse a
            division, warns and goes on with the posterior before.
        prior_share: Share of the draws from the prior that is kept in every proposal.
        networks: Networks fitted each round; the posterior is their average, which is less sure
            where they disagree: see :mod:`.ensemble`.
        make_posterior: Summary size to a fresh network; a default one if omitted.
        seed: Same seed, same rounds (if the simulator is deterministic).
        **fit_options: Passed to :func:`.fit.fit`.

    Yields:
        One :class:`SequentialRound` after another.

    Raises:
        TypeError: On the first turn, for counts that are no whole numbers, a prior that is none of
            :mod:`.priors`, a simulator that is no function, or ``observed`` that is not made of
            numbers.
        ValueError: On the first turn, for an unknown correction or option, counts that are too
            small, a share that is no probability, ``observed`` that is not finite, or a simulator
            that does not give one summary per simulation.

    Warns if the real summaries lie apart from all simulated ones, or the posterior at an edge: see
    :mod:`.misspecification`.
    """
    check_count("rounds", rounds)
    check_count("simulations", simulations, least=4)
    check_count("networks", networks)
    check_choice("a correction", correction, ["importance", "truncated", "analytic"])
    check_function("a simulator, a function of parameters (N, D)", simulator)
    if make_posterior is not None:
        check_function("make_posterior, a function of the summary's size", make_posterior)
    check_prior(prior)
    check_prior_share(prior_share)
    check_fit_options(fit_options)
    observed = real_summaries(observed)
    proposal: Any = prior
    posterior: PhysicsPosterior | None = None
    history: list[tuple[Proposal, TensorDict]] = []
    for index in range(rounds):
        theta = draw(proposal, simulations, key=(seed, "theta", index))
        history.append((proposal, pairs_of(theta, simulator(theta))))
        if correction == "analytic":  # more of one proposal after a refusal
            history = [entry for entry in history if entry[0] is proposal]
        pairs = _pairs(history, prior, weighted=correction != "analytic")
        learned, report = learn(
            pairs,
            prior,
            observed,
            make_posterior=MixtureDensityPosterior
            if make_posterior is None
            else lambda _, size: make_posterior(size),
            seeds=[seed, *(seed_from(seed, "network", i) for i in range(1, networks))],
            fit_options=fit_options,
        )
        repaired, refused = 0, False
        if correction == "analytic" and posterior is not None:
            posterior, repaired, refused = _divided(learned, proposal, posterior)
        else:
            posterior = learned
        for doubt in doubts(pairs["summary"], observed, posterior):
            warnings.warn(doubt, stacklevel=2)
        effective = effective_sample_size(pairs["weight"][pairs["summary"].isfinite().all(-1)])
        yield SequentialRound(index, posterior, report, effective, repaired, refused)
        if not refused:
            proposal = _next_proposal(posterior, prior, correction, prior_share)


def _divided(
    learned: PhysicsPosterior, proposal: PhysicsPosterior, last: PhysicsPosterior
) -> tuple[PhysicsPosterior, int, bool]:
    """Return the corrected posterior, the repairs, and whether it is the last one instead."""
    try:
        posterior, repaired, dropped, _ = analytic_correction(learned, proposal)
    except SimulationError as refusal:
        warnings.warn(f"{refusal} The posterior of the round before stays.", stacklevel=3)
        return last, 0, True
    return posterior, repaired + dropped, False


def _pairs(
    history: list[tuple[Proposal, TensorDict]], prior: Prior, *, weighted: bool
) -> TensorDictBase:
    pairs: Any = torch.cat([pairs for _, pairs in history])  # typed as if of tensors
    weight = torch.ones(len(pairs))
    if weighted:
        proposals = [(proposal, len(pairs)) for proposal, pairs in history]
        weight = importance_weights(pairs["theta"], prior, proposals)
    return pairs.set("weight", weight)


def _next_proposal(
    posterior: PhysicsPosterior, prior: Prior, correction: Correction, prior_share: float
) -> Any:
    if correction == "analytic":
        return gaussian_proposal(posterior)
    if correction == "truncated":
        return Defensive(HighestDensityPrior(prior, posterior), prior, prior_share)
    return Defensive(posterior, prior, prior_share)
