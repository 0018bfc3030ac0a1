"""Answers that err together: how much of it is found, and what a product of them then is."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.averaged_posterior import AveragedPosterior
from torchrl_bayessim.inference.design_effect import (
    design_effect,
    shared_by_neighbours,
    shared_by_rows,
    widened,
)
from torchrl_bayessim.inference.ensemble import fit_apart
from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.mixtures import Mixture
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
        shared_by_neighbours(each.untruncated, z, bounded=True)[0].item()
        for z, each in (erring(share, key=key) for key in range(5))
    ]
    assert sum(found) / 5 == pytest.approx(share, abs=0.06)


def test_under_a_gaussian_prior_what_the_prior_pulls_is_no_error():
    z = randn(1500, 1, key="prior")
    noise = 0.7
    exact = 1 / (1 + noise**-2)
    x = z + noise * randn(1500, 1, key="noise")
    each = answers(exact * x / noise**2, exact**0.5)
    assert shared_by_neighbours(each.untruncated, z, bounded=False)[0].item() < 0.06
    without = shared_by_neighbours(each.untruncated, z, bounded=True)  # the prior's score
    assert max(share.item() for share in without) > 0.2


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
    pooled = pool(
        each, bounded=True, effect=design_effect(each.untruncated, torch.zeros(2), bounded=True)
    )
    assert torch.allclose(pooled.scale_tril[0].diagonal(), 0.3 * torch.ones(2).double())


@pytest.mark.parametrize("bounded", [True, False])
def test_a_product_is_as_sure_as_the_design_effect_says(bounded):
    n, share, noise = 8, 0.25, 0.5
    worth = n / (1 + (n - 1) * share)
    x = 0.3 + noise * randn(n, 1, key="worth")
    precision = noise**-2 + (0 if bounded else 1)
    each = answers(x * noise**-2 / precision, precision**-0.5)
    pooled = pool(each, bounded=bounded, effect=torch.tensor([n / worth]).double())
    expected = worth * noise**-2 + (0 if bounded else 1)
    assert pooled.scale_tril.item() == pytest.approx(expected**-0.5)
    there = worth * x.mean().item() * noise**-2 / expected
    assert pooled.loc.item() == pytest.approx(there, rel=2e-5)


def test_parameters_share_errors_each_by_its_own():
    each = answers(randn(6, 2, key="own"), 0.5)
    pooled = pool(each, bounded=True, effect=torch.tensor([1.0, 6.0]).double())
    expected = torch.tensor([0.5 / 6**0.5, 0.5], dtype=torch.float64)
    assert torch.allclose(pooled.scale_tril[0].diagonal(), expected)


def test_one_trajectory_is_left_as_it_is():
    each = answers(randn(1, 2, key="one"))
    assert torch.equal(shared_by_rows(each.untruncated, bounded=True), torch.zeros(2).double())
    shared = torch.tensor([0.5, 0.9])
    assert design_effect(each.untruncated, shared, bounded=True).tolist() == [1.0, 1.0]


def test_answers_with_two_modes_sharpen_each_as_rows_allow():
    """x = theta^2 + noise: the modes' distance is open in every answer, and no error of theirs."""
    n, noise = 40, 0.05
    x = 1 + noise * randn(n, 1, key="modes")
    at = x.sqrt()
    loc = torch.stack([-at, at], 1)
    scale = (noise / 2 / at)[:, None, None].expand(n, 2, 1, 1)
    each = Mixture(torch.zeros(n, 2).double(), loc, scale)
    assert shared_by_rows(each, bounded=True).item() < 0.05
    assert design_effect(each, torch.zeros(1), bounded=True).item() < 3


@pytest.mark.parametrize("ratio", [10.0, 1e4])
def test_weak_trajectories_leave_a_good_one_as_sure_as_it_is(ratio):
    n = 10
    deviation = torch.full((n,), 1.0).double()
    deviation[0] = ratio**-0.5
    found = []
    for key in range(200):
        loc = deviation[:, None] * randn(n, 1, key=("weak rows", ratio, key))
        scale = deviation[:, None, None, None]
        each = Mixture(torch.zeros(n, 1).double(), loc[:, None], scale)
        found.append(design_effect(each, torch.zeros(1), bounded=True).item())
    assert sum(effect > 1.05 for effect in found) < 0.08 * len(found)
    common = design_effect(each, torch.ones(1), bounded=True).item()
    assert common == pytest.approx((ratio + 9) ** 2 / (ratio**2 + 9))  # Kish's effective number


@pytest.mark.parametrize("correlation", [0.98, 0.998])
def test_what_only_one_parameter_of_a_ridge_shares_does_not_turn_the_ridge(correlation):
    n, inside = 10, []
    covariance = torch.tensor([[1.0, correlation], [correlation, 1.0]]).double()
    scale = torch.linalg.cholesky(covariance)
    for key in range(200):
        loc = randn(n, 2, key=("ridge", key)) @ scale.mT  # of a truth at 0
        each = Mixture(torch.zeros(n, 1).double(), loc[:, None], scale.expand(n, 1, 2, 2))
        effect = design_effect(each, torch.tensor([0.0, 0.5]), bounded=True)
        wider = widened(each, effect, bounded=True)
        precision = torch.cholesky_inverse(wider.scale_tril[:, 0])
        mean = torch.linalg.solve(precision.sum(0), (precision @ loc.unsqueeze(-1)).sum(0))
        inside.append((mean.mT @ precision.sum(0) @ mean).item() < 4.61)  # 90 % of chi-squared, 2
    assert sum(inside) > 0.85 * len(inside)


