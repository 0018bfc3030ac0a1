r"""Is a posterior as sure as it may be? Answers from simulations whose parameters are known.

If :math:`\theta_i \sim p(\theta)`, :math:`x_i \sim p(x \mid \theta_i)` and the posterior is right,
then each of these shares of its draws is uniform on [0, 1]:

* **rank**, per parameter: draws below the truth (simulation-based calibration, Talts et al., 2018,
  arXiv:1804.06788);
* **density**: draws of a higher density than the truth has. The truth lies in the highest-density
  region of level c in a share c of the cases: expected coverage (Hermans et al., 2022,
  arXiv:2110.06581);
* **distance**: draws nearer to a random point than the truth is (TARP, Lemos et al., 2023,
  arXiv:2302.03026). The points are scattered around truth and draws together: around the draws
  alone, the truth would lie farther out than each of a few draws that are just as good.

A posterior that is too sure has ranks at both ends and truths outside its regions. One that ignores
the data and returns the prior passes, since nothing here sees the data: nats stand beside it
(:mod:`.identifiability`).
"""

from __future__ import annotations

__all__ = ["Calibration", "calibrate", "calibrate_draws", "calibrate_pooled", "coverage_band"]

from dataclasses import dataclass
from typing import Any

import torch
from scipy.stats import binom, kstest
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from ..errors import message
from ..randomness import generator
from .averaged_posterior import AveragedPosterior
from .posterior import MixtureDensityPosterior

_LEVEL = 0.01  # chance that a right posterior fails, over all tests together
_ROWS = 64  # test cases whose draws are made at a time


@dataclass(frozen=True)
class Calibration:
    """Where the truths lie in their posteriors; see the module.

    Attributes:
        names: The parameters' names.
        rank: Shape ``(N, D)``.
        density: Shape ``(N,)``.
        distance: Shape ``(N,)``.
    """

    names: tuple[str, ...]
    rank: Tensor
    density: Tensor
    distance: Tensor

    def coverage(self, level: float) -> dict[str, float]:
        """Return how often regions of this level hold the truth, by parameter and ``"joint"``.

        Central intervals for single parameters, highest-density regions for all together.
        """
        central = ((self.rank - 0.5).abs() <= level / 2).double().mean(0).tolist()
        joint = (self.density <= level).double().mean().item()
        return dict(zip(self.names, central, strict=True)) | {"joint": joint}

    def band(self, level: float, *, confidence: float = 0.95) -> tuple[float, float]:
        """Return the interval in which the coverage of a right posterior falls so often."""
        return coverage_band(len(self.rank), level, confidence=confidence)

    def p_values(self) -> dict[str, float]:
        """Return a Kolmogorov-Smirnov p-value per share: small ones say that it is not uniform."""
        columns = {f"rank of {n}": self.rank[:, d] for d, n in enumerate(self.names)}
        columns |= {"density": self.density, "distance": self.distance}
        return {
            name: float(kstest(u.cpu().numpy(), "uniform").pvalue) for name, u in columns.items()
        }

    @property
    def passed(self) -> bool:
        """Whether no test rejects uniformity, at 1 % over all tests together (Bonferroni)."""
        p = self.p_values()
        return min(p.values()) > _LEVEL / len(p)

    def doubts(self, *, what: str = "the posterior") -> list[str]:
        """Return one sentence, on ``what``, if the test fails, none otherwise."""
        if self.passed:
            return []
        inner, outer = (self.coverage(level) for level in (0.5, 0.9))
        worst = min(self.p_values().items(), key=lambda item: item[1])
        sure = "too sure, or biased" if outer["joint"] < 0.9 else "not sure enough, or biased"
        return [
            f"{what} is {sure}: of {len(self.rank)} known truths its 50 % and 90 % regions "
            f"hold {inner['joint']:.0%} and {outer['joint']:.0%} ({worst[0]}: p = {worst[1]:.1g}). "
            "Try more simulations, or the average of several networks."
        ]


