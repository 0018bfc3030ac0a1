import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.proposals import (
    HighestDensityPrior,
    analytic_correction,
    focus,
    gaussian_proposal,
    importance_weights,
)
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.inference.weights import effective_sample_size
from torchrl_bayessim.sources import Defensive, draw

BOX = BoxPrior({"theta": (-2.0, 2.0)})
LOGARITHMIC = BoxPrior({"damping": (0.01, 1.0)}, log=["damping"])
NORMAL = GaussianPrior({"theta": (0.5, 2.0)})


def mixture(prior, *components, weights=None):
    """A posterior from means and covariances in the parameters' own units."""
    scale = prior.standardization.scale_tril
    means = torch.tensor([mean for mean, _ in components], dtype=torch.float64)
    loc = torch.linalg.solve(scale, (means - prior.standardization.mean).mT).mT
    inverse = torch.linalg.inv(scale)
    covariance = torch.tensor([cov for _, cov in components], dtype=torch.float64)
    tril = torch.linalg.cholesky(inverse @ covariance @ inverse.mT)
    logits = torch.tensor(weights or [1.0] * len(components)).log()
    return PhysicsPosterior(TruncatedGaussianMixture(logits, loc, tril, prior.box), prior)


def two_modes(sd=0.1, prior=BOX):
    return mixture(prior, ([-1.0], [[sd**2]]), ([1.0], [[sd**2]]), weights=[0.3, 0.7])


def midpoints(low, high, points=40_000):
    axis = torch.linspace(low, high, points + 1, dtype=torch.float64)
    return ((axis[1:] + axis[:-1]) / 2)[:, None].float(), (high - low) / points


# --- importance weights


@given(
    share=st.floats(0.05, 1.0),
    mean=st.floats(-2.0, 2.0),
    sd=st.floats(0.003, 3.0),
    seed=st.integers(0, 2**31),
)
@settings(deadline=None, max_examples=30)
def test_a_share_of_the_prior_bounds_the_weights(share, mean, sd, seed):
    proposal = Defensive(mixture(BOX, ([mean], [[sd**2]])), BOX, share)
    theta = torch.cat([draw(proposal, 200, key=(seed,)), draw(BOX, 200, key=(seed,))])
    weight = importance_weights(theta, BOX, [(proposal, 200)])
    assert (weight > 0).all()
    assert (weight <= 1 / share + 1e-4).all()


@pytest.mark.parametrize("prior", [BOX, NORMAL], ids=["box", "normal"])
def test_weighted_expectations_are_those_of_the_prior(prior):
    count = 60_000
    proposal = Defensive(two_modes(prior=prior), prior, 0.2)
    theta = draw(proposal, count, key=(0,))[:, 0]
    weight = importance_weights(theta[:, None], prior, [(proposal, count)])
    assert weight.mean().item() == pytest.approx(1.0, abs=0.03)
    assert (weight * theta).mean().item() == pytest.approx(prior.mean.item(), abs=0.05)
    second = (prior.variance + prior.mean**2).item()
    assert (weight * theta**2).mean().item() == pytest.approx(second, rel=0.04)
    assert (
        theta.std().item() < 0.9 * prior.stddev.item()
    )  # the draws themselves are not the prior's


def test_weights_balance_all_rounds_together():
    """Every draw is weighted by the mixture of all proposals, whichever it came from."""
    narrow = two_modes()  # without a defensive share: the first round bounds the weights
    counts = [(BOX, 10_000), (narrow, 40_000)]
    theta = torch.cat([draw(source, n, key=(i,)) for i, (source, n) in enumerate(counts)])
    weight = importance_weights(theta, BOX, counts)
    density = 0.2 * BOX.log_prob(theta).exp() + 0.8 * narrow.log_prob(theta).exp()
    torch.testing.assert_close(weight, BOX.log_prob(theta).exp() / density)
    assert weight.max().item() <= 5.0 + 1e-4
    for function, expected in [(theta[:, 0], 0.0), (theta[:, 0] ** 2, 4 / 3)]:
        assert (weight * function).mean().item() == pytest.approx(expected, abs=0.04)


def test_rounds_without_draws_count_for_nothing():
    theta = draw(BOX, 10, key=(0,))
    assert (importance_weights(theta, BOX, [(BOX, 10), (two_modes(), 0)]) == 1).all()


def test_parameters_that_no_proposal_draws_are_refused():
    half = BoxPrior({"theta": (-2.0, 0.0)})
    with pytest.raises(ValueError, match=r"parameters drawn from the proposals.*1.5"):
        importance_weights(torch.tensor([[-1.0], [1.5]]), BOX, [(half, 2)])


