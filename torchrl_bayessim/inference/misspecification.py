r"""Can the posterior be believed? Two checks on what a refinement has at hand anyway.

A network answers for any summary, also for one unlike all that it was trained on: when the prior
excludes the robot, or the simulator lacks what the robot does (Cannon et al., 2022,
arXiv:2209.01845). Two signs of it:

* **The real summary lies apart.** If the model holds, the real summary and the N simulated ones
  are exchangeable, so the chance that the real one is among the k of all N + 1 that are furthest
  from their nearest neighbours is k / (N + 1), whatever the statistics are (a conformal test:
  Vovk, Gammerman & Shafer, 2005, *Algorithmic Learning in a Random World*). Of n real summaries
  some are among them by chance: as many as a binomial distribution says.
* **The posterior piles up** at an edge of the box that was simulated.
"""

from __future__ import annotations

__all__ = ["doubts", "piled_up", "strangeness"]

import torch
from scipy.stats import binom
from torch import Tensor

from ..sources import draw
from .physics_posterior import PhysicsPosterior

_MOST = 1000  # simulations compared with: the distances between all of them are computed
_NEIGHBOURS = 5
_LEVEL = 0.005  # chance of a false alarm, or 1 / (N + 1) if that is more
_FEWEST = 50  # simulations, below which a false alarm would be too likely
_RIM = 0.01  # share of the box's width that counts as its edge
_BEYOND = 2.0  # times as far out as any simulation
_BY_ITSELF = 4.0  # spreads from the median that a statistic hardly ever is
_BOUND = 20.0  # spreads from the median: what lies further out shows by itself
_DEPENDENT = 1e-3  # spreads: less than that is rounding of a combination that is constant


def strangeness(summaries: Tensor, observed: Tensor) -> tuple[float, Tensor]:
    """Return how far ``observed`` lies apart, and in which statistics.

    The distance of two rows is the largest difference of their statistics, each in units of its
    own spread over all rows, the observed one among them, and of their principal components in
    units of theirs: what simulations always have together is seen to be apart in reality. A row
    lies as far out as its five nearest others are on average. At most 1,000 simulations are looked
    at.

    Args:
        summaries: Simulated, shape ``(N, L)``; rows that are not finite are left out.
        observed: The real one, shape ``(L,)``.

    Returns:
        The share of the rows, the observed one among them, that lie at least as far out:
        ``1 / (N + 1)`` if the observed one does most. And the deviation of each of its statistics
        from the median, in units of the spread, shape ``(L,)``.

    Example:
        >>> simulated = torch.randn(99, 3, generator=torch.Generator().manual_seed(0))
        >>> share, deviation = strangeness(simulated, torch.tensor([0.0, 9.0, 0.0]))
        >>> share, int(deviation.abs().argmax())
        (0.01, 1)
        >>> strangeness(simulated, torch.zeros(3))[0]
        0.9...
    """
    far, deviation = _far_out(summaries, observed)
    return (far >= far[0]).double().mean().item(), deviation


