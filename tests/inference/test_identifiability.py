import math

import pytest
import torch

from torchrl_bayessim.inference.identifiability import identifiability
from torchrl_bayessim.inference.marginals import marginal_log_prob
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture

BOX = BoxPrior({"mass": (2.0, 6.0), "link length 2": (0.5, 1.5)})


def gaussian(prior, scale_tril, loc=None):
    d = len(prior.names)
    loc = torch.zeros(1, d) if loc is None else torch.tensor([loc])
    mixture = TruncatedGaussianMixture(
        torch.zeros(1), loc, torch.tensor(scale_tril)[None], prior.box
    )
    return PhysicsPosterior(mixture, prior)


def test_what_the_data_say_nothing_about_is_named():
    found = identifiability(gaussian(BOX, [[0.01, 0.0], [0.0, 100.0]]))
    first, second = found.sentences()
    assert first.startswith("These data say much about mass: ")
    assert second == "These data say nothing about link length 2 (0.00 nats over the prior)."
    assert str(found) == f"{first}\n{second}"


def test_nats_of_a_gaussian_within_a_gaussian():
    """KL(N(m, s^2) || N(0, 1)) = (s^2 + m^2 - 1) / 2 - log s."""
    prior = GaussianPrior({"a": (3.0, 2.0), "b": (0.0, 1.0)})
    found = identifiability(gaussian(prior, [[0.5, 0.0], [0.0, 0.1]], loc=[0.3, 0.0]))
    expected = [(0.25 + 0.09 - 1) / 2 - math.log(0.5), (0.01 - 1) / 2 - math.log(0.1)]
    assert found.nats.tolist() == pytest.approx(expected, abs=0.05)
    assert found.narrowing.tolist() == pytest.approx([0.5, 0.1], rel=0.05)


def measured(prior, d, error):
    """Return the exact posterior of a Gaussian prior where d was measured at the prior's mean."""
    scale = prior.standardization.scale_tril
    covariance = scale @ scale.mT
    gain = covariance[d] / (covariance[d, d] + error**2)
    covariance = covariance - gain[:, None] * covariance[d]
    inverse = torch.linalg.inv(scale)
    factor = torch.linalg.cholesky(inverse @ covariance @ inverse.mT)
    mixture = TruncatedGaussianMixture(torch.zeros(1), torch.zeros(1, 2), factor[None], None)
    return PhysicsPosterior(mixture, prior), covariance


@pytest.mark.parametrize("d", [0, 1])
@pytest.mark.parametrize("deviations", [(1.0, 1.0), (2.0, 0.1)])
def test_what_fixes_one_of_two_that_go_together_says_something_about_both(d, deviations):
    """Prior correlation 0.95, one measured to 0.05 of its deviation: nats and moments by hand."""
    rho = torch.tensor([[1.0, 0.95], [0.95, 1.0]])
    a, b = deviations
    prior = GaussianPrior({"a": (3.0, a), "b": (-1.0, b)}, correlation=rho)
    posterior, covariance = measured(prior, d, 0.05 * deviations[d])
    found = identifiability(posterior)
    narrowing = covariance.diagonal().sqrt() / torch.tensor(deviations)
    nats = (narrowing.square() - 1) / 2 - narrowing.log()
    assert nats[[1 - d, d]].tolist() == pytest.approx([0.70, 2.50], abs=0.005)
    assert found.nats.tolist() == pytest.approx(nats.tolist(), abs=0.05)
    assert found.narrowing.tolist() == pytest.approx(narrowing.tolist(), rel=0.05)
    r = covariance[0, 1] / (covariance[0, 0] * covariance[1, 1]).sqrt()
    assert found.correlation[0, 1].item() == pytest.approx(r.item(), abs=0.05)
    points = covariance[1, 1].sqrt() * torch.linspace(-8, 8, 1001) - 1
    theta = torch.stack([torch.full((1001,), 4.0), points], -1)
    exact = torch.distributions.Normal(-1.0, covariance[1, 1].sqrt()).log_prob(points)
    torch.testing.assert_close(marginal_log_prob(posterior, theta)[:, 1], exact.float())


