"""Answers that err together: how much of it is found, and what a product of them then is."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.averaged_posterior import AveragedPosterior
from torchrl_bayessim.inference.design_effect import shared_by_neighbours, shared_by_rows, widened
from torchrl_bayessim.inference.ensemble import fit_apart
from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.inference.pooling import pool
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.randomness import generator

NOISE = 0.2


def randn(*shape, key):
    return torch.randn(*shape, generator=generator("design effect", key), dtype=torch.float64)


def answers(loc, deviation=1.0):
    """Gaussian answers with these means, shape (n, D)."""
    scale = deviation * torch.eye(loc.shape[-1], dtype=torch.float64)
    scale = scale.expand(len(loc), 1, *scale.shape)
    return TruncatedGaussianMixture(torch.zeros(len(loc), 1), loc.unsqueeze(-2), scale, None)


def erring(share, count=1000, *, key=0):
    """Pairs, and answers that err by what they tell nothing of and by a function of theta."""
    z = 3**0.5 * (2 * torch.rand(count, 1, generator=generator("z", key), dtype=torch.float64) - 1)
    common = 2**0.5 * (3 * z).sin()  # of variance 1
    noise = (1 - share) ** 0.5 * randn(count, 1, key=key)
    return z, answers(z + NOISE * (noise + share**0.5 * common), NOISE)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.8])
def test_neighbours_tell_the_share_of_the_error_that_they_have_in_common(share):
    found = [
        shared_by_neighbours(each.untruncated, z, bounded=True).item()
        for z, each in (erring(share, key=key) for key in range(5))
    ]
    assert sum(found) / 5 == pytest.approx(share, abs=0.06)


def test_under_a_gaussian_prior_what_the_prior_pulls_is_no_error():
    z = randn(1500, 1, key="prior")
    noise = 0.7
    exact = 1 / (1 + noise**-2)
    x = z + noise * randn(1500, 1, key="noise")
    each = answers(exact * x / noise**2, exact**0.5)
    assert shared_by_neighbours(each.untruncated, z, bounded=False).item() < 0.06
    assert (
        shared_by_neighbours(each.untruncated, z, bounded=True).item() > 0.2
    )  # without the prior's score


@pytest.mark.parametrize("n", [2, 5, 20])
def test_rows_of_a_right_answer_seldom_seem_to_share_anything(n):
    found = [
        shared_by_rows(answers(randn(n, 1, key=(n, k))).untruncated, bounded=True)
        for k in range(400)
    ]
    assert (torch.stack(found) > 0).double().mean() < 0.08  # 5 % expected


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_rows_give_a_lower_bound_that_comes_near_with_many(share):
    def found(n, key):
        rows = (1 - share) ** 0.5 * randn(n, 1, key=key) + share**0.5
        return shared_by_rows(answers(rows).untruncated, bounded=True)

    few = torch.stack([found(10, key) for key in range(200)])
    assert (few <= share).double().mean() > 0.92
    assert found(2000, "many").item() == pytest.approx(share, abs=0.04)


@pytest.mark.parametrize("noise", [0.3, 2.0])
def test_weak_data_under_a_gaussian_prior_are_not_taken_for_a_shared_error(noise):
    """Posterior means that hardly move with the data scatter little, and rightly so."""
    x = 0.5 + noise * randn(200, 1, key="weak")
    exact = 1 / (1 + noise**-2)
    each = answers(exact * x / noise**2, exact**0.5)
    assert shared_by_rows(each.untruncated, bounded=False).item() == pytest.approx(0, abs=0.05)


def test_the_same_trajectory_again_says_nothing_new():
    each = answers(0.4 * torch.ones(7, 2, dtype=torch.float64), 0.3)
    pooled = pool(each, bounded=True, shared=shared_by_rows(each.untruncated, bounded=True))
    assert torch.allclose(pooled.scale_tril[0].diagonal(), 0.3 * torch.ones(2).double())


@pytest.mark.parametrize("bounded", [True, False])
def test_a_product_is_as_sure_as_the_design_effect_says(bounded):
    n, share, noise = 8, 0.25, 0.5
    worth = n / (1 + (n - 1) * share)
    x = 0.3 + noise * randn(n, 1, key="worth")
    precision = noise**-2 + (0 if bounded else 1)
    each = answers(x * noise**-2 / precision, precision**-0.5)
    pooled = pool(each, bounded=bounded, shared=torch.tensor([share]))
    expected = worth * noise**-2 + (0 if bounded else 1)
    assert pooled.scale_tril.item() == pytest.approx(expected**-0.5)
    assert pooled.loc.item() == pytest.approx(worth * x.mean().item() * noise**-2 / expected)


def test_parameters_share_errors_each_by_its_own():
    each = answers(randn(6, 2, key="own"), 0.5)
    pooled = pool(each, bounded=True, shared=torch.tensor([0.0, 1.0]))
    expected = torch.tensor([0.5 / 6**0.5, 0.5], dtype=torch.float64)
    assert torch.allclose(pooled.scale_tril[0].diagonal(), expected)


def test_one_trajectory_is_left_as_it_is():
    each = answers(randn(1, 2, key="one"))
    assert torch.equal(shared_by_rows(each.untruncated, bounded=True), torch.zeros(2).double())
    alone = widened(each.untruncated, torch.tensor([0.5, 0.9]), bounded=True)
    assert torch.equal(alone.scale_tril, each.scale_tril)


def idle(count, *, prior, seed):
    """Pairs of a parameter that is measured, and of one that does nothing."""
    theta = prior.sample((count,), generator=generator(seed, "theta"))
    noise = 0.3 * torch.randn(count, 4, generator=generator(seed, "noise"))
    return theta, prior.standardize(theta)[:, :1] + noise


@pytest.mark.parametrize("n", [10, 40])
@pytest.mark.parametrize(
    "prior",
    [
        BoxPrior({"mass": (2.0, 6.0), "colour": (0.0, 1.0)}),
        GaussianPrior({"mass": (4.0, 1.0), "colour": (0.0, 1.0)}),
    ],
)
def test_trajectories_together_invent_nothing_of_a_parameter_that_does_nothing(prior, n):
    theta, x = idle(600, prior=prior, seed=0)
    networks = [MixtureDensityPosterior(prior, 4, seed=seed) for seed in range(3)]
    fit_apart(
        networks,
        TensorDict({"theta": theta, "summary": x}, [600]),
        seeds=range(3),
        epochs=30,
        progress=False,
    )
    together = AveragedPosterior(networks)
    truth = prior.sample((1,), generator=generator("truth"))
    rows = prior.standardize(truth)[:, :1] + 0.3 * randn(n, 4, key=n).float()
    posterior = together.condition(rows, check=False)
    one = together.condition(rows[:1], check=False)
    assert posterior.stddev[1] > 0.8 * prior.stddev[1]
    assert posterior.stddev[0] < 0.8 * one.stddev[0]  # what is measured is known better
    if prior.box is not None:
        plain = pool(networks[0].distribution(rows).mixture, bounded=True)
        alone = networks[0].condition(rows, check=False).stddev[1]
        assert alone > 1.1 * PhysicsPosterior(plain, prior).stddev[1]  # which does invent some


def test_a_state_brings_its_shares_and_a_fit_begins_without():
    prior = BoxPrior({"a": (0.0, 1.0)})
    network = MixtureDensityPosterior(prior, 1)
    network.network.shared.fill_(0.3)
    again = MixtureDensityPosterior(prior, 1)
    again.load_state_dict(network.state_dict())
    assert again.network.shared.item() == pytest.approx(0.3)
    before = {k: v for k, v in network.state_dict().items() if not k.endswith("shared")}
    again.load_state_dict(before)
    assert again.network.shared.item() == 0.0
    theta = prior.sample((60,), generator=generator("fresh"))
    pairs = TensorDict({"theta": theta, "summary": theta}, [60])
    fit(network, pairs, epochs=1, progress=False)
    first = network.network.shared.clone()
    network.network.shared.fill_(1.0)
    fit(again, pairs, epochs=1, progress=False)
    assert torch.equal(again.network.shared, first)
