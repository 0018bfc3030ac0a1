import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import MultivariateNormal

from torchrl_bayessim.inference.mixtures import (
    Mixture,
    component_log_prob,
    divide,
    moment_match,
    multiply,
    reduce,
)
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.randomness import generator

SEEDS = st.integers(0, 10_000)
LINE = torch.linspace(-12, 12, 4801, dtype=torch.float64)
STEP = LINE[1] - LINE[0]


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def line_mixture(weight, mean, deviation):
    return Mixture(tensor(*weight).log(), tensor(*mean)[:, None], tensor(*deviation)[:, None, None])


def random_mixture(seed, *, components=3, dim=2, batch=(), widest=1.0):
    g = generator("mixture", seed)
    shape = (*batch, components)
    logits = torch.randn(shape, generator=g, dtype=torch.float64)
    loc = torch.randn(*shape, dim, generator=g, dtype=torch.float64)
    tril = torch.randn(*shape, dim, dim, generator=g, dtype=torch.float64).tril(-1)
    scale = 0.05 + torch.rand(*shape, dim, generator=g, dtype=torch.float64)
    rows = tril + torch.eye(dim)
    rows = rows / rows.norm(dim=-1, keepdim=True)
    return Mixture(logits, loc, widest / 1.05 * scale.unsqueeze(-1) * rows)


def log_prob(mixture, value):
    each = component_log_prob(value, mixture.loc, mixture.scale_tril)
    return (mixture.logits.log_softmax(-1) + each).logsumexp(-1)


def normalised(log_density):
    density = (log_density - log_density.max()).exp()
    return density / (density.sum() * STEP)


def total_variation(first, second):
    return 0.5 * (first - second).abs().sum() * STEP


@pytest.mark.parametrize("dim", [1, 2, 5])
def test_component_densities_are_those_of_torch(dim):
    mixture = random_mixture(0, dim=dim, batch=(4,))
    value = torch.randn(7, 4, dim, generator=generator(0), dtype=torch.float64)
    normal = MultivariateNormal(mixture.loc, scale_tril=mixture.scale_tril)
    got = component_log_prob(value, mixture.loc, mixture.scale_tril)
    assert got.shape == (7, 4, 3)
    torch.testing.assert_close(got, normal.log_prob(value.unsqueeze(-2)))


def test_draws_have_the_moments_of_the_mixture():
    mixture = random_mixture(1)
    draws = TruncatedGaussianMixture(*mixture, None).sample((60_000,), generator=generator(1))
    mean, covariance = moment_match(mixture)
    torch.testing.assert_close(draws.mean(0), mean, rtol=0, atol=0.02)
    torch.testing.assert_close(torch.cov(draws.T), covariance, rtol=0, atol=0.03)


def test_a_draw_comes_from_one_component_and_is_not_a_weighted_sum():
    two = line_mixture([0.5, 0.5], [-1.0, 1.0], [0.1, 0.1])
    draws = TruncatedGaussianMixture(*two, None).sample((20_000,), generator=generator(2))
    assert (draws.abs() > 0.5).all()  # a weighted sum would lie near 0
    assert draws.std().item() == pytest.approx(math.sqrt(1.01), abs=0.01)
    assert moment_match(two)[1].item() == pytest.approx(1.01)


def test_moments_count_the_spread_between_components():
    mixture = random_mixture(3, dim=1)
    density = log_prob(mixture, LINE[:, None]).exp() * STEP
    mean = (density * LINE).sum()
    got_mean, got_covariance = moment_match(mixture)
    torch.testing.assert_close(got_mean.squeeze(), mean)
    torch.testing.assert_close(got_covariance.squeeze(), (density * (LINE - mean) ** 2).sum())


@given(seed=SEEDS, dim=st.integers(1, 3), k1=st.integers(1, 3), k2=st.integers(1, 3))
@settings(max_examples=30, deadline=None)
def test_a_product_is_pointwise(seed, dim, k1, k2):
    first = random_mixture(seed, components=k1, dim=dim)
    second = random_mixture(seed + 1, components=k2, dim=dim)
    product = multiply(first, second)
    assert product.logits.shape == (k1 * k2,)
    points = torch.randn(6, dim, generator=generator(seed), dtype=torch.float64)
    ratio = log_prob(first, points) + log_prob(second, points) - log_prob(product, points)
    torch.testing.assert_close(ratio, ratio[:1].expand(6), rtol=1e-8, atol=1e-6)


