import itertools

import pytest
import torch

from torchrl_bayessim.inference.marginals import marginal_log_prob
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture

BOX = BoxPrior({"a": (0.0, 2.0), "b": (0.1, 10.0), "c": (-1.0, 1.0)}, log=["b"])
GAUSSIAN = GaussianPrior({"a": (0.0, 2.0), "b": (5.0, 1.0), "c": (-1.0, 1.0)})
CORRELATED = GaussianPrior(
    {"a": (0.0, 2.0), "b": (5.0, 1.0), "c": (-1.0, 1.0)},
    correlation=torch.tensor([[1.0, 0.8, -0.5], [0.8, 1.0, -0.6], [-0.5, -0.6, 1.0]]),
)


def mixture(prior, *, diagonal=False):
    g = torch.Generator().manual_seed(0)
    scale = 0.7 * torch.eye(3) + 0.0 * torch.zeros(2, 3, 3)
    if not diagonal:
        scale = scale + 0.6 * torch.randn(2, 3, 3, generator=g).tril(-1)
    loc = torch.randn(2, 3, generator=g)
    logits = torch.tensor([0.3, -0.2])
    return PhysicsPosterior(
        TruncatedGaussianMixture(logits, loc, scale, prior.box, diagonal=diagonal), prior
    )


@pytest.mark.parametrize(
    "prior", [BOX, GAUSSIAN, CORRELATED], ids=["box", "gaussian", "correlated"]
)
@pytest.mark.parametrize("diagonal", [False, True])
@pytest.mark.parametrize("d", [0, 1, 2])
def test_a_marginal_is_the_share_of_the_draws(prior, diagonal, d):
    q = mixture(prior, diagonal=diagonal)
    draws = q.sample((30_000,), generator=torch.Generator().manual_seed(1))[:, d]
    edges = draws.quantile(torch.tensor([0.1, 0.3, 0.5, 0.7, 0.9]))
    for low, high in itertools.pairwise(edges):
        points = torch.linspace(low.item(), high.item(), 101)
        theta = prior.mean.expand(101, 3).clone()
        theta[:, d] = points
        mass = torch.trapezoid(marginal_log_prob(q, theta)[:, d].exp(), points)
        assert mass.item() == pytest.approx(0.2, abs=0.015)


@pytest.mark.parametrize("prior", [GAUSSIAN, CORRELATED], ids=["gaussian", "correlated"])
@pytest.mark.parametrize("d", [0, 1, 2])
def test_a_marginal_without_a_box_integrates_to_one_wherever_the_others_are(prior, d):
    q = mixture(prior)
    points = torch.linspace(-30, 30, 3001)
    for others in (0.0, 1.0, 9.0):
        theta = torch.full((3001, 3), others)
        theta[:, d] = points
        mass = torch.trapezoid(marginal_log_prob(q, theta)[:, d].exp(), points)
        assert mass.item() == pytest.approx(1.0, abs=1e-4)


def test_a_marginal_under_a_correlated_prior_is_the_integral_over_the_other_parameter():
    rho = torch.tensor([[1.0, -0.9], [-0.9, 1.0]])
    prior = GaussianPrior({"a": (1.0, 2.0), "b": (-3.0, 0.5)}, correlation=rho)
    scale = torch.tensor([[[0.5, 0.0], [0.3, 0.2]], [[0.4, 0.0], [-0.6, 0.9]]])
    loc = torch.tensor([[0.5, -0.5], [-1.0, 1.0]])
    q = PhysicsPosterior(
        TruncatedGaussianMixture(torch.tensor([0.3, -0.2]), loc, scale, None), prior
    )
    a, b = torch.linspace(-15, 15, 1501), torch.linspace(-8, 2, 1501)
    grid = torch.cartesian_prod(a, b)
    density = q.log_prob(grid).exp().reshape(1501, 1501)
    alone = marginal_log_prob(q, torch.stack([a, b], -1)).exp()
    torch.testing.assert_close(torch.trapezoid(density, b), alone[:, 0], atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(
        torch.trapezoid(density, a, dim=0), alone[:, 1], atol=1e-4, rtol=1e-3
    )


def test_a_single_parameter_s_marginal_is_its_density():
    prior = BoxPrior({"a": (0.1, 1.0)}, log=["a"])
    q = PhysicsPosterior(
        TruncatedGaussianMixture(
            torch.zeros(2), torch.tensor([[0.3], [2.0]]), 0.5 * torch.ones(2, 1, 1), prior.box
        ),
        prior,
    )
    theta = prior.sample((50,))
    torch.testing.assert_close(marginal_log_prob(q, theta)[:, 0], q.log_prob(theta))


def test_parameters_of_another_size_are_refused():
    with pytest.raises(
        ValueError, match=r"parameters of shape \(\*, 3\), one column .* got \(5, 2\)"
    ):
        marginal_log_prob(mixture(BOX), torch.zeros(5, 2))


def test_batches_are_row_by_row_and_nothing_is_outside():
    q = mixture(BOX)
    batch = PhysicsPosterior(
        TruncatedGaussianMixture(
            *(
                part.expand(4, *part.shape)
                for part in (q.mixture.logits, q.mixture.loc, q.mixture.scale_tril)
            ),
            BOX.box,
        ),
        BOX,
    )
    theta = torch.tensor([1.0, 1.0, 0.0]).repeat(4, 1)
    theta[3, 1] = 11.0
    got = marginal_log_prob(batch, theta)
    assert got.shape == (4, 3)
    torch.testing.assert_close(got[0], marginal_log_prob(q, theta[0]))
    assert got[3, 1] == -torch.inf
    assert got[3, [0, 2]].isfinite().all()
