"""The factors on deviations, where what the networks know is known."""

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.averaged_posterior import AveragedPosterior
from torchrl_bayessim.inference.ensemble import fit_together
from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.network import widened
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.inference.widening import _as_one, average, widen
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
    found = widen([network], held_out())
    assert found.item() == pytest.approx(factor, abs=0.03)
    torch.testing.assert_close(network.network.widening, found.float())


def test_the_pairs_stay_as_they_were():
    pairs = held_out(20)
    widen([sure(DEVIATION), sure(DEVIATION)], pairs)
    assert set(pairs.keys(include_nested=True)) == {"theta", "summary"}


def test_a_network_alone_is_never_made_surer():
    assert widen([sure(2 * DEVIATION)], held_out()).item() == 1.0


@pytest.mark.parametrize("deviation", [0.5, 1.0])
def test_an_average_of_networks_that_disagree_is_as_wide_as_held_out_pairs_like(deviation):
    """Of +-d, each with deviation s, the mixture's variance is s^2 + d^2: too much for s alone."""
    apart = DEVIATION / 2**0.5
    networks = [sure(deviation * DEVIATION, at) for at in (-apart, apart)]
    widen(networks, held_out())
    first, second = (network.network for network in networks)
    assert torch.equal(first.widening, second.widening)
    assert torch.equal(first.apart, second.apart)
    assert first.apart.item() < 0.9
    q = AveragedPosterior(networks).distribution(torch.zeros(1))
    assert q.stddev.item() == pytest.approx(DEVIATION, rel=0.03)
    theta = held_out()["theta"]
    for share in (0.5, 0.9):
        draws = q.sample((20_000,), generator=generator("draws")).abs().quantile(share)
        assert (theta.abs() < draws).float().mean().item() == pytest.approx(share, abs=0.02)


def test_networks_whose_truths_lie_where_one_of_them_does_stay_apart():
    """Two modes, of which each network knows one: between them lies nothing."""
    networks = [sure(DEVIATION, at) for at in (-1.0, 1.0)]
    pairs = held_out()
    pairs["theta"][::2] += 1.0
    pairs["theta"][1::2] -= 1.0
    widen(networks, pairs)
    for network in networks:
        assert network.network.apart.item() == pytest.approx(1.0, abs=0.02)
        assert network.network.widening.item() == pytest.approx(1.0, abs=0.05)


def test_answers_that_are_multiplied_are_averaged_as_they_are():
    networks = [sure(DEVIATION, at) for at in (-0.1, 0.1)]
    for network in networks:
        network.network.apart.fill_(0.0)
    averaged, x = AveragedPosterior(networks), torch.zeros(2, 1)
    one, several = (averaged.condition(some, check=False).mixture.loc for some in (x[:1], x))
    assert one.flatten().tolist() == pytest.approx([0.0, 0.0])
    assert several[0] < 0 < several[1]
    mean = averaged.condition(x, pooling="mean", check=False).mixture.loc
    torch.testing.assert_close(mean, one)
    networks[1].network.apart.fill_(1.0)  # fitted one by one
    assert averaged.condition(x[0], check=False).mixture.loc[0] < 0


def test_a_state_brings_how_far_networks_stay_apart_and_a_fit_begins_with_all_of_it():
    network, again = sure(DEVIATION), sure(DEVIATION)
    network.network.apart.fill_(0.3)
    again.load_state_dict(network.state_dict())
    assert again.network.apart.item() == pytest.approx(0.3)
    before = {k: v for k, v in network.state_dict().items() if not k.endswith("apart")}
    sure(DEVIATION).load_state_dict(before)  # of a network saved before there was such a share
    pairs = held_out(100)
    fit(again, pairs.set("summary", pairs["theta"]), epochs=1, progress=False)
    assert again.network.apart.item() == 1.0