def test_batches_of_products_are_products_of_each():
    first, second = random_mixture(0, batch=(4,)), random_mixture(1, components=2, batch=(4,))
    together = multiply(first, second)
    for i in range(4):
        alone = multiply(Mixture(*(x[i] for x in first)), Mixture(*(x[i] for x in second)))
        for got, expected in zip(together, alone, strict=True):
            torch.testing.assert_close(got[i], expected)


def test_division_by_a_gaussian_is_that_of_quadrature():
    mixture = line_mixture([0.6, 0.3, 0.1], [-1.0, 0.5, 2.0], [0.3, 0.6, 0.9])
    quotient, repaired = divide(
        mixture, tensor(0.7), tensor(1.3**2)[None], widest=tensor(100.0)[None]
    )
    divisor = line_mixture([1.0], [0.7], [1.3])
    expected = normalised(log_prob(mixture, LINE[:, None]) - log_prob(divisor, LINE[:, None]))
    got = log_prob(quotient, LINE[:, None]).exp()
    torch.testing.assert_close(got, expected, rtol=1e-8, atol=1e-10)
    assert not repaired.any()


@given(seed=SEEDS, dim=st.integers(1, 3))
@settings(max_examples=30, deadline=None)
def test_division_undoes_multiplication(seed, dim):
    mixture = random_mixture(seed, dim=dim)
    divisor = random_mixture(seed + 1, components=1, dim=dim)
    quotient, repaired = divide(
        multiply(mixture, divisor),
        divisor.loc[0],
        divisor.covariance[0],
        widest=1e6 * torch.eye(dim, dtype=torch.float64),
    )
    points = torch.randn(6, dim, generator=generator(seed), dtype=torch.float64)
    torch.testing.assert_close(
        log_prob(quotient, points), log_prob(mixture, points), rtol=1e-4, atol=1e-4
    )
    assert not repaired.any()


WIDEST = tensor(4.0)[None]


def test_a_component_wider_than_the_divisor_is_repaired():
    mixture = line_mixture([0.4, 0.4, 0.2], [0.0, 1.0, 3.0], [0.2, 1.0, 2.0])
    quotient, repaired = divide(mixture, tensor(0.0), tensor(1.0)[None], widest=WIDEST)
    assert repaired.tolist() == [False, True, True]  # as wide as the divisor, and wider
    torch.testing.assert_close(quotient.loc[1:, 0], tensor(1.0, 3.0))
    torch.testing.assert_close(quotient.covariance[1:].flatten(), tensor(4.0, 4.0))


def test_only_the_wide_directions_of_a_component_are_repaired():
    scale = torch.diag(tensor(0.5, 2.0))[None]
    mixture = Mixture(tensor(0.0), tensor(1.0, 1.0)[None], scale)
    unit = torch.eye(2, dtype=torch.float64)
    quotient, repaired = divide(mixture, tensor(0.0, 0.0), unit, widest=9 * unit)
    assert repaired.tolist() == [True]
    torch.testing.assert_close(quotient.covariance[0], torch.diag(tensor(1 / 3, 9.0)))
    torch.testing.assert_close(quotient.loc[0], tensor(4 / 3, 1.0))


@given(seed=SEEDS, dim=st.integers(1, 3))
@settings(max_examples=30, deadline=None)
def test_no_quotient_is_wider_than_allowed(seed, dim):
    mixture = random_mixture(seed, dim=dim)
    divisor = random_mixture(seed + 1, components=1, dim=dim)
    widest = random_mixture(seed + 2, components=1, dim=dim).covariance[0]
    quotient, _ = divide(mixture, divisor.loc[0], divisor.covariance[0], widest=widest)
    left = torch.linalg.eigvalsh(widest - quotient.covariance)
    assert (left >= -1e-9 * widest.diagonal().sum()).all()


@pytest.mark.parametrize("wide", [1.1, 2.0, 4.0])
def test_a_negligible_wide_component_does_not_take_over(wide):
    mixture = line_mixture([0.999, 0.001], [0.0, 3.0], [0.1, wide])
    quotient, repaired = divide(mixture, tensor(0.0), tensor(1.0)[None], widest=WIDEST)
    assert repaired.tolist() == [False, True]
    # its mass times 1 / N(3; 0, 1), less where the repair narrows it to a deviation of 2
    mass = 0.001 * min(1.0, 2.0 / wide) * math.exp(4.5)
    near = 0.999 * math.sqrt(1 / (1 - 0.01))
    assert quotient.logits.softmax(-1)[1].item() == pytest.approx(mass / (mass + near))


