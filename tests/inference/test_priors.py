import math
import pickle

import pytest
import scipy.stats
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.randomness import generator


def box():
    bounds = {"mass": (2.0, 6.0), "damping": (0.01, 1.0), "offset": (-3.0, -1.0)}
    return BoxPrior(bounds, log=["damping"], units={"mass": "kg"})


def gaussian():
    correlation = torch.tensor([[1.0, -0.7], [-0.7, 1.0]])
    return GaussianPrior({"mass": (4.0, 0.5), "offset": (100.0, 3.0)}, correlation=correlation)


PRIORS = pytest.mark.parametrize("prior", [box(), gaussian()], ids=["box", "gaussian"])


@pytest.mark.parametrize("high", [1.0001, 1.5, 20.0])
def test_the_variance_of_a_log_uniform_is_that_of_its_draws(high):
    prior = BoxPrior({"d": (1.0, high)}, log=["d"])
    draws = prior.sample((200_000,), generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(prior.variance.double(), draws.var(0), rtol=0.02, atol=0.0)


def test_draws_stay_in_the_box_with_one_range_per_column():
    theta = box().sample((4000,), generator=generator(0))
    low, high = torch.tensor([2.0, 0.01, -3.0]), torch.tensor([6.0, 1.0, -1.0])
    assert ((theta >= low) & (theta <= high)).all()
    # every column fills its own range, so none was swapped or mixed with another
    z = box().standardize(theta)
    assert (z.amin(0) < -1.72).all()
    assert (z.amax(0) > 1.72).all()


@PRIORS
def test_draws_have_the_stated_moments(prior):
    theta = prior.sample((40_000,), generator=generator(1)).double()
    error = theta.std(0) / math.sqrt(len(theta))
    assert ((theta.mean(0) - prior.mean).abs() < 5 * error).all()
    torch.testing.assert_close(theta.var(0).float(), prior.variance, rtol=0.03, atol=0)


def test_logarithmic_draws_are_uniform_in_their_logarithm():
    damping = box().sample((2000,), generator=generator(2))[:, 1].numpy()
    assert scipy.stats.kstest(damping, scipy.stats.loguniform(0.01, 1.0).cdf).pvalue > 1e-3


@PRIORS
def test_draws_depend_on_their_generator_alone(prior):
    state = torch.random.get_rng_state()
    first, second = (prior.sample((2, 3), generator=generator(0)) for _ in range(2))
    assert first.shape == (2, 3, len(prior.names))
    assert torch.equal(first, second)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert not torch.equal(first, prior.sample((2, 3), generator=generator(1)))


def test_log_density_of_a_box_is_that_of_scipy():
    theta = box().sample((50,), generator=generator(3))
    expected = scipy.stats.uniform(2, 4).logpdf(theta[:, 0])
    expected += scipy.stats.loguniform(0.01, 1.0).logpdf(theta[:, 1])
    expected += scipy.stats.uniform(-3, 2).logpdf(theta[:, 2])
    torch.testing.assert_close(
        box().log_prob(theta), torch.as_tensor(expected).float(), rtol=0, atol=1e-4
    )


def test_log_density_of_a_gaussian_is_that_of_scipy():
    covariance = [[0.25, -1.05], [-1.05, 9.0]]
    theta = torch.tensor([[4.0, 100.0], [4.3, 95.0], [2.0, 110.0]], dtype=torch.float64)
    expected = scipy.stats.multivariate_normal([4.0, 100.0], covariance).logpdf(theta)
    torch.testing.assert_close(gaussian().log_prob(theta), torch.as_tensor(expected))


@pytest.mark.parametrize(
    "theta",
    [
        [1.9, 0.1, -2.0],
        [6.1, 0.1, -2.0],
        [4.0, 0.0099, -2.0],
        [4.0, 0.0, -2.0],
        [4.0, -0.1, -2.0],
        [4.0, 0.1, -0.9],
        [math.nan, 0.1, -2.0],
        [math.inf, 0.1, -2.0],
    ],
)
def test_outside_the_box_the_density_is_zero(theta):
    assert not box().contains(torch.tensor(theta))
    assert box().log_prob(torch.tensor(theta)) == -torch.inf


def test_a_logarithmic_parameter_of_many_decades_excludes_zero():
    prior = BoxPrior({"damping": (1e-7, 1.0)}, log=["damping"])
    outside = torch.tensor([[0.0], [-1e-7], [5e-8]])
    assert not prior.contains(outside).any()
    assert (prior.log_prob(outside) == -torch.inf).all()
    assert prior.contains(prior.sample((1000,), generator=generator(0))).all()


def test_the_widest_logarithmic_parameter_has_moments_and_samples():
    prior = BoxPrior({"a": (1.2e-38, 1e18)}, log=["a"])
    theta = prior.sample((1000,), generator=generator(0))
    assert prior.contains(theta).all()
    assert prior.log_prob(theta).isfinite().all()
    width = math.log(1e18) - math.log(1.2e-38)
    assert prior.mean.item() == pytest.approx(1e18 / width)
    assert prior.standardize(theta).std().item() == pytest.approx(1, abs=0.05)


def test_the_bounds_themselves_are_inside():
    prior = box()
    assert prior.contains(torch.stack([prior.low, prior.high])).all()
    assert prior.support.check(torch.stack([prior.low, prior.high])).all()


def test_gaussian_support_is_all_finite_parameters():
    theta = torch.tensor([[1e6, -1e6], [math.nan, 0.0], [math.inf, 0.0]])
    assert gaussian().contains(theta).tolist() == [True, False, False]


@PRIORS
def test_standardised_draws_have_mean_zero_and_unit_covariance(prior):
    z = prior.standardize(prior.sample((40_000,), generator=generator(4)).double())
    torch.testing.assert_close(z.mean(0), torch.zeros_like(z[0]), rtol=0, atol=0.03)
    torch.testing.assert_close(
        torch.cov(z.T), torch.eye(z.shape[-1], dtype=z.dtype), rtol=0, atol=0.03
    )


def test_the_edges_of_a_box_are_the_edges_in_standardised_coordinates():
    prior = box()
    for edge, theta in zip(prior.box, (prior.low, prior.high), strict=True):
        torch.testing.assert_close(prior.standardize(theta.double()), edge, rtol=1e-6, atol=0)


@given(
    low=st.floats(1e-3, 1e3),
    ratio=st.floats(1.01, 1e3),
    at=st.floats(0, 1),
    log=st.booleans(),
)
@settings(max_examples=50, deadline=None)
def test_standardising_is_undone_exactly(low, ratio, at, log):
    prior = BoxPrior({"a": (low, low * ratio)}, log=["a"] if log else [])
    theta = prior.low.double() + at * (prior.high - prior.low).double()
    there = prior.standardize(theta)
    torch.testing.assert_close(prior.unstandardize(there), theta, rtol=1e-9, atol=0)
    assert (there.abs() <= math.sqrt(3) + 1e-6).all()


@PRIORS
@pytest.mark.parametrize("name", ["standardization", "bijection"])
def test_jacobians_agree_with_automatic_differentiation(prior, name):
    transform = getattr(prior, name)
    z = torch.randn(4, len(prior.names), dtype=torch.float64, generator=generator(5))
    expected = [torch.autograd.functional.jacobian(transform, row).slogdet()[1] for row in z]
    torch.testing.assert_close(
        transform.log_abs_det_jacobian(z, transform(z)), torch.stack(expected)
    )


@PRIORS
def test_the_bijection_maps_everything_into_the_support_and_back(prior):
    y = 3 * torch.randn(200, len(prior.names), dtype=torch.float64, generator=generator(6))
    theta = prior.bijection(y)
    assert prior.contains(theta).all()
    torch.testing.assert_close(prior.bijection.inv(theta), y, rtol=1e-5, atol=1e-5)


def test_one_parameter_keeps_its_axis():
    prior = BoxPrior({"mass": (2.0, 6.0)})
    theta = prior.sample(generator=generator(0))
    assert theta.shape == (1,)
    assert prior.log_prob(theta).shape == ()
    assert prior.log_prob(theta[None]).tolist() == pytest.approx([-math.log(4)])
    assert prior.mean.tolist() == [4.0]


def test_names_and_units_keep_the_order_of_declaration():
    assert box().names == ("mass", "damping", "offset")
    assert box().units == ("kg", "", "")
    pairs = BoxPrior([("b", (0.0, 1.0)), ("a", (2.0, 3.0))])
    assert pairs.names == ("b", "a")
    assert pairs.low.tolist() == [0.0, 2.0]


@PRIORS
def test_a_prior_survives_pickling(prior):
    theta = prior.sample((3,), generator=generator(0))
    copy = pickle.loads(pickle.dumps(prior))
    assert torch.equal(copy.log_prob(theta), prior.log_prob(theta))


def test_priors_show_their_names_and_numbers():
    expected = "BoxPrior(mass: [2, 6] kg, damping: [0.01, 1], offset: [-3, -1])"
    assert repr(box()) == expected
    assert repr(gaussian()) == "GaussianPrior(mass: 4 ± 0.5, offset: 100 ± 3)"


@pytest.mark.parametrize(
    ("bounds", "log", "match"),
    [
        ({}, [], "at least one named parameter, got 'an empty prior'"),
        ([("a", (0, 1)), ("a", (1, 2))], [], "every parameter once, got 'a twice'"),
        ({"a": (2, 1)}, [], r"low < high for 'a', got \(2.0, 1.0\). Try: \(1.0, 2.0\)"),
        ({"a": (1, 1)}, [], "low < high for 'a'.*no parameter for what is known exactly"),
        ({"a": (0, 1e300)}, [], "finite bounds for 'a'"),
        ({"a": (0, math.nan)}, [], "finite bounds for 'a'"),
        ({"a": (0, math.inf)}, [], "finite bounds for 'a' .* Try: .*GaussianPrior"),
        ({"a": (math.nan, 1)}, [], "finite bounds for 'a'"),
        ({"a": (0, 1)}, ["a"], "a positive lower bound for the logarithmic parameter 'a'"),
        ({"a": (1e-50, 1)}, ["a"], r"parameter 'a' of at least 1.2e-38, .* got \(1e-50, 1.0\)"),
        ({"a": (1e-40, 1)}, ["a"], "since parameters are kept in float32"),
        ({"mass": (1, 2)}, ["mas"], r"log= to name .* got 'mas'. Available: mass \(did you"),
    ],
)
def test_a_box_that_cannot_be_is_refused(bounds, log, match):
    with pytest.raises(ValueError, match=match):
        BoxPrior(bounds, log=log)


@pytest.mark.parametrize(
    ("moments", "correlation", "match"),
    [
        ({}, None, "at least one named parameter"),
        ([("a", (0, 1)), ("a", (1, 2))], None, "every parameter once, got 'a twice'"),
        ({"a": (0, 0)}, None, "a finite mean and a positive deviation for 'a'"),
        ({"a": (math.nan, 1)}, None, "a finite mean and a positive deviation for 'a'"),
        ({"a": (0, 1)}, torch.eye(2), r"correlation matrix of shape \(1, 1\) with unit diagonal"),
        ({"a": (0, 1)}, 2 * torch.eye(1), "with unit diagonal"),
        (
            {"a": (0, 1), "b": (0, 1)},
            torch.tensor([[1.0, 1.5], [1.5, 1.0]]),
            "a positive definite correlation matrix",
        ),
        (
            {"a": (0, 1), "b": (0, 1)},
            torch.tensor([[1.0, 0.3], [0.5, 1.0]]),
            "a symmetric correlation matrix",
        ),
    ],
)
def test_a_gaussian_that_cannot_be_is_refused(moments, correlation, match):
    with pytest.raises(ValueError, match=match):
        GaussianPrior(moments, correlation=correlation)


def test_units_of_unknown_parameters_are_refused():
    with pytest.raises(ValueError, match="units of declared parameters, got 'weight'"):
        BoxPrior({"mass": (1, 2)}, units={"weight": "kg"})
    with pytest.raises(TypeError, match=r"units= to be {name: unit}, got 'kg'"):
        BoxPrior({"mass": (1, 2)}, units="kg")


def test_parameters_are_named_by_strings():
    with pytest.raises(TypeError, match="a name that is a string, got 1"):
        BoxPrior({1: (1, 2)})
    with pytest.raises(TypeError, match=r"names with \(low, high\) each.*got 'NoneType'"):
        BoxPrior(None)


@PRIORS
@pytest.mark.parametrize("method", ["contains", "log_prob", "standardize"])
def test_the_wrong_number_of_parameters_is_refused(prior, method):
    match = rf"one column for each of {', '.join(prior.names)}, got \(5, 7\)"
    with pytest.raises(ValueError, match=match):
        getattr(prior, method)(torch.zeros(5, 7))


@pytest.mark.parametrize("bounds", [1.0, (1.0,), (1.0, 2.0, 3.0), ("low", "high"), None])
def test_bounds_are_two_numbers(bounds):
    with pytest.raises(ValueError, match=r"a name with \(low, high\), two numbers, got \('a', "):
        BoxPrior({"a": bounds})


def test_moments_are_two_numbers():
    with pytest.raises(ValueError, match=r"a name with \(mean, standard deviation\), two numbers"):
        GaussianPrior({"a": 1.0})
    with pytest.raises(ValueError, match="a name with"):
        GaussianPrior([1.0])


def test_logarithmic_parameters_are_listed():
    with pytest.raises(TypeError, match=r"log= to be a list of names, got 'mass'.*log=\['mass'\]"):
        BoxPrior({"mass": (1.0, 2.0)}, log="mass")


def test_bounds_differ_in_the_precision_that_parameters_have():
    with pytest.raises(ValueError, match="bounds of 'mass' that differ in float32"):
        BoxPrior({"mass": (1.0, 1.0 + 1e-9)})
    narrow = BoxPrior({"mass": (1.0, 1.0 + 1e-6)})
    assert narrow.contains(narrow.sample((100,), generator=generator(0))).all()
