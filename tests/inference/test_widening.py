"""The factor on all deviations, where what the networks know is known."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import GaussianPrior
from torchrl_bayessim.inference.widening import average, widen
from torchrl_bayessim.randomness import generator

PRIOR = GaussianPrior({"a": (0.0, 1.0)})
DEVIATION = 0.2


def sure(deviation, at=0.0):
    """Return a network that answers N(at, deviation^2) to every summary."""
    network = MixtureDensityPosterior(PRIOR, 1, components=1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        variance = torch.tensor(deviation**2)
        network.network.head.bias.copy_(torch.tensor([0.0, at, variance.log()]))
    return network


def held_out(count=4000, spread=DEVIATION):
    noise = torch.randn(count, 1, generator=generator("held out"))
    return TensorDict({"theta": spread * noise, "summary": torch.zeros(count, 1)}, [count])


@pytest.mark.parametrize("factor", [1.0, 1.1, 1.3, 2.0])
def test_a_network_that_is_too_sure_gets_the_factor_that_it_lacks(factor):
    network = sure(DEVIATION / factor)
    assert widen([network], held_out()) == factor == pytest.approx(network.network.widening.item())


def test_the_pairs_stay_as_they_were():
    pairs = held_out(20)
    widen([sure(DEVIATION), sure(DEVIATION)], pairs)
    assert set(pairs.keys(include_nested=True)) == {"theta", "summary"}


def test_a_network_alone_is_never_made_surer():
    assert widen([sure(2 * DEVIATION)], held_out()) == 1.0


def test_an_average_of_networks_that_disagree_is_made_surer():
    """Of +-d, each with deviation s, the mixture's variance is s^2 + d^2: too much for s alone."""
    apart = DEVIATION / 2**0.5
    networks = [sure(DEVIATION, at) for at in (-apart, apart)]
    factor = widen(networks, held_out())
    assert 0.7 < factor < 0.9  # the variance is met at 0.71, of which 5 % are reserve
    assert [n.network.widening.item() for n in networks] == pytest.approx([factor] * 2)


def test_pairs_count_by_their_weight():
    narrow, wide = held_out(), held_out(spread=2 * DEVIATION)
    pairs: Any = torch.cat([narrow, wide])  # typed as if of tensors
    pairs["weight"] = torch.cat([torch.zeros(len(narrow)), torch.ones(len(wide))])
    assert widen([sure(DEVIATION)], pairs) == 2.0
    pairs["weight"] = 1 - pairs["weight"]
    assert widen([sure(DEVIATION)], pairs) == 1.0


def test_the_average_has_the_mean_density():
    one, two = (sure(DEVIATION, at).distribution(torch.zeros(1)).mixture for at in (-0.1, 0.3))
    z = torch.linspace(-1, 1, 9)[:, None].double()
    expected = (one.log_prob(z).exp() + two.log_prob(z).exp()) / 2
    torch.testing.assert_close(average([one, two]).log_prob(z).exp(), expected)
    assert average([one]) is one