def test_repairs_are_told_over_a_batch():
    loc = torch.zeros(3, 2, 1, dtype=torch.float64)
    scale = tensor(0.5, 0.5, 0.5, 2.0, 2.0, 2.0).reshape(3, 2, 1, 1)
    mixture = Mixture(torch.zeros(3, 2, dtype=torch.float64), loc, scale)
    repaired = divide(mixture, tensor(0.0), tensor(1.0)[None], widest=WIDEST).repaired
    assert repaired.tolist() == [[False, False], [False, True], [True, True]]


def test_dividing_by_a_mixture_term_by_term_is_wrong():
    """The reciprocal of a sum is not the sum of reciprocals: such a formula is far from the ratio.

    A proposal 0.9 N(0, 0.6^2) + 0.1 N(2, 0.6^2) under a posterior N(0.2, 0.4^2).
    """
    mixture = line_mixture([1.0], [0.2], [0.4])
    proposal = line_mixture([0.9, 0.1], [0.0, 2.0], [0.6, 0.6])
    ratio = log_prob(mixture, LINE[:, None]) - log_prob(proposal, LINE[:, None])
    exact = normalised(ratio)
    mean = (exact * LINE).sum() * STEP
    assert mean.item() == pytest.approx(0.311, abs=0.01)

    each = divide(mixture, proposal.loc, proposal.covariance, widest=100 * WIDEST)
    # two divisors are two problems, each with its own exact answer, never summed
    assert each.mixture.logits.shape == (2, 1)
    for got, loc, scale in zip(each.mixture.loc, proposal.loc, proposal.scale_tril, strict=True):
        one = divide(mixture, loc, scale @ scale.mT, widest=100 * WIDEST)
        torch.testing.assert_close(got, one.mixture.loc)

    # sum_l (1 / gamma_l) N / N_l, whose terms have these masses
    peak = component_log_prob(mixture.loc, each.mixture.loc, each.mixture.scale_tril).flatten()
    at_peak = component_log_prob(mixture.loc, proposal.loc, proposal.scale_tril).flatten()
    logits = -proposal.logits - at_peak - peak
    termwise = Mixture(logits, each.mixture.loc[:, 0], each.mixture.scale_tril[:, 0])
    assert total_variation(log_prob(termwise, LINE[:, None]).exp(), exact) > 0.8


@given(seed=SEEDS, dim=st.integers(1, 3), components=st.integers(1, 12))
@settings(max_examples=30, deadline=None)
def test_reduction_keeps_the_moments(seed, dim, components):
    mixture = random_mixture(seed, components=12, dim=dim)
    reduced = reduce(mixture, components)
    assert reduced.logits.shape == (components,)
    for got, expected in zip(moment_match(reduced), moment_match(mixture), strict=True):
        torch.testing.assert_close(got, expected)


def test_reduction_merges_twins_without_loss():
    mixture = random_mixture(0)
    twins = Mixture(*(torch.cat([x, x]) for x in mixture))
    points = torch.randn(20, 2, generator=generator(0), dtype=torch.float64)
    torch.testing.assert_close(log_prob(reduce(twins, 3), points), log_prob(mixture, points))


def test_reduction_keeps_separate_modes_apart():
    mixture = line_mixture([0.3, 0.2, 0.4, 0.1], [-5.0, -5.1, 5.0, 5.1], [0.3, 0.3, 0.2, 0.2])
    reduced = reduce(mixture, 2)
    assert sorted(reduced.loc.flatten().tolist()) == pytest.approx([-5.04, 5.02])


def test_reduction_drops_what_holds_nothing():
    mixture = line_mixture([1.0, 1e-12], [0.0, 5.0], [1.0, 1.0])
    assert reduce(mixture, 8).loc.tolist() == [[0.0]]


WIDE = 50.0 * torch.eye(2, dtype=torch.float64)


def operations(mixture):
    """Yield what the algebra does with a mixture."""
    one = random_mixture(1)
    yield lambda: moment_match(mixture)
    yield lambda: multiply(mixture, one)
    yield lambda: multiply(one, mixture)
    yield lambda: divide(mixture, torch.zeros(2).double(), WIDE / 5, widest=WIDE)
    yield lambda: reduce(mixture, 1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: m._replace(logits=m.logits - math.inf), "a weight above 0, got 'logits of -inf"),
        (lambda m: m._replace(logits=m.logits * math.nan), "finite means, covariances and weights"),
        (lambda m: m._replace(loc=m.loc * math.nan), "NaN or infinity in component 0 of 3"),
        (
            lambda m: m._replace(scale_tril=m.scale_tril * math.inf),
            "NaN or infinity in component 0",
        ),
        (lambda m: m._replace(scale_tril=-m.scale_tril), "got 'a negative diagonal in component 0"),
        (lambda m: m._replace(scale_tril=m.scale_tril + 1), "got 'entries above the diagonal in"),
        (lambda m: m._replace(loc=m.loc[:2]), r"a mixture of shapes \(\*, K\)"),
        (lambda m: m._replace(scale_tril=m.scale_tril[:, :1]), r"a mixture of shapes \(\*, K\)"),
    ],
)
def test_what_is_no_mixture_is_refused(change, said):
    for operation in operations(change(random_mixture(0))):
        with pytest.raises(ValueError, match=said):
            operation()