def coverage_band(count: int, level: float, *, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval in which the coverage of a right posterior falls so often.

    Args:
        count: Number of truths.
        level: Of the regions that hold them.
        confidence: How often.

    Example:
        >>> coverage_band(320, 0.5)
        (0.44375, 0.55625)
    """
    low, high = binom.interval(confidence, count, level)
    return float(low) / count, float(high) / count


def calibrate_draws(
    names: tuple[str, ...],
    theta: Tensor,
    draws: Tensor,
    *,
    log_prob: tuple[Tensor, Tensor],
    seed: int = 0,
) -> Calibration:
    """Return the calibration of any posterior from its draws.

    Args:
        names: The parameters' names.
        theta: Truths, shape ``(N, D)``.
        draws: Posterior draws for each, shape ``(S, N, D)``.
        log_prob: The posterior's log-density at the truths, ``(N,)``, and at the draws, ``(S, N)``.
        seed: Of the points that distances are measured from.

    Example:
        >>> truths, draws = torch.randn(300, 1), torch.randn(200, 300, 1)
        >>> log_prob = (-truths[..., 0]**2, -draws[..., 0]**2)
        >>> calibrate_draws(("a",), truths, draws, log_prob=log_prob).passed
        True
    """
    if theta.ndim != 2 or draws.shape[1:] != theta.shape or len(draws) < 2:
        raise ValueError(
            message(
                f"draws of shape (S >= 2, N, D) for truths of shape {tuple(theta.shape)}",
                tuple(draws.shape),
            )
        )
    draws = draws.double()
    theta = theta.to(draws)
    jitter = torch.rand(3, len(theta), 1, generator=generator(seed, "ties"), dtype=theta.dtype)
    jitter = jitter.to(theta.device)
    own, away = _distances(theta, draws, generator(seed, "points"))
    at_truth, at_draws = (density.to(draws.device) for density in log_prob)
    return Calibration(
        names,
        _share(draws, theta, jitter[0]),
        _share(-at_draws, -at_truth, jitter[1, :, 0]),
        _share(away, own, jitter[2, :, 0]),
    )


def _share(draws: Tensor, truth: Tensor, noise: Tensor) -> Tensor:
    r"""Return the share of draws below the truth, at a random place among those equal to it.

    .. math::
        (\#\{d < t\} + U (\#\{d = t\} + 1)) / (S + 1), \quad U \sim U(0, 1)

    Args:
        draws: Shape ``(S, *)``.
        truth: Shape ``(*)``.
        noise: U, shape ``(*)``.
    """
    below, equal = (draws < truth).double().sum(0), (draws == truth).double().sum(0)
    # among S draws the truth has S + 1 places; spread evenly over its own and its equals'
    return (below + noise * (equal + 1)) / (len(draws) + 1)


def _distances(theta: Tensor, draws: Tensor, g: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return how far truths ``(N, D)`` and draws ``(S, N, D)`` are from points scattered near them.

    Truth and draws enter the points alike, or few draws would be nearer than the truth is.
    """
    pooled = torch.cat([theta.unsqueeze(0), draws])
    scale = pooled.flatten(0, 1).std(0).clamp_min(1e-12)
    push = torch.randn(theta.shape, generator=g, dtype=theta.dtype).to(theta.device)
    points = pooled.mean(0) + 0.5 * (pooled.std(0) + 0.1 * scale) * push
    away = ((pooled - points) / scale).norm(dim=-1)
    return away[0], away[1:]


@torch.no_grad()
def calibrate(
    posterior: MixtureDensityPosterior | AveragedPosterior,
    pairs: TensorDictBase,
    *,
    draws: int = 300,
    seed: int = 0,
) -> Calibration:
    """Return the calibration of an amortised posterior.

    Args:
        posterior: The network, or the average of several.
        pairs: From the prior, and not trained on, under the posterior's keys, batch size ``(N,)``.
            A few hundred tell 90 % from 85 %.
        draws: Posterior draws per pair.
        seed: Same seed, same numbers.

    Raises:
        ValueError: There are no pairs, or an entry is missing or not finite.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> prior = BoxPrior({"mass": (2.0, 6.0)})
        >>> untrained = MixtureDensityPosterior(prior, 2, components=1)
        >>> data = {"theta": prior.sample((200,)), "summary": torch.zeros(200, 2)}
        >>> pairs = TensorDict(data, batch_size=[200])
        >>> sorted(calibrate(untrained, pairs).coverage(0.5))
        ['joint', 'mass']
    """
    theta = _finite(pairs, posterior.theta_key)
    summary = _finite(pairs, posterior.summary_key).to(posterior.device)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for index, rows in enumerate(torch.arange(len(pairs)).split(_ROWS)):
        q: Any = posterior.distribution(summary[rows])
        some = q.sample((draws,), generator=generator(seed, "calibration", index))
        found.append((some, q.log_prob(theta[rows]), q.log_prob(some)))
    drawn, at_truth, at_draws = (
        torch.cat(part, -1 if part[0].ndim < 3 else 1) for part in zip(*found, strict=True)
    )
    return calibrate_draws(
        posterior.prior.names,
        theta,
        drawn,
        log_prob=(at_truth, at_draws),
        seed=seed,
    )


@torch.no_grad()
def calibrate_pooled(
    posterior: MixtureDensityPosterior | AveragedPosterior,
    theta: Tensor,
    summaries: Tensor,
    *,
    draws: int = 300,
    seed: int = 0,
) -> Calibration:
    """Return the calibration of answers for n trajectories together.

    What is a little off in each of n answers is n times as much in their product: one that is right
    for single trajectories may be too sure of many.

    Args:
        posterior: The network, or the average of several.
        theta: Truths from the prior, shape ``(N, D)``.
        summaries: Of n trajectories of each, shape ``(N, n, L)``.
        draws: Posterior draws for each truth.
        seed: Same seed, same numbers.

    Raises:
        ValueError: There are not as many truths as groups of summaries.

    Example:
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> prior = BoxPrior({"mass": (2.0, 6.0)})
        >>> untrained = MixtureDensityPosterior(prior, 2, components=1)
        >>> found = calibrate_pooled(untrained, prior.sample((60,)), torch.zeros(60, 4, 2))
        >>> sorted(found.coverage(0.5))
        ['joint', 'mass']
    """
    if summaries.ndim != 3 or len(summaries) != len(theta) or not len(theta):
        expected = f"summaries of shape (N, n, L) for truths of shape {tuple(theta.shape)}"
        raise ValueError(message(expected, tuple(summaries.shape)))
    found = []
    for index, (own, rows) in enumerate(zip(theta, summaries, strict=True)):
        q = posterior.condition(rows, check=False)
        some = q.sample((draws,), generator=generator(seed, "pooled calibration", index))
        found.append((some, q.log_prob(own), q.log_prob(some)))
    drawn, at_truth, at_draws = (torch.stack(part, -1) for part in zip(*found, strict=True))
    log_prob = at_truth, at_draws
    return calibrate_draws(
        posterior.prior.names, theta, drawn.movedim(-1, 1), log_prob=log_prob, seed=seed
    )


def _finite(pairs: TensorDictBase, key: NestedKey) -> Tensor:
    """Return an entry of held-out pairs, if they have it and it is finite."""
    value = pairs.get(key, None)
    if value is None:
        found = sorted(map(str, pairs.keys(include_nested=True)))
        raise ValueError(message("held-out pairs with an entry", str(key), available=found))
    if not len(pairs):
        raise ValueError(message("at least one held-out pair", "none"))
    bad = ~value.isfinite().reshape(len(value), -1).all(-1)
    if bad.any():
        got = f"NaN or infinity in {key!r} of {int(bad.sum())} of {len(bad)}"
        raise ValueError(message("finite held-out pairs", got, hint="leave these out"))
    return value
