import math

import pytest
import torch

from torchrl_bayessim.inference.features import ResidualFeatures
from torchrl_bayessim.inference.mixture_gradients import log_density_and_pullback
from torchrl_bayessim.inference.network import MixtureDensityNetwork, widened
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.randomness import generator

EDGE = math.sqrt(3.0)


def network(parameters, covariance, reach=EDGE, components=3):
    return MixtureDensityNetwork(
        ResidualFeatures(2),
        parameters,
        components=components,
        covariance=covariance,
        reach=reach,
    )


@pytest.mark.parametrize("boxed", [False, True])
@pytest.mark.parametrize("covariance", ["full", "diagonal"])
@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize("spread", [0.1, 1.0, 5.0])
def test_density_and_gradient_are_those_of_autograd(size, covariance, boxed, spread):
    net = network(size, covariance)
    draw = generator("gradients", size, covariance, boxed)
    raw = spread * torch.randn(2, 7, sum(net.sizes), dtype=torch.float64, generator=draw)
    value = EDGE * (2 * torch.rand(2, 7, size, dtype=torch.float64, generator=draw) - 1)
    box = (torch.full((size,), -EDGE), torch.full((size,), EDGE)) if boxed else None
    raw.requires_grad_()
    mixture = widened(net.components_of(raw), net.widening, net.contrast, net.tails)
    diagonal = covariance == "diagonal"
    expected = TruncatedGaussianMixture(*mixture, box, diagonal=diagonal, points=8).formula(value)
    upstream = torch.randn(expected.shape, dtype=torch.float64, generator=draw)
    (gradient,) = torch.autograd.grad((expected * upstream).sum(), raw)
    log_q, pullback = log_density_and_pullback(net, raw, value, box=box, points=8)
    assert not log_q.requires_grad
    torch.testing.assert_close(log_q, expected.detach(), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(pullback(upstream), gradient, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("covariance", ["full", "diagonal"])
def test_gradients_stay_finite_far_out(covariance):
    net = network(2, covariance)
    box = torch.full((2,), -EDGE), torch.full((2,), EDGE)
    draw = generator("far out")
    raw = 60.0 * torch.randn(500, sum(net.sizes), generator=draw)
    value = EDGE * (2 * torch.rand(500, 2, generator=draw) - 1)
    log_q, pullback = log_density_and_pullback(net, raw, value, box=box)
    assert log_q.isfinite().all()
    assert pullback(torch.ones(500)).isfinite().all()


@pytest.mark.parametrize("covariance", ["full", "diagonal"])
def test_densities_are_given_where_autograd_is_off_and_for_one_pair(covariance):
    net = network(2, covariance)
    box = torch.full((2,), -EDGE), torch.full((2,), EDGE)
    raw = torch.randn(sum(net.sizes), generator=generator("one"))
    with torch.no_grad():
        log_q, _ = log_density_and_pullback(net, raw, torch.zeros(2), box=box)
    again, pullback = log_density_and_pullback(net, raw, torch.zeros(2), box=box)
    assert log_q == again
    assert pullback(torch.ones(())).shape == raw.shape