def test_effective_sample_size_of_known_weights():
    assert effective_sample_size(torch.full((7,), 3.0)) == pytest.approx(7.0)
    assert effective_sample_size(torch.tensor([4.0, 2.0])) == pytest.approx(36 / 20)


# --- truncated proposals


@pytest.mark.parametrize(
    "posterior",
    [
        two_modes(),
        two_modes(2e-3),
        mixture(LOGARITHMIC, ([math.log(0.05)], [[0.01]])),
        mixture(BOX, ([-2.0], [[0.04]])),
    ],
    ids=["two modes", "two narrow modes", "logarithmic", "at the edge"],
)
def test_the_density_of_the_region_integrates_to_one(posterior):
    region = HighestDensityPrior(posterior.prior, posterior)
    low, high = (posterior.prior.low.item(), posterior.prior.high.item())
    theta, step = midpoints(low, high, 400_000)
    density = region.log_prob(theta).exp()
    assert (density.sum() * step).item() == pytest.approx(1, abs=0.06)
    inside = density > 0
    assert (posterior.log_prob(theta).exp() * inside).sum().item() * step > 0.999


def test_the_density_is_the_prior_s_within_the_region():
    posterior = mixture(LOGARITHMIC, ([math.log(0.05)], [[0.01]]))
    region = HighestDensityPrior(LOGARITHMIC, posterior)
    theta = draw(posterior, 500, key=(0,))
    gain = (region.log_prob(theta) - LOGARITHMIC.log_prob(theta))[region.contains(theta)]
    torch.testing.assert_close(gain, gain[:1].expand(len(gain)), rtol=0, atol=1e-4)
    assert region.log_prob(torch.tensor([[0.9], [2.0]])).tolist() == [-math.inf] * 2


def test_draws_lie_in_the_region_as_the_prior_would():
    region = HighestDensityPrior(BOX, two_modes())
    theta = draw(region, 4000, key=(0,))
    assert region.contains(theta).all()
    # equal modes for an equal prior, although the posterior's are 3 to 7; and flat, not bell-shaped
    assert (theta > 0).float().mean().item() == pytest.approx(0.5, abs=0.04)
    assert theta.abs().std().item() == pytest.approx(0.1 * 2 * 3.8 / math.sqrt(12), rel=0.1)


@pytest.mark.parametrize("sd", [1e-2, 1e-4])
def test_a_small_region_in_several_dimensions_has_its_volume(sd):
    """The ellipsoid of mass 0.9999; most of it would never be met by draws of the whole prior."""
    prior = BoxPrior(dict.fromkeys("abc", (0.0, 1.0)))
    covariance = (sd**2 * torch.eye(3)).tolist()
    region = HighestDensityPrior(prior, mixture(prior, ([0.5] * 3, covariance)))
    theta = draw(region, 500, key=(0,))
    radius = (theta - 0.5).norm(dim=-1) / sd
    edge = math.sqrt(21.11)  # of the chi-square with 3 degrees of freedom
    assert 0.9 * edge < radius.max().item() < 1.15 * edge
    volume = 4 / 3 * math.pi * (edge * sd) ** 3
    assert region.log_prob(theta)[0].item() == pytest.approx(-math.log(volume), abs=0.4)


def test_a_region_that_the_prior_hardly_meets_is_filled_and_said():
    prior = GaussianPrior({"theta": (0.0, 1.0)})
    posterior = mixture(prior, ([1.0], [[1e-10]]))
    region = HighestDensityPrior(prior, posterior)
    with pytest.warns(UserWarning, match="too small for prior draws"):
        theta = draw(region, 400, key=(0,))
    assert region.contains(theta).all()
    # flat over nearly 8 deviations of the posterior, as the prior is there
    assert theta.std().item() / 1e-5 == pytest.approx(7.78 / math.sqrt(12), rel=0.15)


def test_an_empty_region_is_an_error_and_no_endless_loop():
    region = HighestDensityPrior(NORMAL, two_modes(prior=NORMAL))
    region.threshold = math.inf
    with (
        pytest.warns(UserWarning, match="too small"),
        pytest.raises(SimulationError, match="draws inside the region"),
    ):
        draw(region, 10, key=(0,))


def test_a_focused_prior_holds_the_posterior_and_stays_in_the_prior():
    for posterior in (two_modes(), mixture(BOX, ([1.9], [[0.04]]))):
        focused = focus(BOX, posterior)
        assert focused.contains(draw(posterior, 20_000, key=(1,))).all()
        assert BOX.low <= focused.low < focused.high <= BOX.high
    narrow = focus(BOX, mixture(BOX, ([0.5], [[1e-4]])))
    assert (narrow.high - narrow.low).item() < 0.3