def _far_out(summaries: Tensor, observed: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far rows lie out, the observed one first, and its deviations from the medians."""
    simulated = summaries[summaries.isfinite().all(-1)][:_MOST].double()
    rows = _in_spreads(torch.cat([observed[None].to(simulated), simulated]))
    seen = torch.cat([rows, _components(rows)], -1)
    distance = torch.cdist(seen, seen, p=torch.inf).fill_diagonal_(torch.inf)
    nearest = distance.topk(min(_NEIGHBOURS, len(simulated)), largest=False).values
    return nearest.mean(-1), rows[0]


def _in_spreads(rows: Tensor) -> Tensor:
    """Return columns from their medians on, each in units of its spread."""
    # quartiles, which long tails do not move; where most rows agree, the standard deviation
    low, median, high = rows.quantile(torch.tensor([0.25, 0.5, 0.75]).to(rows), 0)
    size = rows.abs().quantile(0.95, 0, interpolation="lower")  # which few absurd rows do not set
    rounding = 1e-6 * size + 1e-12
    spread = torch.where(high - low > rounding, (high - low) / 1.35, rows.std(0))
    return (rows - median) / torch.maximum(spread, rounding)


def _components(rows: Tensor) -> Tensor:
    """Return principal components in their spreads, ``(N, C)``, but for those that are constant."""
    low, high = rows.quantile(torch.tensor([0.25, 0.75]).to(rows), 0)
    bounded = rows[:, high - low > 0.5].clamp(-_BOUND, _BOUND)  # where most agree, rounding rules
    bounded = bounded - bounded.mean(0)
    _, size, directions = torch.linalg.svd(bounded, full_matrices=False)
    found = bounded @ directions[size > _DEPENDENT * len(rows) ** 0.5].mT
    return _in_spreads(found) if found.numel() else found


def piled_up(posterior: PhysicsPosterior) -> list[tuple[str, str, float]]:
    """Return ``(name, "lower" or "upper", share)`` where the posterior piles up at an edge.

    That is, where more than a quarter of a parameter's marginal lies within 1 % of the width of
    the box that was simulated. Nothing for a prior without edges.

    Example:
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
        >>> prior = BoxPrior({"mass": (2.0, 6.0)})
        >>> beyond = TruncatedGaussianMixture(torch.zeros(1), torch.full((1, 1), 3.0),
        ...     0.2 * torch.eye(1)[None], prior.box, diagonal=True)
        >>> [(name, edge) for name, edge, _ in piled_up(PhysicsPosterior(beyond, prior))]
        [('mass', 'upper')]
    """
    prior = posterior.prior
    if prior.box is None:
        return []
    low, high = prior.box
    z = prior.standardize(draw(posterior, 2048, key=("piled up",)).double())
    u = (z - low) / (high - low)
    found = []
    for edge, distance in {"lower": u, "upper": 1 - u}.items():
        share = (distance < _RIM).double().mean(0).tolist()
        found += [(n, edge, s) for n, s in zip(prior.names, share, strict=True) if s > 0.25]
    return found


def doubts(summaries: Tensor, observed: Tensor, posterior: PhysicsPosterior) -> list[str]:
    """Return one sentence per reason not to believe a posterior; none if all is well.

    Fewer than 50 simulations are too few to tell whether the real summary lies apart.

    Args:
        summaries: Those that it was fitted to, shape ``(N, L)``.
        observed: What it was conditioned on, shape ``(L,)`` or ``(n, L)``.
        posterior: The result.
    """
    found = []
    checks = [_far_out(summaries, row) for row in torch.atleast_2d(observed)]
    compared = min(int(summaries.isfinite().all(-1).sum()), _MOST)
    level = max(_LEVEL, 1.5 / (compared + 1))
    apart = [(far, off) for far, off in checks if (far >= far[0]).double().mean() <= level]
    # of many rows that are right some are among the furthest, but none is far beyond them
    by_chance = float(binom.sf(len(apart) - 1, len(checks), level)) if apart else 1.0
    beyond = any(far[0] > _BEYOND * far[1:].max() for far, _ in apart)
    if (by_chance <= level * (1 + 1e-9) or beyond) and compared >= _FEWEST:
        worst = torch.stack([off for _, off in apart]).abs().amax(0)
        order = worst.argsort(descending=True)[:3].tolist()
        shown = ", ".join(f"number {i} by {worst[i]:.3g}" for i in order)
        if worst.max() < _BY_ITSELF:
            shown += " (none is off by itself: their combination does not occur)"
        found.append(
            f"{len(apart)} of {len(checks)} real summaries lie as far out as the {level:.1%} of "
            f"{compared} simulated ones that are furthest from the others. The statistics most "
            f"off, in units of their spread: {shown}. Does the prior hold the real parameters, and "
            "the simulator all that the robot does? If the prior is right, no parameter explains "
            "these data: torchrl_bayessim.diagnosis finds what the simulator lacks."
        )
    found += [
        f"{share:.0%} of the posterior of {name!r} lie at the {edge} edge of {posterior.prior!r}. "
        "Does the prior hold the real value? A wider prior shows it; at an edge that is not the "
        "prior's own, the next refinement or a larger margin."
        for name, edge, share in piled_up(posterior)
    ]
    return found
