"""Posteriors at the edges: no noise, constants, one parameter or thirty, collapsed components."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.mixtures import Mixture, divide, multiply, reduce
from torchrl_bayessim.inference.network import STEEPEST
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.randomness import generator


def fitted(size, *, noise, pairs, **options):
    """Return the prior of ``size`` parameters and a posterior from their noisy values."""
    prior = BoxPrior({f"p{i}": (float(i), i + 1.0) for i in range(size)})
    theta = prior.sample((pairs,), generator=generator("theta", size))
    summary = theta + noise * torch.randn(theta.shape, generator=generator("noise", size))
    data = TensorDict({"theta": theta, "summary": summary}, [pairs])
    posterior = MixtureDensityPosterior(prior, size, **options)
    report = fit(posterior, data, epochs=20, lr=2e-2, progress=False)
    assert all(torch.tensor(report.validation).isfinite())
    return prior, posterior


def test_statistics_without_noise_collapse_no_component():
    prior, posterior = fitted(2, noise=0.0, pairs=1500)
    for place, nats in (0.02, 0.0), (0.3, 4.0), (0.98, 0.0):  # the true density is infinite
        truth = torch.arange(2) + place
        q = posterior.condition(truth)
        assert (q.mean - truth).abs().max() < 0.05
        assert (q.stddev > 0).all()
        assert (q.stddev < 0.05).all()
        assert q.log_prob(truth) - prior.log_prob(truth) > nats
        assert q.log_prob(truth).isfinite()
        assert q.sample((64,), generator=generator(0)).isfinite().all()


def test_thirty_parameters_are_found_at_once():
    prior, posterior = fitted(30, noise=0.1, pairs=600, components=1)
    truth = torch.arange(30) + torch.linspace(0.2, 0.8, 30)
    q = posterior.condition(truth)
    far = (q.mean - truth).abs()
    assert far.mean() < 0.15  # against 0.2 of the prior's mean
    assert (q.stddev < prior.stddev).all()
    assert (far < 3.5 * q.stddev).all()
    assert q.log_prob(truth) > prior.log_prob(truth)
    draws = q.sample((64,), generator=generator(0))
    assert prior.contains(draws).all()
    together = posterior.condition(truth.expand(3, 30))
    assert (together.mean - truth).abs().mean() < far.mean() + 0.02
    noise = 0.1 * torch.randn(3, 30, generator=generator("three"))
    apart = posterior.condition(truth + noise)  # three that are the same say what one does
    assert (apart.stddev < q.stddev).float().mean() > 0.9
    assert (apart.mean - truth).abs().mean() < 0.15


def flat(dim, *, deviation=1.0):
    """Return a component that has collapsed onto a line, x_1 = ... = x_D."""
    scale = torch.zeros(1, dim, dim, dtype=torch.float64)
    scale[..., 0] = deviation
    loc = torch.linspace(-1, 1, dim, dtype=torch.float64)[None]
    return Mixture(torch.zeros(1, dtype=torch.float64), loc, scale)


@pytest.mark.parametrize("deviation", [1.0, 1e-4])
@pytest.mark.parametrize("dim", [2, 30])
@pytest.mark.filterwarnings("ignore:.* indefinite by rounding")  # or just not
def test_collapsed_components_are_multiplied(dim, deviation):
    """The square of a Gaussian has half its covariance."""
    thin = flat(dim, deviation=deviation)
    square = multiply(thin, thin)
    torch.testing.assert_close(
        square.covariance, thin.covariance / 2, rtol=0, atol=1e-6 * deviation**2
    )
    torch.testing.assert_close(square.loc, thin.loc, rtol=0, atol=1e-3 * deviation)
    assert square.scale_tril.diagonal(dim1=-2, dim2=-1).gt(0).all()


def test_what_was_widened_is_said_of_components_as_steep_as_networks_make_them():
    rows = torch.randn(8, 30, 30, generator=generator("slopes"), dtype=torch.float64)
    rows = STEEPEST * torch.tanh(5 * rows).tril(-1) + torch.eye(30)
    mixture = Mixture(
        torch.zeros(8).double(), torch.zeros(8, 30).double(), rows / rows.norm(dim=-1, keepdim=True)
    )
    with pytest.warns(UserWarning, match="indefinite by rounding: widened"):
        product = reduce(multiply(mixture, mixture), 4)
    assert all(part.isfinite().all() for part in product)
    assert (product.covariance.diagonal(dim1=-2, dim2=-1) <= 1).all()
    with pytest.warns(UserWarning, match="indefinite by rounding: widened"):
        single = multiply(*[Mixture(*(part.float() for part in mixture))] * 2)
    assert all(part.isfinite().all() for part in single)


def test_collapsed_components_are_divided_and_merged():
    thin, wide = flat(5), torch.eye(5, dtype=torch.float64)
    twice = Mixture(*(torch.cat([part, part]) for part in thin))
    with pytest.warns(UserWarning, match="indefinite by rounding: widened"):
        one = reduce(twice, 1)
    torch.testing.assert_close(one.covariance, thin.covariance, rtol=0, atol=1e-6)
    torch.testing.assert_close(one.loc, thin.loc)
    quotient = divide(one, torch.zeros(5, dtype=torch.float64), 9 * wide, widest=20 * wide)
    assert not quotient.repaired.any()
    along = torch.ones(5, dtype=torch.float64)
    precision = 1 / 5 - 1 / 9  # along the line, on which the variance is 5
    found = (along @ quotient.mixture.covariance[0] @ along / 5).item()
    assert found == pytest.approx(1 / precision, rel=1e-3)


def test_a_covariance_that_is_indefinite_by_more_than_rounding_is_refused():
    mixture = Mixture(torch.zeros(1), torch.zeros(1, 2), torch.eye(2)[None])
    saddle = torch.diag(torch.tensor([1.0, -0.5]))
    with pytest.raises(ValueError, match=r"covariances that are positive definite, got .*-0\.5"):
        divide(mixture, torch.zeros(2), saddle, widest=torch.eye(2))


def pair(width, *, apart=1.0):
    """Return a component of width 1, and one of ``width`` as far away as said."""
    loc = apart * torch.arange(2, dtype=torch.float64)[:, None].expand(2, 3)
    scale = torch.tensor([1.0, width], dtype=torch.float64)[:, None, None] * torch.eye(3)
    return Mixture(torch.zeros(2, dtype=torch.float64), loc, scale)


UNIT = torch.eye(3, dtype=torch.float64)
ALGEBRA = {
    "multiply": lambda m: multiply(m, m),
    "divide": lambda m: divide(m, torch.zeros(3).double(), 9 * UNIT, widest=20 * UNIT).mixture,
    "reduce": lambda m: reduce(m, 1),
}


@pytest.mark.parametrize("name", ALGEBRA)
@pytest.mark.parametrize("width", [0.0, 1e-200])
def test_points_are_widened_where_the_mixture_has_a_scale(name, width):
    with pytest.warns(UserWarning, match="1 of 2 components have collapsed to points: widened"):
        found = ALGEBRA[name](pair(width))
    assert all(part.isfinite().all() for part in found)
    assert (found.covariance.diagonal(dim1=-2, dim2=-1) > 0).all()
    if name == "reduce":  # both mean 0.5 away from theirs
        torch.testing.assert_close(found.covariance[0], UNIT / 2 + 1 / 4)
    far = pair(0.0, apart=3.0)._replace(scale_tril=torch.zeros(2, 3, 3, dtype=torch.float64))
    with pytest.warns(UserWarning, match="2 of 2 components have collapsed"):
        assert ALGEBRA[name](far).loc.isfinite().all()


@pytest.mark.parametrize("name", ALGEBRA)
def test_what_has_no_scale_or_no_number_is_refused_by_its_place(name):
    alone = Mixture(*(part[1:] for part in pair(0.0)))
    with pytest.raises(ValueError, match=r"a mixture of some width.*of 0 in component 0 of 1"):
        ALGEBRA[name](alone)
    for bad in (torch.nan, torch.inf, 1e200):
        with pytest.raises(ValueError, match=r"components of finite.*infinity in component 1 of 2"):
            ALGEBRA[name](pair(bad))
    lost = pair(1.0)._replace(logits=torch.tensor([torch.nan, 0.0], dtype=torch.float64))
    with pytest.raises(ValueError, match="NaN or infinity in component 0 of 2"):
        ALGEBRA[name](lost)
    if name != "reduce":  # of batches
        two = zip(pair(1.0), pair(torch.nan), strict=True)
        rows = Mixture(*(torch.stack(parts) for parts in two))
        with pytest.raises(ValueError, match=r"in component 1 of 2, row \[1\]"):
            ALGEBRA[name](rows)


def test_divisors_without_width_or_numbers_are_refused():
    whole, zero = pair(1.0), torch.zeros(3, dtype=torch.float64)
    for bad, said in (0.0, "positive definite.*of 0"), (torch.nan, "finite"):
        with pytest.raises(ValueError, match=f"covariances that are {said}"):
            divide(whole, zero, bad * UNIT, widest=UNIT)
        with pytest.raises(ValueError, match=f"covariances that are {said}"):
            divide(whole, zero, UNIT, widest=bad * UNIT)
    with pytest.raises(ValueError, match="a finite mean of the divisor"):
        divide(whole, zero + torch.inf, UNIT, widest=UNIT)


def test_components_as_thin_as_a_line_are_divided():
    with pytest.warns(UserWarning, match="indefinite by rounding: widened"):
        quotient = divide(flat(3), torch.zeros(3).double(), 9 * UNIT, widest=20 * UNIT).mixture
    along = torch.ones(3, dtype=torch.float64)
    found = (along @ quotient.covariance[0] @ along / 3).item()
    assert found == pytest.approx(1 / (1 / 3 - 1 / 9), rel=1e-3)


def refined(summary_of, observed, *, size=1, rounds=2, **options):
    """Return the posterior after some refinements."""
    prior = BoxPrior({f"p{i}": (0.0, 1.0) for i in range(size)})
    refinement = PosteriorRefinement(
        prior, networks=1, fit_options={"epochs": 10, "progress": False}, **options
    )
    for turn in range(rounds):
        refinement.refine(summary_of, observed, key=(turn,))
    return prior, refinement.posterior


@pytest.mark.parametrize("observed", [torch.full((1,), 0.4), torch.full((1, 1), 0.4)])
def test_one_parameter_from_one_trajectory_without_noise(observed):
    _, q = refined(lambda theta: theta, observed, rounds=4, simulations=256)
    assert abs(q.mean.item() - 0.4) < 0.05
    assert 0 < q.stddev.item() < 0.15


def test_constant_statistics_change_nothing_and_another_constant_is_doubted():
    def with_constants(theta):
        return torch.cat([theta, torch.full((len(theta), 2), 3.0)], -1)

    _, plain = refined(lambda theta: theta, torch.tensor([0.4]), simulations=256)
    _, same = refined(with_constants, torch.tensor([0.4, 3.0, 3.0]), simulations=256)
    assert abs(same.mean.item() - plain.mean.item()) < 0.1
    with pytest.warns(UserWarning, match="real summaries lie as far out"):
        _, other = refined(with_constants, torch.tensor([0.4, 3.0, 5.0]), simulations=256)
    assert other.mean.isfinite().all()


def test_a_posterior_pushed_out_of_the_prior_stays_inside_and_is_doubted():
    observed = torch.tensor([3e6, -4e6])
    with pytest.warns(UserWarning, match="real summaries|lie at the") as told:
        prior, q = refined(lambda theta: theta, observed, size=2, simulations=256)
    texts = [str(warning.message) for warning in told]
    for name, edge in {"p0": "upper", "p1": "lower"}.items():
        assert any(
            f"posterior of '{name}'" in text and f"the {edge} edge" in text for text in texts
        )
    draws = q.sample((256,), generator=generator(0))
    assert prior.contains(draws).all()
    assert q.log_prob(draws).isfinite().all()
    assert ((draws - torch.tensor([1.0, 0.0])).abs() < 0.3).all()