def test_a_negligible_wide_component_does_not_keep_the_focus_wide():
    sharp, wide = ([0.5], [[1e-4]]), ([0.0], [[1.0]])
    posterior = mixture(BOX, sharp, wide, weights=[0.9996, 0.0004])
    focused = focus(BOX, posterior)
    assert 0.04 < (focused.high - focused.low).item() < 0.5
    assert focused.contains(torch.tensor([0.5]))
    everything = focus(BOX, posterior, tail=0.0)
    assert (everything.high - everything.low).item() > 2


# --- the analytic correction


def linear_gaussian(prior_mean, prior_covariance, x):
    """The posterior's moments for x = A theta + noise."""
    A = torch.tensor([[1.0, 0.3], [0.0, 2.0]], dtype=torch.float64)
    noise = torch.tensor([[0.3, 0.1], [0.1, 0.2]], dtype=torch.float64)
    inverse = torch.linalg.inv(prior_covariance)
    likelihood = A.mT @ torch.linalg.inv(noise)
    covariance = torch.linalg.inv(inverse + likelihood @ A)
    return covariance @ (inverse @ prior_mean + likelihood @ x), covariance


@pytest.mark.parametrize(
    "prior",
    [
        BoxPrior({"a": (-20.0, 20.0), "b": (-20.0, 20.0)}),
        GaussianPrior({"a": (0.3, 1.5), "b": (-0.2, 0.8)}, correlation=[[1.0, 0.6], [0.6, 1.0]]),
    ],
    ids=["box", "normal"],
)
def test_the_division_is_exact_for_a_linear_gaussian_problem(prior):
    x = torch.tensor([0.9, -0.4], dtype=torch.float64)
    proposal_mean = torch.tensor([0.5, 0.1], dtype=torch.float64)
    proposal_covariance = torch.tensor([[0.9, -0.2], [-0.2, 0.6]], dtype=torch.float64)
    proposal = mixture(prior, (proposal_mean.tolist(), proposal_covariance.tolist()))
    learned = linear_gaussian(proposal_mean, proposal_covariance, x)
    if prior.box is None:
        tril = prior.standardization.scale_tril
        exact = linear_gaussian(prior.mean.double(), tril @ tril.mT, x)
    else:
        exact = linear_gaussian(proposal_mean, 1e12 * proposal_covariance, x)
    corrected, repaired, dropped, _ = analytic_correction(
        mixture(prior, *[[moment.tolist() for moment in learned]]), proposal
    )
    theta = exact[0] + torch.randn(200, 2, dtype=torch.float64) @ torch.linalg.cholesky(exact[1]).mT
    expected = torch.distributions.MultivariateNormal(*exact).log_prob(theta)
    torch.testing.assert_close(corrected.log_prob(theta).double(), expected, rtol=0, atol=2e-3)
    assert repaired == dropped == 0


@pytest.mark.parametrize("prior", [BOX, NORMAL], ids=["box", "normal"])
def test_the_division_of_a_mixture_is_the_ratio_of_densities(prior):
    """By quadrature, with components that the box cuts."""
    learned = mixture(
        prior, ([-1.8], [[0.09]]), ([0.2], [[0.01]]), ([1.6], [[0.25]]), weights=[0.5, 0.2, 0.3]
    )
    proposal = mixture(prior, ([0.4], [[1.3]]))
    corrected, repaired, dropped, _ = analytic_correction(learned, proposal)
    theta, step = midpoints(-2.0, 2.0) if prior is BOX else midpoints(-6.0, 6.0)
    ratio = learned.log_prob(theta) + prior.log_prob(theta) - proposal.log_prob(theta)
    expected = ratio.double().softmax(0) / step
    found = corrected.log_prob(theta).double().exp()
    assert 0.5 * (found - expected).abs().sum().item() * step < 1e-3
    assert repaired == dropped == 0


def test_the_prior_s_own_precision_counts_before_anything_is_repaired():
    """The quotient alone would be wider than the prior, the product with p is not."""
    learned, proposal = mixture(NORMAL, ([0.5], [[0.95]])), mixture(NORMAL, ([0.4], [[1.0]]))
    corrected, repaired, dropped, _ = analytic_correction(learned, proposal)
    assert repaired == dropped == 0
    precision = 1 / 0.95 - 1 / 1.0 + 1 / 4.0
    mean = (0.5 / 0.95 - 0.4 / 1.0 + 0.5 / 4.0) / precision
    assert corrected.mean.item() == pytest.approx(mean, abs=0.02)
    assert corrected.variance.item() == pytest.approx(1 / precision, rel=0.02)


STANDARD = GaussianPrior({"a": (0.0, 1.0)})


