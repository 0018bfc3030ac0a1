r"""A linear-Gaussian problem: how far is the learned posterior from the exact one?

:math:`x = A^T z + e` with two parameters, three statistics and noise of deviation 0.3; :math:`z` is
normal, so that the posterior is a Gaussian, or uniform in a box, so that it is one cut off at the
edges. The average of as many networks as by default, three, is fitted to simulated pairs; the
figure is the Kullback-Leibler divergence :math:`KL(p \| q)` of the learned posterior q from the
exact p, mean over 300 other observations, by draws from p. Prints one JSON line per prior::

    python recipes/benchmarks/linear_gaussian.py [seeds=3] [pairs=10000]
"""

from __future__ import annotations

import sys
import time

import torch
from measuring import options, report
from tensordict import TensorDict
from torch import Tensor

from torchrl_bayessim.inference.averaged_posterior import AveragedPosterior
from torchrl_bayessim.inference.ensemble import NETWORKS, fit_together
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior, Prior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.randomness import generator

SENSITIVITY = torch.tensor([[1.0, 0.5, 0.0], [-0.3, 0.8, 0.6]])  # A, of standardised parameters
NOISE = 0.3
PRIORS: dict[str, Prior] = {
    "Gaussian prior": GaussianPrior({"a": (0.0, 1.0), "b": (5.0, 2.0)}),
    "box prior": BoxPrior({"a": (2.0, 6.0), "b": (0.5, 2.0)}),
}
OBSERVATIONS, DRAWS = 300, 400
NEAR = 0.02  # nats; the line names the seeds that are farther


def simulated(prior: Prior, count: int, *, seed: int) -> TensorDict:
    """Return pairs of parameters and summaries."""
    theta = prior.sample((count,), generator=generator(seed, "theta"))
    noise = NOISE * torch.randn(count, 3, generator=generator(seed, "noise"))
    return TensorDict(
        {"theta": theta, "summary": prior.standardize(theta) @ SENSITIVITY + noise}, [count]
    )


def exact(prior: Prior, summary: Tensor) -> TruncatedGaussianMixture:
    """Return the posterior in standardised coordinates: a Gaussian, restricted to the box."""
    sensitivity = SENSITIVITY.double()
    precision = sensitivity @ sensitivity.mT / NOISE**2
    if prior.box is None:
        precision = precision + torch.eye(len(precision))
    covariance = torch.linalg.inv(precision)
    mean = summary.double() @ sensitivity.mT / NOISE**2 @ covariance
    scale = torch.linalg.cholesky(covariance).expand(*mean.shape, -1)
    one = torch.zeros(len(mean), 1)
    return TruncatedGaussianMixture(one, mean[:, None], scale[:, None], prior.box, points=2**12)


@torch.no_grad()
def divergence(prior: Prior, networks: list[MixtureDensityPosterior], *, seed: int) -> float:
    """Return the mean divergence of the networks' average from the exact posterior, in nats."""
    summary = simulated(prior, OBSERVATIONS, seed=seed)["summary"]
    p = exact(prior, summary)
    q = AveragedPosterior(networks).distribution(summary).mixture
    z = p.sample((DRAWS,), generator=generator(seed, "draws"))
    return (p.log_prob(z) - q.log_prob(z)).mean().item()


def main(*arguments: str) -> None:
    """Measure with both priors."""
    given = options(list(arguments), seeds=3, pairs=10000)
    torch.set_num_threads(1)
    for case, prior in PRIORS.items():
        found, seconds = [], []
        for seed in range(given["seeds"]):
            start = time.process_time()
            own = range(NETWORKS * seed, NETWORKS * (seed + 1))
            networks = [MixtureDensityPosterior(prior, 3, seed=s) for s in own]
            pairs = simulated(prior, given["pairs"], seed=seed)
            fit_together(networks, pairs, seeds=own, progress=False)
            seconds.append(time.process_time() - start)
            found.append(divergence(prior, networks, seed=1000 + seed))
        context = {"seed": f"0 to {given['seeds'] - 1}", "threads": 1, "pairs": given["pairs"]}
        report(
            *("linear_gaussian", case, found),
            unit="nats",
            fit_seconds=round(sum(seconds) / len(seconds), 1),
            far=[seed for seed, value in enumerate(found) if value > NEAR],
            **context,
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