def test_under_a_gaussian_prior_likelihoods_stay_where_they_are():
    said = 10 * torch.tensor([[5.0, 3.5], [3.5, 4.0]]).double()
    centre = torch.tensor([[1.5], [-1.0]]).double()
    total = said + torch.eye(2)
    loc = torch.linalg.solve(total, said @ centre).mT
    scale = torch.linalg.cholesky(torch.linalg.inv(total))
    each = Mixture(torch.zeros(1, 1).double(), loc[None], scale[None, None])
    wider = widened(each, torch.tensor([1.0, 4.0]).double(), bounded=False)
    precision = torch.cholesky_inverse(wider.scale_tril[0, 0])
    less = precision - torch.eye(2)
    half = torch.tensor([1.0, 0.5])
    torch.testing.assert_close(less, half[:, None] * said * half)
    found = torch.linalg.solve(less, precision @ wider.loc[0].mT)
    torch.testing.assert_close(found, centre, atol=2e-3, rtol=0)


@pytest.mark.parametrize("strong", [2.0, 100.0])
@pytest.mark.parametrize("weak", [0.02, 1e-4, -1e-3, -0.5])
def test_a_direction_that_an_answer_says_nothing_of_moves_no_other(strong, weak):
    """Under a Gaussian prior its likelihood lies anywhere there, at a pull over nearly nothing."""
    turn = torch.tensor([[1.0, 1.0], [1.0, -1.0]]).double() / 2**0.5
    said = turn @ torch.diag(torch.tensor([strong, weak]).double()) @ turn.mT
    scale = torch.linalg.cholesky(torch.linalg.inv(said + torch.eye(2)))
    measured, noise = 0.3 * randn(10, key="strong"), torch.full((10,), 0.05).double()
    loc = (turn @ torch.stack([measured, noise])).mT
    each = Mixture(torch.zeros(10, 1).double(), loc[:, None], scale.expand(10, 1, 2, 2))
    wider = widened(each, torch.tensor([2.0, 2.4]).double(), bounded=False)
    assert ((wider.loc[:, 0] @ turn)[:, 1].abs() < 0.5).all()
    precision = torch.cholesky_inverse(wider.scale_tril[:, 0])
    assert (torch.linalg.eigvalsh(precision) > 1 - 1e-9).all()  # nothing wider than the prior
    less = torch.linalg.solve(
        (said / 2.2 + torch.eye(2)), said / 2.2 @ (turn @ torch.stack([measured, 0 * measured]))
    )
    moved = (wider.loc[:, 0] - less.mT) @ turn[:, 0] * (1 + strong) ** 0.5
    assert (moved.abs() < 0.5).all()  # of deviations; tens if it were not so


def test_errors_near_the_edges_of_a_box_are_no_matter_in_its_middle():
    """As of networks whose means stay in the box."""
    z = 3**0.5 * (2 * torch.rand(3000, 1, generator=generator("box")).double() - 1)
    x = z + 0.3 * randn(3000, 1, key="in the box")
    each = answers(x.clamp(-1.3, 1.3), 0.3)
    middle, edges = shared_by_neighbours(each.untruncated, z, bounded=True)
    assert middle.item() < 0.02
    assert edges.item() > 0.4
    for at, share in ((0.2, 0.0), (1.5, edges.item())):
        rows = answers(at + 0.3 * randn(40, 1, key=("rows", 3)), 0.3).untruncated
        effect = design_effect(rows, middle, at_edges=edges, bounded=True)
        assert effect.item() == pytest.approx(1 + 39 * share, rel=0.1)


def test_a_fit_under_a_box_sharpens_with_the_root_of_the_trajectories():
    prior, noise = BoxPrior({"a": (0.0, 1.0)}), 0.3
    theta = prior.sample((5000,), generator=generator("theta"))
    x = prior.standardize(theta) + noise * randn(5000, 1, key="x").float()
    network = MixtureDensityPosterior(prior, 1, seed=0)
    pairs = TensorDict({"theta": theta, "summary": x}, [5000])
    fit_apart([network], pairs, seeds=[0], epochs=25, progress=False)
    rows = 0.2 + noise * randn(64, 1, key="many").float()
    for n in (4, 16, 64):
        found = network.condition(rows[:n], check=False).stddev / prior.stddev
        assert found.item() == pytest.approx(noise * n**-0.5, rel=0.2)


def test_a_truth_far_from_the_middle_of_a_gaussian_prior_hides_nothing_that_rows_share():
    noise = torch.tensor([0.3, 1.0]).repeat(40).double()
    x = 2.5 + 0.5**0.5 * noise * randn(80, key="far out") * 0.3
    precision = 1 + noise**-2
    loc, scale = x * noise**-2 / precision, precision**-0.5
    each = Mixture(torch.zeros(80, 1).double(), loc[:, None, None], scale[:, None, None, None])
    assert shared_by_rows(each, bounded=False).item() > 0.85


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
    assert posterior.stddev[1] > 0.75 * prior.stddev[1]
    assert posterior.stddev[0] < 0.8 * one.stddev[0]  # what is measured is known better
    if prior.box is not None:
        plain = pool(networks[0].distribution(rows).mixture, bounded=True)
        alone = networks[0].condition(rows, check=False).stddev[1]
        assert alone > 1.1 * PhysicsPosterior(plain, prior).stddev[1]  # which does invent some


def test_a_state_brings_its_shares_and_a_fit_finds_its_own():
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
    again.network.shared.fill_(1.0)
    fit(again, TensorDict({"theta": theta, "summary": theta}, [60]), epochs=1, progress=False)
    assert again.network.shared.item() < 0.9