@pytest.mark.parametrize("wide", [0.149, 0.1499, 0.16, 0.3, 1.0])
@pytest.mark.parametrize("weight", [1e-6, 1e-3, 0.05])
def test_a_component_wider_than_the_proposal_does_not_ruin_the_quotient(weight, wide):
    components = [([0.2], [[0.01]]), ([0.3], [[wide**2]])]
    learned = mixture(STANDARD, *components, weights=[1 - weight, weight])
    proposal = mixture(STANDARD, ([0.25], [[0.15**2]]))
    with pytest.warns(UserWarning, match="components with a quotient wider than the prior"):
        corrected, repaired, dropped, doubtful = analytic_correction(learned, proposal)
    assert repaired + dropped == 1
    assert doubtful == pytest.approx(weight, rel=1e-4)
    precision = 100 - 1 / 0.15**2 + 1  # of the component that can be divided
    mean = (0.2 * 100 - 0.25 / 0.15**2) / precision
    assert corrected.mean.item() == pytest.approx(mean, abs=0.03)
    assert corrected.stddev.item() == pytest.approx(precision**-0.5, rel=0.25)


@pytest.mark.parametrize("prior", [BOX, NORMAL], ids=["box", "normal"])
def test_a_quotient_of_several_components_is_nowhere_wider_than_the_prior(prior):
    learned = mixture(
        prior, ([0.5], [[0.2]]), ([0.2], [[0.79]]), ([0.9], [[0.9]]), weights=[0.8, 0.1, 0.1]
    )
    proposal = mixture(prior, ([0.5], [[0.8]]))
    with pytest.warns(UserWarning, match="quotient wider than the prior"):
        corrected = analytic_correction(learned, proposal).posterior
    assert corrected.stddev.item() < prior.variance.sqrt().item()
    if prior is BOX:
        assert (corrected.mixture.scale_tril <= 4.0 + 1e-6).all()  # nearly flat over the box
    else:
        assert (corrected.mixture.scale_tril <= 1.0 + 1e-6).all()


def test_a_quotient_outside_the_proposal_is_dropped():
    learned = mixture(STANDARD, ([0.2], [[0.0025]]), ([0.5], [[0.009]]), weights=[0.9, 0.1])
    proposal = mixture(STANDARD, ([0.2], [[0.01]]))  # the second's quotient would lie at 2.5
    with pytest.warns(UserWarning, match="1 with one outside the proposal dropped: 10.0%"):
        corrected, repaired, dropped, _ = analytic_correction(learned, proposal)
    assert (repaired, dropped) == (0, 1)
    assert corrected.mixture.logits.numel() == 1


def test_a_learned_posterior_that_is_as_wide_as_the_proposal_is_refused():
    learned = mixture(STANDARD, ([0.2], [[0.0025]]), ([0.2], [[0.012]]), weights=[0.4, 0.6])
    proposal = mixture(STANDARD, ([0.2], [[0.01]]))
    with pytest.raises(SimulationError, match=r"narrower than the proposal.*60%.*Try: more sim"):
        analytic_correction(learned, proposal)


def test_a_mixture_is_refused_as_divisor():
    with pytest.raises(ValueError, match=r"one Gaussian.*2 components.*importance"):
        analytic_correction(two_modes(), two_modes())


def test_the_gaussian_proposal_spans_all_modes():
    posterior = mixture(BOX, ([-1.0], [[0.01]]), ([0.5], [[0.04]]), weights=[0.4, 0.6])
    proposal = gaussian_proposal(posterior, inflate=1.0).mixture
    assert proposal.loc.shape == (1, 1)
    loc, sd = proposal.loc.item(), proposal.scale_tril.item()
    unit = 2 / math.sqrt(3)  # of the standardised coordinate
    variance = 0.4 * 0.01 + 0.6 * 0.04 + 0.24 * 1.5**2
    assert loc * unit == pytest.approx(-0.1, abs=0.01)
    assert (sd * unit) ** 2 == pytest.approx(variance, rel=0.02)
    wider = gaussian_proposal(posterior, inflate=2.0).mixture.scale_tril.item()
    assert wider == pytest.approx(2 * sd, rel=1e-4)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_posterior_that_its_box_cuts_off_is_looked_for_beyond(side):
    """Prior [-2, 2], last box [-0.5, 0.5], and a narrow posterior at one of its edges."""
    prior = BoxPrior({"a": (-2.0, 2.0)})
    last = prior.within(torch.tensor([-0.5]), torch.tensor([0.5]))
    edge = last.box[1] if side > 0 else last.box[0]
    narrow = TruncatedGaussianMixture(
        torch.zeros(1), edge[None].float(), 0.02 * torch.eye(1)[None], last.box, diagonal=True
    )
    found = focus(prior, PhysicsPosterior(narrow, last))
    far, near = (found.high, found.low) if side > 0 else (found.low, found.high)
    assert (side * far).item() == pytest.approx(1.5, abs=0.05)
    assert 0.3 < (side * near).item() < 0.5