def test_a_weight_of_zero_is_one():
    mixture = random_mixture(0)
    without = mixture._replace(logits=torch.tensor([-math.inf, 0.3, -0.2], dtype=torch.float64))
    rest = Mixture(*(part[1:] for part in without))
    for here, there in zip(moment_match(without), moment_match(rest), strict=True):
        assert torch.allclose(here, there)
    assert torch.allclose(reduce(without, 1).loc, reduce(rest, 1).loc)


def test_other_dimensions_and_asymmetric_covariances_are_refused():
    one, mean = random_mixture(0), torch.zeros(2).double()
    skew = WIDE / 5 + torch.tensor([[0.0, 1.0], [0.0, 0.0]])
    with pytest.raises(ValueError, match="a second mixture of 2 dimensions, got 3"):
        multiply(one, random_mixture(0, dim=3))
    with pytest.raises(ValueError, match="a second mixture of 1 dimensions, got 2"):
        multiply(random_mixture(0, dim=1), one)
    with pytest.raises(ValueError, match=r"mean of the divisor of shape \(\*, 2\), got \(1,\)"):
        divide(one, mean[:1], WIDE / 5, widest=WIDE)
    with pytest.raises(ValueError, match=r"covariance of the divisor of shape \(\*, 2, 2\)"):
        divide(one, mean, WIDE[:1, :1], widest=WIDE)
    with pytest.raises(ValueError, match="covariance of the divisor to be symmetric, got 'entries"):
        divide(one, mean, skew, widest=WIDE)
    with pytest.raises(ValueError, match="widest to be symmetric"):
        divide(one, mean, WIDE / 5, widest=skew)
    with pytest.raises(ValueError, match=r"positive definite, got 'a variance of -10"):
        divide(one, mean, -WIDE / 5, widest=WIDE)


def test_parts_that_do_not_belong_together_are_refused():
    one, mean = random_mixture(0), torch.zeros(2).double()
    four, three = random_mixture(0, batch=(4,)), random_mixture(1, batch=(3,))
    with pytest.raises(ValueError, match=r"batch shapes that broadcast, got \{'logits': \(3,\)"):
        moment_match(four._replace(logits=three.logits))
    with pytest.raises(ValueError, match=r"broadcast, got \{'the first mixture': \(4,\), 'the sec"):
        multiply(four, three)
    with pytest.raises(ValueError, match=r"broadcast, .*'the mean of the divisor': \(3,\)"):
        divide(four, mean.expand(3, 2), WIDE / 5, widest=WIDE)
    with pytest.raises(ValueError, match=r"one dtype, .*'logits': 'torch\.float32 on cpu'"):
        reduce(one._replace(logits=one.logits.float()), 2)
    with pytest.raises(ValueError, match=r"one dtype, .*'the second': 'torch\.float32 on cpu'"):
        multiply(one, Mixture(*(part.float() for part in one)))
    with pytest.raises(ValueError, match=r"one dtype, .*'widest': 'torch\.float32 on cpu'"):
        divide(one, mean, WIDE / 5, widest=WIDE.float())
    with pytest.raises(
        ValueError, match=r"in floats of one dtype, .*'logits': 'torch\.int64 on cpu'"
    ):
        moment_match(Mixture(*(part.long() for part in one)))
    with pytest.raises(ValueError, match=r"one widest, of shape \(2, 2\), got \(4, 2, 2\)"):
        divide(four, mean, WIDE / 5, widest=WIDE.expand(4, 2, 2))
    with pytest.raises(ValueError, match=r"one device, .*'loc': 'torch\.float64 on meta'"):
        moment_match(one._replace(loc=one.loc.to("meta")))


def test_a_mixture_is_reduced_to_one_component_or_more():
    one = random_mixture(0)
    with pytest.raises(ValueError, match="components to be positive, got 0"):
        reduce(one, 0)
    with pytest.raises(TypeError, match=r"a whole number of components, got 1\.5"):
        reduce(one, 1.5)
    with pytest.raises(ValueError, match=r"an unbatched mixture.*got \(4, 3\)"):
        reduce(random_mixture(0, batch=(4,)), 1)
