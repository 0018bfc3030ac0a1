import math

import pytest
import torch

from torchrl_bayessim.inference.features import ResidualFeatures
from torchrl_bayessim.inference.network import MixtureDensityNetwork
from torchrl_bayessim.inference.stacked import StackedNetworks
from torchrl_bayessim.inference.steps import Steps, _rate


def test_the_learning_rate_rises_once_and_falls_to_nothing():
    rates = [_rate(step, 200) for step in range(200)]
    top = rates.index(max(rates))
    assert top == 20
    assert max(rates) == pytest.approx(1.0)
    assert rates[:top] == sorted(rates[:top])
    assert rates[top:] == sorted(rates[top:], reverse=True)
    assert rates[-1] < 1e-3
    assert all(math.isfinite(_rate(step, 1)) for step in range(3))


@pytest.mark.parametrize("weight_decay", [0.0, 0.1])
def test_steps_are_those_of_adamw(weight_decay):
    network = MixtureDensityNetwork(
        ResidualFeatures(3, width=8), 2, components=2, covariance="full", reach=1.7
    )
    stacked = StackedNetworks([network])
    whole = stacked.parameters.clone().requires_grad_()
    usual = torch.optim.AdamW([whole], lr=1.0, betas=(0.9, 0.95), weight_decay=weight_decay)
    step = Steps(stacked, 10, lr=1e-2, weight_decay=weight_decay)
    for i in range(10):
        gradient = torch.randn(whole.shape, generator=torch.Generator().manual_seed(i))
        stacked.gradient.copy_(gradient)
        whole.grad = gradient.clone()
        torch.nn.utils.clip_grad_norm_([whole], 10.0)
        usual.param_groups[0]["lr"] = 1e-2 * _rate(i, 10)
        usual.step()
        step()
    torch.testing.assert_close(stacked.parameters, whole.detach(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("usual", [torch.float32, torch.float64])
def test_the_first_step_is_the_rate_long(usual):
    torch.set_default_dtype(usual)
    try:
        network = MixtureDensityNetwork(
            ResidualFeatures(3, width=8), 2, components=2, covariance="full", reach=1.7
        )
        stacked = StackedNetworks([network])
        before = stacked.parameters.clone()
        stacked.gradient.fill_(1e-2)
        Steps(stacked, 10, lr=1e-2, weight_decay=0.0)()
    finally:
        torch.set_default_dtype(torch.float32)
    expected = torch.full_like(before, 1e-2 * _rate(0, 10))
    torch.testing.assert_close(before - stacked.parameters, expected, rtol=1e-3, atol=0)
