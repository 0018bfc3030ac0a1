import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_bayessim.inference import pooling
from torchrl_bayessim.inference.mixtures import Mixture, moment_match
from torchrl_bayessim.inference.pooling import pool
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.randomness import generator

EDGE = 3**0.5


def box(dim):
    edge = EDGE * torch.ones(dim, dtype=torch.float64)
    return -edge, edge


def gaussians(mean, deviation, limits=None):
    """One Gaussian per trajectory, in one dimension."""
    n = len(mean)
    scale = torch.full((n, 1, 1, 1), deviation, dtype=torch.float64)
    return TruncatedGaussianMixture(torch.zeros(n, 1), mean.reshape(n, 1, 1), scale, limits)


def random_posteriors(n, *, components=2, dim=1, limits=None, key=0):
    g = generator("posteriors", key)
    loc = torch.randn(n, components, dim, generator=g, dtype=torch.float64)
    scale = 0.3 + 0.5 * torch.rand(n, components, dim, generator=g, dtype=torch.float64)
    logits = torch.randn(n, components, generator=g, dtype=torch.float64)
    return TruncatedGaussianMixture(logits, loc, torch.diag_embed(scale), limits)


@pytest.mark.parametrize("n", [1, 4, 16, 100])
def test_a_box_prior_sharpens_as_the_root_of_n(n):
    x = torch.randn(n, generator=generator(0), dtype=torch.float64)
    pooled = pool(gaussians(x, 0.5), bounded=True)
    assert pooled.scale_tril.item() == pytest.approx(0.5 / n**0.5)
    assert pooled.loc.item() == pytest.approx(x.mean().item())


@pytest.mark.parametrize("n", [1, 4, 16, 100])
@pytest.mark.parametrize("noise", [0.3, 2.0])
def test_a_gaussian_prior_gives_the_linear_gaussian_posterior(n, noise):
    """z ~ N(0, 1) and x_i ~ N(z, noise^2) have precision 1 + n / noise^2: one prior, not n."""
    x = 0.7 + noise * torch.randn(n, generator=generator(1), dtype=torch.float64)
    one = 1 / (1 + noise**-2)
    pooled = pool(gaussians(one * x / noise**2, one**0.5), bounded=False)
    precision = 1 + n / noise**2
    assert pooled.scale_tril.item() == pytest.approx(precision**-0.5)
    assert pooled.loc.item() == pytest.approx(x.sum().item() / noise**2 / precision)


@pytest.mark.parametrize("bounded", [True, False])
def test_uninformative_trajectories_leave_the_prior(bounded):
    wide = 1e4 if bounded else 1.0
    pooled = pool(gaussians(torch.zeros(20), wide, box(1) if bounded else None), bounded=bounded)
    mean, covariance = pooled.quadrature()[0].mean(), pooled.quadrature()[0].var()
    assert mean.item() == pytest.approx(0, abs=0.02)
    assert covariance.item() == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("bounded", [True, False])
def test_products_of_mixtures_are_those_of_quadrature(bounded):
    each = random_posteriors(3, limits=box(1) if bounded else None)
    if bounded:
        axis = torch.linspace(-EDGE, EDGE, 4001, dtype=torch.float64)
        log_prior = torch.zeros_like(axis)
    else:
        axis = torch.linspace(-6, 6, 4001, dtype=torch.float64)
        log_prior = -0.5 * axis**2
    log_density = each.log_prob(axis[:, None, None].expand(-1, 3, 1)).sum(-1) - 2 * log_prior
    density = (log_density - log_density.max()).exp()
    density /= torch.trapezoid(density, axis)
    got = pool(each, bounded=bounded).log_prob(axis[:, None]).exp()
    assert torch.trapezoid((got - density).abs(), axis) < 1e-6


def test_reducing_the_components_loses_little(monkeypatch):
    each = random_posteriors(6, components=3, dim=2, limits=box(2))
    reduced = pool(each, bounded=True)
    assert reduced.logits.numel() == pooling.MAX_COMPONENTS
    monkeypatch.setattr(pooling, "MAX_COMPONENTS", 3**6)
    full = pool(each, bounded=True)
    draws = full.sample((4000,), generator=generator(2))
    divergence = (full.log_prob(draws) - reduced.log_prob(draws)).mean()
    assert divergence.abs() < 0.01


