"""The methods of the posterior-recovery table, behind one interface.

A method turns pairs into something that answers for many summaries at once (amortised: BayesSim,
Rejection ABC, sbi's NPE), or a simulator into an answer for one observation (MCMC-ABC, SMC-ABC,
epsilon-free). An answer gives each parameter's log-density and the truth's place in its marginal.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass
from functools import partial
from tempfile import TemporaryDirectory
from typing import Literal

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_bayessim.inference.averaged_posterior import AveragedPosterior
from torchrl_bayessim.inference.calibration import calibrate
from torchrl_bayessim.inference.ensemble import fit_apart, fit_together
from torchrl_bayessim.inference.fit import fit, select_lengthscale
from torchrl_bayessim.inference.marginals import marginal_log_prob
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.sequential import sequential
from torchrl_bayessim.randomness import generator, isolated
from torchrl_bayessim.sources import draw

Simulator = Callable[[Tensor], Tensor]
ACCEPTED = 0.05  # share of the simulations that Rejection ABC accepts
DRAWS = 200


@dataclass(frozen=True)
class Answer:
    """What a method says about truths, each given its own summary.

    Attributes:
        marginal: Log-density of each parameter at the truth, shape ``(N, D)``.
        place: Share of each marginal below the truth, shape ``(N, D)``.
        joint: Log-density of all parameters together, ``(N,)``; ``None`` for draws.
        region: Level of the highest-density region, of all parameters together, that the truth
            lies on the edge of, ``(N,)``; ``None`` for what is no mixture.
    """

    marginal: Tensor
    place: Tensor
    joint: Tensor | None = None
    region: Tensor | None = None


Fitted = Callable[[Tensor, Tensor], Answer]
"""Truths ``(N, D)`` and the summaries ``(N, R, L)`` of R trajectories of each to an answer.

R is 1, or the method takes the mean of the R summaries, as the paper does, unless it pools.
"""
Conditioned = Callable[[Tensor], PhysicsPosterior]
"""Summaries ``(R, L)`` of the real trajectories to the posterior."""


def averaged(networks: AveragedPosterior, truth: Tensor, summary: Tensor, *, seed: int) -> Answer:
    """Answer by the posterior of the mean summary."""
    mean = summary.mean(1)
    q = networks.distribution(mean)
    test = TensorDict({"theta": truth, "summary": mean}, [len(truth)])
    found = calibrate(networks, test, draws=DRAWS, seed=seed)
    return Answer(marginal_log_prob(q, truth), found.rank, q.log_prob(truth), found.density)


def pooled(networks: AveragedPosterior, truth: Tensor, summary: Tensor, *, seed: int) -> Answer:
    """Answer by the posterior of all trajectories together."""
    g = generator(seed, "pooled")
    found = []
    for own, several in zip(truth, summary, strict=True):
        q = networks.condition(several, check=False)
        draws, density = q.sample((DRAWS,), generator=g), q.log_prob(own)
        place, region = (draws < own), (q.log_prob(draws) > density)
        shares = place.float().mean(0), region.float().mean(0)
        found.append((marginal_log_prob(q, own), shares[0], density, shares[1]))
    return Answer(*(torch.stack(part) for part in zip(*found, strict=True)))


def papers_bayessim(
    prior: BoxPrior,
    theta: Tensor,
    x: Tensor,
    *,
    features: Literal["fourier", "neural"],
    covariance: Literal["diagonal", "full"],
    seed: int,
) -> tuple[Fitted, Conditioned]:
    """Fit one network with the paper's choices."""
    size = x.shape[-1]
    pairs = TensorDict({"theta": theta, "summary": x}, [len(theta)])
    own = MixtureDensityPosterior.paper_mode(prior, size, features=features, seed=seed)
    network = MixtureDensityPosterior(
        prior,
        size,
        components=own.network.components,
        covariance=covariance,
        features=own.network.features,
        compress=False,
        seed=seed,
    )
    if features == "fourier":
        select_lengthscale(network, pairs, factors=(1, 2, 4), epochs=12, progress=False)
    fit(network, pairs, seed=seed, progress=False)
    networks = AveragedPosterior([network])
    answer = torch.no_grad()(partial(averaged, networks, seed=seed))
    return answer, partial(networks.condition, pooling="mean", check=False)


def bayessim(
    prior: BoxPrior, theta: Tensor, x: Tensor, *, networks: int, pool: bool, seed: int
) -> tuple[Fitted, Conditioned]:
    """Fit networks with our defaults, whose answers are averaged, or their products."""
    pairs = TensorDict({"theta": theta, "summary": x}, [len(theta)])
    seeds = range(networks * seed, networks * (seed + 1))
    fitted = [MixtureDensityPosterior(prior, x.shape[-1], seed=own) for own in seeds]
    (fit_apart if pool else fit_together)(fitted, pairs, seeds=seeds, progress=False)
    together = AveragedPosterior(fitted)
    answer = partial(pooled if pool else averaged, together, seed=seed)
    return torch.no_grad()(answer), partial(together.condition, check=False)


def rejection_abc(prior: BoxPrior, theta: Tensor, x: Tensor) -> Fitted:
    """Accept the simulations nearest to each summary, in robustly standardised statistics."""
    low, median, high = x.quantile(torch.tensor([0.25, 0.5, 0.75]), 0)
    spread = torch.where(high > low, (high - low) / 1.35, x.std(0)).clamp_min(1e-12)

    def scaled(values: Tensor) -> Tensor:
        return ((values - median) / spread).clamp(-10, 10)

    def answer(truth: Tensor, summary: Tensor) -> Answer:
        distance = torch.cdist(scaled(summary.mean(1)), scaled(x))
        nearest = distance.topk(round(ACCEPTED * len(x)), largest=False).indices
        return from_draws(prior, truth, theta[nearest].transpose(0, 1))

    return answer