def test_each_parameter_gets_the_factor_that_it_lacks():
    prior = GaussianPrior({"a": (0.0, 1.0), "b": (0.0, 1.0)})
    network = MixtureDensityPosterior(prior, 1, components=1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        variance = torch.tensor([(DEVIATION / 2) ** 2, DEVIATION**2])
        network.network.head.bias[3:5] = variance.log()
    noise = DEVIATION * torch.randn(4000, 2, generator=generator("held out"))
    pairs = TensorDict({"theta": noise, "summary": torch.zeros(4000, 1)}, [4000])
    assert widen([network], pairs).tolist() == pytest.approx([2.0, 1.0], abs=0.05)


SHARP, VAGUE = 0.1, 0.4  # deviations of a network that tells two summaries apart


def discerning():
    """Return a network that answers N(0, SHARP^2) to a summary of 0, and N(0, VAGUE^2) to 10."""
    network = MixtureDensityPosterior(PRIOR, 1, components=1, compress=False)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        features, head = network.network.features, network.network.head
        features.first.weight[0] = 1.0
        head.bias[2] = 2 * math.log(SHARP)
        head.weight[2, 0] = 2 * math.log(VAGUE / SHARP) / float(features(torch.tensor([10.0]))[0])
    return network


def told_apart(power, count=2000):
    """Return pairs of both summaries, with deviations as far apart as this power makes them."""
    sharp, middle = torch.arange(count) % 2 == 0, (SHARP * VAGUE) ** 0.5
    deviation = middle * (torch.where(sharp, SHARP, VAGUE) / middle) ** power
    theta = deviation[:, None] * torch.randn(count, 1, generator=generator("told apart"))
    summary = torch.where(sharp, 0.0, 10.0)[:, None]
    return TensorDict({"theta": theta, "summary": summary}, [count])


@pytest.mark.parametrize("power", [0.7, 1.0, 1.5])
def test_an_average_learns_how_much_sharper_sharp_answers_are(power):
    networks = [discerning(), discerning()]
    pairs = told_apart(power)
    assert widen(networks, pairs).item() == pytest.approx(1.0, abs=0.05)
    for network in networks:
        assert network.network.contrast.item() == pytest.approx(power, abs=0.05)
        found = network.distribution(torch.tensor([[0.0], [10.0]])).stddev[:, 0]
        sharp = pairs["summary"][:, 0] == 0
        for deviation, rows in zip(found.tolist(), (sharp, ~sharp), strict=True):
            assert deviation == pytest.approx(pairs["theta"][rows].std().item(), rel=0.05)


def test_a_network_alone_keeps_the_contrast_that_it_has():
    network = discerning()
    widen([network], told_apart(1.5))
    assert network.network.contrast.item() == 1.0


def heavy(ratio, count=4000):
    """Return pairs of which one in five deviates so many times more than the others."""
    pairs = held_out(count)
    pairs["theta"][::5] *= ratio
    return pairs


@pytest.mark.parametrize("ratio", [1.0, 1.5, 2.5])
def test_an_average_learns_how_heavy_the_tails_of_its_errors_are(ratio):
    networks = [sure(DEVIATION), sure(DEVIATION)]
    pairs = heavy(ratio)
    widen(networks, pairs)
    for network in networks:
        if ratio > 1:
            assert network.network.tails.exp().item() == pytest.approx(ratio, rel=0.1)
        else:
            assert network.network.tails.exp().item() < 1.25
        q = network.distribution(torch.zeros(1))
        deviation = pairs["theta"].std().item()
        assert q.stddev.item() == pytest.approx(deviation, rel=0.03)  # tails do not change it
        for share in (0.5, 0.9):
            draws = q.sample((20_000,), generator=generator("draws")).abs().quantile(share)
            covered = (pairs["theta"].abs() < draws).float().mean().item()
            assert covered == pytest.approx(share, abs=0.02)


def test_a_state_brings_its_tails_and_a_fit_begins_without():
    network, other = sure(DEVIATION), sure(DEVIATION)
    widen([network, other], heavy(2.5))
    again = sure(2 * DEVIATION)
    again.load_state_dict(network.state_dict())
    mixture = again.distribution(torch.zeros(1)).mixture
    expected = network.distribution(torch.zeros(1)).mixture
    torch.testing.assert_close(mixture.logits, expected.logits)
    torch.testing.assert_close(mixture.scale_tril, expected.scale_tril)
    again.load_state_dict(sure(DEVIATION).state_dict())
    assert len(again.network.tails) == 0
    pairs = held_out(100)
    fit(network, pairs.set("summary", pairs["theta"]), epochs=1, progress=False)
    assert len(network.network.tails) == 0


def test_a_network_alone_keeps_gaussian_components():
    network = sure(DEVIATION)
    widen([network], heavy(2.5))
    assert len(network.network.tails) == 0
    assert network.distribution(torch.zeros(1)).mixture.logits.shape == (1,)


def test_a_few_pairs_move_the_factor_less_than_many():
    few, many = (widen([sure(DEVIATION / 1.3)], held_out(count)).item() for count in (20, 4000))
    assert 1.0 <= few < many


def test_pairs_count_by_their_weight():
    narrow, wide = held_out(), held_out(spread=2 * DEVIATION)
    pairs: Any = torch.cat([narrow, wide])  # typed as if of tensors
    pairs["weight"] = torch.cat([torch.zeros(len(narrow)), torch.ones(len(wide))])
    assert widen([sure(DEVIATION)], pairs).item() == pytest.approx(2.0, abs=0.05)
    pairs["weight"] = 1 - pairs["weight"]
    assert widen([sure(DEVIATION)], pairs).item() == pytest.approx(1.0, abs=0.05)


def fitted_together(count, **options):
    networks = [MixtureDensityPosterior(PRIOR, 1, components=1, seed=seed) for seed in (0, 1)]
    theta = PRIOR.sample((count,), generator=generator("theta"))
    noise = 0.3 * torch.randn(count, 1, generator=generator("noise"))
    pairs = TensorDict({"theta": theta, "summary": theta + noise}, [count])
    fit_together(networks, pairs, **{"epochs": 3, "progress": False} | options)
    return networks


def test_a_few_held_out_pairs_do_not_choose_how_wide_an_average_is():
    for network in fitted_together(490, seeds=(0, 1)):
        assert network.network.widening >= 1
    one, two = fitted_together(500, seeds=(0, 1), epochs=20)
    assert one.network.widening == two.network.widening


def test_networks_together_hold_out_the_same_pairs_and_a_given_seed_chooses_them():
    one, two = fitted_together(100, seeds=(0, 1))
    assert torch.equal(one.held_out["theta"], two.held_out["theta"])
    seeded, other = (fitted_together(100, seeds=seeds, seed=5)[0] for seeds in ((0, 1), (2, 3)))
    assert torch.equal(seeded.held_out["theta"], other.held_out["theta"])
    assert not torch.equal(one.held_out["theta"], seeded.held_out["theta"])


def test_an_average_of_other_covariances_is_not_diagonal():
    box = (-torch.ones(2), torch.ones(2))
    tril = torch.tensor([[[0.5, 0.0], [0.4, 0.3]]])
    parts = [
        TruncatedGaussianMixture(torch.zeros(1), torch.zeros(1, 2), scale, box, diagonal=diagonal)
        for scale, diagonal in ((0.5 * torch.eye(2)[None], True), (tril, False))
    ]
    z = torch.tensor([[0.2, -0.3]])
    expected = (parts[0].log_prob(z).exp() + parts[1].log_prob(z).exp()) / 2
    for order in (parts, parts[::-1]):
        torch.testing.assert_close(average(order).log_prob(z).exp(), expected)


def test_the_average_has_the_mean_density():
    one, two = (sure(DEVIATION, at).distribution(torch.zeros(1)).mixture for at in (-0.1, 0.3))
    z = torch.linspace(-1, 1, 9)[:, None].double()
    expected = (one.log_prob(z).exp() + two.log_prob(z).exp()) / 2
    torch.testing.assert_close(average([one, two]).log_prob(z).exp(), expected)
    assert average([one]) is one


def test_of_very_many_pairs_those_count_that_have_weight():
    pairs = held_out(5000)
    pairs["weight"] = torch.full((5000,), 1e-9)
    pairs["weight"][1::50] = 1.0
    pairs["theta"][1::50] *= 2
    assert widen([sure(DEVIATION)], pairs).item() > 1.6


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_the_unit_of_the_weights_does_not_matter(unit):
    pairs = held_out(100)
    expected = widen([sure(DEVIATION / 1.5)], pairs)
    pairs["weight"] = torch.full((100,), unit)
    torch.testing.assert_close(widen([sure(DEVIATION / 1.5)], pairs), expected)
    assert expected > 1.2


def test_pairs_on_the_rim_do_not_hide_how_sure_the_others_find_it():
    prior = BoxPrior({"a": (1.0, 1.05)}, log=["a"])
    theta = torch.cat([torch.full((1, 1), 1.0 - 5e-7), torch.linspace(1.0, 1.05, 199)[:, None]])
    pairs = TensorDict({"theta": theta, "summary": torch.zeros(200, 1)}, [200])
    network = MixtureDensityPosterior(prior, 1, components=1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        network.network.head.bias.copy_(torch.tensor([0.0, 0.0, -4.0]))
    assert prior.contains(theta).all()
    assert widen([network], pairs) > 2


def test_what_is_tried_is_what_the_average_will_be():
    """Networks of other components and covariances too."""
    prior = BoxPrior({"a": (0.0, 1.0), "b": (0.1, 2.0)})
    kinds: list[dict[str, Any]] = [
        {"covariance": "diagonal", "components": 2},
        {"covariance": "full", "components": 3},
    ]
    networks = [MixtureDensityPosterior(prior, 2, seed=7, **kind).network for kind in kinds]
    summary = torch.randn(5, 2, generator=generator("tried"))
    z = torch.rand(5, 2, generator=generator("tried at"))
    scaling = torch.tensor([0.7, 1.2]), torch.tensor([0.9, 1.1]), torch.tensor([0.4])
    shares = torch.tensor([0.3, 0.8])
    together, nearer = _as_one([n.components_of(n.raw(n.scaled(summary))) for n in networks])
    moved = together._replace(loc=together.loc + (1 - shares) * nearer)
    tried = TruncatedGaussianMixture(*widened(moved, *scaling), prior.box)
    for network in networks:
        network.widening, network.contrast, network.tails = scaling
    members = [TruncatedGaussianMixture(*network(summary), prior.box) for network in networks]
    torch.testing.assert_close(tried.log_prob(z), average(members, shares).log_prob(z))