@pytest.mark.parametrize("bounded", [True, False])
@given(order=st.permutations(range(5)))
@settings(max_examples=8, deadline=None)
def test_the_order_of_trajectories_does_not_matter_at_all(bounded, order):
    each = random_posteriors(5, components=2, dim=2, limits=box(2) if bounded else None)
    rows = torch.tensor(order)
    shuffled = TruncatedGaussianMixture(
        each.logits[rows], each.loc[rows], each.scale_tril[rows], each.box
    )
    first, second = pool(each, bounded=bounded), pool(shuffled, bounded=bounded)
    assert torch.equal(first.logits, second.logits)
    assert torch.equal(first.loc, second.loc)
    assert torch.equal(first.scale_tril, second.scale_tril)


def test_nor_does_it_where_only_the_widths_differ():
    scale = torch.tensor([0.3, 1.0, 0.5, 2.0], dtype=torch.float64).reshape(4, 1, 1, 1)
    loc, logits = 0.1 * torch.ones(4, 1, 1), torch.zeros(4, 1)
    first, second = (
        pool(TruncatedGaussianMixture(logits, loc, s, box(1)), bounded=True)
        for s in (scale, scale.flip(0))
    )
    assert torch.equal(first.scale_tril, second.scale_tril)
    assert torch.equal(first.loc, second.loc)


@pytest.mark.parametrize(
    "prior",
    [BoxPrior({"a": (0.0, 1.0), "b": (2.0, 6.0)}), GaussianPrior({"a": (0, 1), "b": (4, 1)})],
    ids=["box", "gaussian"],
)
@pytest.mark.parametrize("pooling", ["product", "mean"])
def test_conditioning_does_not_depend_on_the_order(prior, pooling):
    posterior = MixtureDensityPosterior(prior, 5, components=4)
    theta = prior.sample((20,), generator=generator(3))
    for n in (2, 3):
        real = torch.randn(n, 5, generator=generator(4, n))
        expected = posterior.condition(real, pooling=pooling).log_prob(theta)
        for rows in itertools.permutations(range(n)):
            got = posterior.condition(real[list(rows)], pooling=pooling).log_prob(theta)
            assert torch.equal(got, expected)


def test_more_trajectories_sharpen_a_conditioned_posterior():
    posterior = MixtureDensityPosterior(BoxPrior({"a": (0.0, 1.0)}), 3, components=1)
    with torch.no_grad():  # a narrow posterior near the middle, wherever the summary moves it
        posterior.network.head.weight[[0, 2]] = 0.0
        posterior.network.head.weight[1] *= 20
        posterior.network.head.bias.copy_(torch.tensor([0.0, 0.0, -4.0]))
    rows = torch.randn(16, 3, generator=generator("scattered"))
    deviation = [posterior.condition(rows[:n]).stddev.item() for n in (1, 4, 16)]
    assert deviation[0] / deviation[1] == pytest.approx(2, rel=1e-2)
    assert deviation[1] / deviation[2] == pytest.approx(2, rel=1e-2)


def test_a_component_wider_than_a_gaussian_prior_stays_in_its_place():
    logits = torch.tensor([0.99, 0.01]).log().expand(4, 2)
    loc = torch.tensor([0.3, 2.5], dtype=torch.float64)[:, None].expand(4, 2, 1)
    scale = torch.tensor([0.2, 3.0], dtype=torch.float64)[:, None, None].expand(4, 2, 1, 1)
    pooled = pool(TruncatedGaussianMixture(logits, loc, scale, None), bounded=False)
    mean, covariance = moment_match(Mixture(pooled.logits, pooled.loc, pooled.scale_tril))
    assert mean.item() == pytest.approx(0.3, abs=0.05)
    assert covariance.item() == pytest.approx(1 / (4 / 0.04 - 3), rel=0.1)


def test_contradicting_trajectories_still_give_a_density():
    far = torch.tensor([-1.7, 1.7, -1.7, 1.7], dtype=torch.float64)
    pooled = pool(gaussians(far, 1e-3, box(1)), bounded=True)
    assert pooled.loc.item() == pytest.approx(0, abs=1e-6)
    assert pooled.log_prob(torch.zeros(1)).isfinite()


@pytest.mark.parametrize("bounded", [True, False])
def test_a_hundred_sharp_correlated_trajectories_stay_positive_definite(bounded):
    g = generator(5)
    rows = torch.tensor([[1.0, 0.0], [0.9999, (1 - 0.9999**2) ** 0.5]], dtype=torch.float64)
    loc = 0.01 * torch.randn(100, 2, 2, generator=g, dtype=torch.float64)
    scale = (1e-3 * rows).expand(100, 2, 2, 2)
    each = TruncatedGaussianMixture(torch.zeros(100, 2), loc, scale, box(2) if bounded else None)
    pooled = pool(each, bounded=bounded)
    assert pooled.log_prob(pooled.sample((50,), generator=g)).isfinite().all()
