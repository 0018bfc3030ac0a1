"""Sequential inference: rounds of simulations, each drawn where the last posterior is.

For a simulator given as a function. With an environment and a policy in the loop, see
:mod:`torchrl_bayessim.loop`, which uses the same parts.
"""

from __future__ import annotations

__all__ = ["Correction", "SequentialRound", "sequential"]

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ..counts import check_count
from ..errors import SimulationError, message
from ..kinds import check_choice, check_function
from ..randomness import seed_from
from ..sources import Defensive, check_prior_share, draw
from .ensemble import NETWORKS, learn, pairs_of, real_summaries
from .fit import FitReport, check_fit_options
from .misspecification import doubts
from .physics_posterior import PhysicsPosterior
from .posterior import MixtureDensityPosterior
from .priors import BoxPrior, Prior, check_prior
from .proposals import (
    HighestDensityPrior,
    Proposal,
    analytic_correction,
    focus,
    gaussian_proposal,
    importance_weights,
)
from .weights import effective_sample_size

Correction = Literal["focused", "importance", "truncated", "analytic"]
CORRECTIONS = get_args(Correction)


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
    correction: Correction | None = None,
    prior_share: float = 0.2,
    networks: int = NETWORKS,
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
        correction: See :mod:`.proposals`. ``"focused"``, the default under a box prior, draws from
            ever smaller boxes around the posterior and trains on the pairs of all rounds that lie
            in the last one: those are uniform there and count alike. ``"importance"``, the default
            otherwise, and ``"truncated"`` train on the pairs of all rounds, weighted;
            ``"analytic"`` on the last round's, and if it has to refuse a division, warns and goes
            on with the posterior before.
        prior_share: Share of the draws from the prior that is kept in every proposal but boxes.
        networks: Networks fitted each round; the posterior is their average, which is less sure
            where they disagree: see :mod:`.ensemble`.
        make_posterior: Summary size to a fresh network; a default one if omitted. It is one over
            the whole prior, so ``"importance"`` is the default correction with it.
        seed: Same seed, same rounds (if the simulator is deterministic).
        **fit_options: Passed to :func:`.fit.fit`.

    Yields:
        One :class:`SequentialRound` after another.

    Raises:
        TypeError: On the first turn, for counts that are no whole numbers, a prior that is none of
            :mod:`.priors`, or no box for ``"focused"``, a simulator that is no function, or
            ``observed`` that is not made of numbers.
        ValueError: On the first turn, for an unknown correction or option, ``"focused"`` with
            networks of one's own, counts that are too small, a share that is no probability,
            ``observed`` that is not finite, or a simulator that does not give one summary per
            simulation.

    Warns if the real summaries lie apart from all simulated ones, or the posterior at an edge: see
    :mod:`.misspecification`.
    """
    check_count("rounds", rounds)
    check_count("simulations", simulations, least=4)
    check_count("networks", networks)
    check_function("a simulator, a function of parameters (N, D)", simulator)
    if make_posterior is not None:
        check_function("make_posterior, a function of the summary's size", make_posterior)
    check_prior(prior)
    correction = _correction(correction, prior, given_networks=make_posterior is not None)
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
        if correction == "focused":
            local, pairs = proposal, _inside(history, proposal)
        else:
            local, pairs = prior, _pairs(history, prior, weighted=correction != "analytic")
        _, learned, report = learn(
            pairs,
            local,
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


def _correction(given: Correction | None, prior: Prior, *, given_networks: bool) -> Correction:
    boxed = isinstance(prior, BoxPrior)
    if given is None:
        return "focused" if boxed and not given_networks else "importance"
    check_choice("a correction", given, CORRECTIONS)
    if given == "focused" and not boxed:
        expected = "a BoxPrior, of which focused rounds take smaller boxes"
        raise TypeError(message(expected, type(prior).__name__, hint="another correction"))
    if given == "focused" and given_networks:
        expected = "the default networks, which focused rounds make over smaller boxes"
        raise ValueError(message(expected, "make_posterior", hint="another correction"))
    return given


def _inside(history: list[tuple[Any, TensorDict]], box: BoxPrior) -> TensorDictBase:
    """Return the pairs in a box of all rounds that drew from the whole of it, each of weight 1."""
    kept = []
    for drawn_from, pairs in history:
        if (drawn_from.low <= box.low).all() and (drawn_from.high >= box.high).all():
            theta = pairs["theta"]  # without the rounding that `contains` allows
            kept.append(pairs[((theta >= box.low) & (theta <= box.high)).all(-1)])
    found: Any = torch.cat(kept)
    return found.set("weight", torch.ones(len(found)))


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
    if correction == "focused":
        return focus(cast("BoxPrior", prior), posterior)
    if correction == "truncated":
        return Defensive(HighestDensityPrior(prior, posterior), prior, prior_share)
    return Defensive(posterior, prior, prior_share)
