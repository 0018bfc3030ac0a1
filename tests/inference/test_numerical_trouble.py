"""Posteriors at the edges: statistics without noise, and many parameters."""

import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.randomness import generator


def fitted(size, *, noise, pairs, **options):
    """Return the prior of ``size`` parameters and a posterior from their noisy values."""
    prior = BoxPrior({f"p{i}": (float(i), i + 1.0) for i in range(size)})
    theta = prior.sample((pairs,), generator=generator("theta", size))
    summary = theta + noise * torch.randn(theta.shape, generator=generator("noise", size))
    data = TensorDict({"theta": theta, "summary": summary}, [pairs])
    posterior = MixtureDensityPosterior(prior, size, **options)
    report = fit(posterior, data, epochs=20, lr=2e-2, progress=False)
    assert all(torch.tensor(report.validation).isfinite())
    return prior, posterior


def test_statistics_without_noise_collapse_no_component():
    prior, posterior = fitted(2, noise=0.0, pairs=1500)
    for place, nats in (0.02, 0.0), (0.3, 4.0), (0.98, 0.0):  # the true density is infinite
        truth = torch.arange(2) + place
        q = posterior.condition(truth)
        assert (q.mean - truth).abs().max() < 0.05
        assert (q.stddev > 0).all()
        assert (q.stddev < 0.05).all()
        assert q.log_prob(truth) - prior.log_prob(truth) > nats
        assert q.log_prob(truth).isfinite()
        assert q.sample((64,), generator=generator(0)).isfinite().all()


def test_thirty_parameters_are_found_at_once():
    prior, posterior = fitted(30, noise=0.1, pairs=600, components=1)
    truth = torch.arange(30) + torch.linspace(0.2, 0.8, 30)
    q = posterior.condition(truth)
    far = (q.mean - truth).abs()
    assert far.mean() < 0.15  # against 0.2 of the prior's mean
    assert (q.stddev < prior.stddev).all()
    assert (far < 3.5 * q.stddev).all()
    assert q.log_prob(truth) > prior.log_prob(truth)
    draws = q.sample((64,), generator=generator(0))
    assert prior.contains(draws).all()