def from_draws(prior: BoxPrior, truth: Tensor, draws: Tensor) -> Answer:
    """Return the answer of draws ``(S, N, D)``: kernel densities, reflected at the box's edges."""
    low, width = prior.low, prior.high - prior.low
    u, at = (draws - low) / width, (truth - low) / width
    bandwidth = 1.06 * u.std(0).clamp_min(1e-4) * len(u) ** -0.2
    images = torch.stack([u, -u, 2 - u])
    kernel = -0.5 * ((at - images) / bandwidth).square() - bandwidth.log()
    density = kernel.flatten(0, 1).logsumexp(0) - 0.5 * math.log(2 * math.pi) - math.log(len(u))
    place = ((u < at).float().sum(0) + 0.5) / (len(u) + 1)
    return Answer(density - width.log(), place)


def npe(
    prior: BoxPrior, theta: Tensor, x: Tensor, *, kind: Literal["mdn", "maf", "nsf"], seed: int
) -> Fitted:
    """Fit sbi's NPE with its own defaults; densities are renormalised inside the prior."""
    from sbi.inference import NPE
    from sbi.utils import BoxUniform

    with (
        TemporaryDirectory() as logs,
        chdir(logs),
        isolated(seed, "sbi", kind),
        redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        inference = NPE(
            BoxUniform(prior.low, prior.high), density_estimator=kind, show_progress_bars=False
        )
        estimator = inference.append_simulations(theta, x).train()

    @torch.no_grad()
    def answer(truth: Tensor, summary: Tensor) -> Answer:
        summary = summary.mean(1)
        with isolated(seed, "sbi draws", kind):
            draws = estimator.sample((2 * DRAWS,), condition=summary)
        inside = prior.contains(draws)
        share = inside.float().mean(0).clamp_min(0.5 / len(draws))
        joint = estimator.log_prob(truth[None], condition=summary)[0] - share.log()
        below = (inside.unsqueeze(-1) & (draws < truth)).sum(0)
        place = (below + 0.5) / (inside.sum(0).unsqueeze(-1) + 1)
        # the few draws outside the prior do not count: those inside take their places
        first = inside.long().argsort(dim=0, descending=True, stable=True)
        turn = torch.arange(len(draws)).unsqueeze(-1) % inside.sum(0).clamp_min(1)
        rows = first.gather(0, turn).unsqueeze(-1).expand_as(draws)
        marginal = from_draws(prior, truth, draws.gather(0, rows)).marginal
        if len(prior.names) == 1:
            marginal = joint.unsqueeze(-1)
        return Answer(marginal, place, joint)

    return answer


def mcmc_abc(
    simulate: Simulator, prior: BoxPrior, observed: Tensor, *, budget: int, seed: int
) -> Tensor:
    """Return draws by Metropolis chains side by side (Marjoram et al., 2003), shape ``(S, D)``.

    A quarter of the budget is a pilot, which sets the scale of the statistics, the tolerance (its
    5 % quantile of distances), the starts (each of four chains) and the steps of the chains. Of
    distances that are equal, as of a robot that falls as if nothing were varied, the first ones
    start.
    """
    g = generator(seed, "mcmc")
    theta = draw(prior, budget // 4, key=(seed, "pilot"))
    x = simulate(theta)
    spread = x.std(0).clamp_min(1e-12)
    distance = ((x - observed) / spread).norm(dim=-1)
    tolerance = distance.quantile(ACCEPTED)
    nearest = distance.argsort(stable=True)[: max(1, int(ACCEPTED * len(theta)))]
    chain = theta[nearest].repeat(4, 1)
    step = 1.5 * chain.std(0).clamp_min(1e-3)
    kept = []
    for _ in range((budget - len(theta)) // len(chain)):
        proposal = chain + step * torch.randn(chain.shape, generator=g)
        inside = prior.contains(proposal)
        proposal = torch.where(inside.unsqueeze(-1), proposal, chain)
        near = ((simulate(proposal) - observed) / spread).norm(dim=-1) <= tolerance
        chain = torch.where((near & inside).unsqueeze(-1), proposal, chain)
        kept.append(chain)
    return torch.cat(kept[len(kept) // 4 :])


def smc_abc(
    simulate: Simulator, prior: BoxPrior, observed: Tensor, *, budget: int, seed: int
) -> Tensor:
    """Return draws of sbi's SMC-ABC, shape ``(S, D)``; statistics in units of a pilot's spread."""
    from sbi.inference import SMCABC
    from sbi.utils import BoxUniform

    pilot = simulate(draw(prior, budget // 10, key=(seed, "pilot")))
    spread = pilot.std(0).clamp_min(1e-12)
    with isolated(seed, "smc"), redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        inference = SMCABC(
            lambda theta: simulate(theta) / spread,
            BoxUniform(prior.low, prior.high),
            simulation_batch_size=100,
            show_progress_bars=False,
        )
        return inference(
            (observed / spread)[None],
            num_particles=min(100, budget // 4),
            num_initial_pop=budget // 4,
            num_simulations=budget - budget // 10,
            epsilon_decay=0.7,
        )


def epsilon_free(
    simulate: Simulator, prior: BoxPrior, observed: Tensor, *, budget: int, seed: int
) -> PhysicsPosterior:
    """Return the posterior of four rounds with a Gaussian proposal, corrected analytically."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the counts of repaired components
        *_, last = sequential(
            simulate,
            prior,
            observed[None],
            rounds=4,
            simulations=budget // 4,
            correction="analytic",
            seed=seed,
            progress=False,
        )
    return last.posterior