def test_data_that_say_nothing_say_nothing_under_a_correlated_prior():
    rho = torch.tensor([[1.0, 0.95], [0.95, 1.0]])
    prior = GaussianPrior({"a": (3.0, 2.0), "b": (-1.0, 0.1)}, correlation=rho)
    found = identifiability(gaussian(prior, [[1.0, 0.0], [0.0, 1.0]]))
    assert found.nats.tolist() == pytest.approx([0.0, 0.0], abs=1e-6)
    assert found.narrowing.tolist() == pytest.approx([1.0, 1.0], rel=0.05)
    assert found.correlation[0, 1].item() == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize(
    ("prior", "expected"),
    [
        (BOX, math.log(2 * math.sqrt(3)) - 0.5 * math.log(2 * math.pi * math.e)),
        (GaussianPrior({"mass": (4.0, 2.0), "link length 2": (1.0, 0.1)}), -0.5),
    ],
    ids=["box", "gaussian"],
)
@pytest.mark.parametrize(("sd", "r"), [(1e-9, 0.8), (1e-18, 0.0)])
def test_a_posterior_that_float32_cannot_resolve_is_known_to_many_nats(prior, expected, sd, r):
    """By the entropy of a Gaussian in prior deviations; float64 resolves the first of the two."""
    found = identifiability(gaussian(prior, [[sd, 0.0], [0.8 * sd, 0.6 * sd]]))
    assert found.nats.tolist() == pytest.approx([expected - math.log(sd)] * 2, abs=0.05)
    assert found.correlation.flatten().tolist() == pytest.approx([1.0, r, r, 1.0], abs=0.05)
    assert found.narrowing.max().item() < 2 * sd if r else found.narrowing.isfinite().all()


@pytest.mark.parametrize("names", [("link length 2", "mass"), ("mass", "friction"), ("mass",)])
def test_a_prior_over_other_parameters_or_in_another_order_is_refused(names):
    other = BoxPrior(dict.fromkeys(names, (0.0, 10.0)))
    with pytest.raises(ValueError, match=r"a prior over \('mass', 'link length 2'\) in this order"):
        identifiability(gaussian(BOX, [[0.1, 0.0], [0.0, 0.1]]), prior=other)


def test_several_posteriors_at_once_are_refused():
    mixture = TruncatedGaussianMixture(
        torch.zeros(3, 1), torch.zeros(3, 1, 2), torch.eye(2).expand(3, 1, 2, 2), BOX.box
    )
    with pytest.raises(ValueError, match=r"one posterior, of batch shape \(\), got \(3,\)"):
        identifiability(PhysicsPosterior(mixture, BOX))


def test_a_posterior_that_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="a posterior of finite draws"):
        identifiability(gaussian(BOX, [[0.1, 0.0], [0.0, 0.1]], loc=[math.nan, 0.0]))


@pytest.mark.parametrize(("share", "nats"), [(0.5, math.log(2)), (0.1, math.log(10))])
def test_nats_count_how_often_the_range_was_halved(share, nats):
    """Against a larger prior, as after a refinement: uniform on a share of the range."""
    small = BoxPrior({"mass": (2.0, 2.0 + 4 * share)})
    found = identifiability(
        gaussian(small, [[1e3]]), prior=BoxPrior({"mass": (2.0, 6.0)}), draws=2000
    )
    assert found.nats.item() == pytest.approx(nats, abs=0.01)


def test_a_logarithmic_parameter_counts_in_its_own_prior():
    prior = BoxPrior({"damping": (0.01, 1.0)}, log=["damping"])
    assert identifiability(gaussian(prior, [[1e3]])).nats.item() == pytest.approx(0.0, abs=1e-3)
    half = prior.within(torch.tensor([0.1]), torch.tensor([1.0]))
    nats = identifiability(gaussian(half, [[1e3]]), prior=prior).nats.item()
    assert nats == pytest.approx(math.log(2), abs=0.01)


@pytest.mark.parametrize(("sign", "what"), [(1.0, "difference"), (-1.0, "sum")])
def test_parameters_known_only_together_are_named_as_a_pair(sign, what):
    found = identifiability(gaussian(BOX, [[0.5, 0.0], [sign * 0.5, 0.05]]))
    ((first, second, r),) = found.pairs
    assert {first, second} == set(BOX.names)
    assert math.copysign(1, r) == sign
    assert found.sentences()[-1].startswith("mass and link length 2 trade off (correlation ")
    assert f"something like their {what}" in found.sentences()[-1]


def test_independent_parameters_are_no_pair():
    assert identifiability(gaussian(BOX, [[0.1, 0.0], [0.0, 0.1]])).pairs == []


def test_one_draw_of_every_share_says_what_all_say(monkeypatch):
    found = []
    posterior = gaussian(BOX, [[0.5, 0.0], [0.4, 0.05]])
    for strata in (256, 10**6):
        monkeypatch.setattr("torchrl_bayessim.inference.identifiability._STRATA", strata)
        found.append(identifiability(posterior).nats)
    assert torch.allclose(*found, atol=0.005)
