import math

import numpy as np
import pytest
import scipy.stats
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from torch.distributions import MultivariateNormal

from torchrl_bayessim.inference import truncation
from torchrl_bayessim.inference.truncated_normal import (
    log_interval,
    log_interval_of_arrays,
    truncated_quantile,
)
from torchrl_bayessim.inference.truncation import (
    TruncatedGaussianMixture,
    log_mass,
)
from torchrl_bayessim.randomness import generator

FAR = [(-1.0, 2.0), (0.5, 0.6), (7.0, 9.0), (35.0, 36.0), (35.0, 1e6), (500.0, 500.1)]
INTERVALS = [*FAR, *((-high, -low) for low, high in FAR)]


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def edge(dim, half=1.0):
    one = half * torch.ones(dim, dtype=torch.float64)
    return -one, one


def log_interval_by_quadrature(a, b):
    """Take the density at the end nearest to 0 out of the integral, so that nothing underflows."""
    if a < 0 < b:
        return math.log(scipy.stats.norm.cdf(b) - scipy.stats.norm.cdf(a))
    near, width = min(abs(a), abs(b)), min(b - a, 40 / max(1.0, min(abs(a), abs(b))))
    mass = quad(lambda t: math.exp(-t * (near + t / 2)), 0, width, epsabs=0, epsrel=1e-12)[0]
    return math.log(mass) - near**2 / 2 - 0.5 * math.log(2 * math.pi)


@pytest.mark.parametrize(("a", "b"), INTERVALS)
def test_the_mass_of_an_interval_is_right_in_both_tails(a, b):
    expected = pytest.approx(log_interval_by_quadrature(a, b), rel=1e-8)
    assert log_interval(tensor(a), tensor(b)).item() == expected
    assert log_interval_of_arrays(np.array([a]), np.array([b])).item() == expected


@pytest.mark.parametrize(("a", "b"), INTERVALS)
@pytest.mark.parametrize("end", [0, 1])
def test_its_gradient_is_that_of_finite_differences(a, b, end):
    ends = [tensor(a).requires_grad_(), tensor(b).requires_grad_()]
    log_interval(*ends).sum().backward()
    step = 1e-4 / max(1.0, abs((a, b)[end]))
    above, below = [a, b], [a, b]
    above[end] += step
    below[end] -= step
    expected = (log_interval_by_quadrature(*above) - log_interval_by_quadrature(*below)) / (
        2 * step
    )
    assert ends[end].grad.item() == pytest.approx(expected, rel=2e-4, abs=1e-6)


@pytest.mark.parametrize("at", [1e4, 1e6, 1e8])
@pytest.mark.parametrize("sign", [-1, 1])
def test_nothing_overflows_at_absurd_distances(at, sign):
    low = tensor(sign * at).requires_grad_()
    high = low + 1.0
    mass = log_interval(low, high)
    ends = low.detach().numpy(), high.detach().numpy()
    assert log_interval_of_arrays(*ends) == pytest.approx(mass.detach().numpy(), rel=1e-12)
    middle = truncated_quantile(low, high, tensor(0.5))
    (mass + middle).sum().backward()
    assert mass.isfinite().all()
    assert low.grad.isfinite().all()
    assert low <= middle <= high


@given(a=st.floats(-45, 45), width=st.floats(1e-3, 60), u=st.floats(1e-3, 1 - 1e-3))
@settings(max_examples=200, deadline=None)
def test_the_quantile_inverts_the_distribution_function(a, width, u):
    low, high = tensor(a), tensor(a + width)
    y = truncated_quantile(low, high, tensor(u))
    assert low <= y <= high
    if y > low:
        below = (log_interval(low, y) - log_interval(low, high)).exp().item()
        assert below == pytest.approx(u, rel=1e-4)


@pytest.mark.parametrize(("a", "b"), [(-1.0, 2.0), (0.5, 0.9), (5.0, 6.0), (-20.0, -18.0)])
def test_the_gradient_of_the_quantile_is_that_of_finite_differences(a, b):
    u = tensor(0.1, 0.5, 0.95)
    ends = tensor(a).requires_grad_(), tensor(b).requires_grad_()
    assert torch.autograd.gradcheck(lambda a, b: truncated_quantile(a, b, u), ends)


@pytest.mark.parametrize("at", [31.0, 200.0])
def test_far_out_the_quantile_is_exponential_and_so_is_its_gradient(at):
    low, high, u = tensor(at).requires_grad_(), tensor(at + 5.0).requires_grad_(), 0.3
    y = truncated_quantile(low, high, tensor(u))
    y.backward(torch.ones_like(y))
    assert y.item() - at == pytest.approx(-math.log(1 - u) / at, rel=2e-3)
    assert low.grad.item() == pytest.approx(1.0, abs=2e-3)
    assert high.grad.item() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("loc", [0.0, 0.9, -3.0, 40.0])
@pytest.mark.parametrize("scale", [1e-3, 0.5, 50.0])
def test_the_mass_of_a_diagonal_component_is_exact(loc, scale):
    box = edge(2)
    locs = tensor(loc, 0.2)
    got = log_mass(locs, torch.diag(tensor(scale, 0.3)), box, diagonal=True)
    expected = log_interval_by_quadrature((-1 - loc) / scale, (1 - loc) / scale)
    expected += log_interval_by_quadrature(-1.2 / 0.3, 0.8 / 0.3)
    assert got.item() == pytest.approx(expected, rel=1e-7)


def correlated(dim, correlation, scale=1.0):
    covariance = correlation * torch.ones(dim, dim, dtype=torch.float64)
    covariance += (1 - correlation) * torch.eye(dim)
    return scale * torch.linalg.cholesky(covariance)


@pytest.mark.parametrize(
    ("dim", "correlation", "scale_at"),
    [
        (2, 0.5, (0.5, 0)),
        (2, -0.9, (1, 0.7)),
        (2, 0.99, (2, 1)),
        (3, 0.7, (1, 0.5)),
        (4, 0.9, (1, 1)),
    ],
)
def test_the_mass_of_a_correlated_component_is_that_of_scipy(dim, correlation, scale_at):
    scale, at = scale_at
    loc, tril = at * torch.ones(dim, dtype=torch.float64), correlated(dim, correlation, scale)
    box = edge(dim)
    expected = scipy.stats.multivariate_normal(loc, tril @ tril.mT).cdf(
        box[1], lower_limit=box[0], rng=0
    )
    got = log_mass(loc, tril, box, diagonal=False).exp()
    assert got.item() == pytest.approx(expected, rel=0.02)
    many = log_mass(loc, tril, box, diagonal=False, points=2**14).exp()
    assert many.item() == pytest.approx(expected, rel=1e-3)


def test_the_mass_of_a_correlated_component_reduces_to_the_diagonal_one():
    loc, scale = tensor(0.3, -0.8, 1.0), torch.diag(tensor(0.5, 1.0, 2.0))
    exact = log_mass(loc, scale, edge(3), diagonal=True)
    torch.testing.assert_close(log_mass(loc, scale, edge(3), diagonal=False), exact)


def test_gradients_of_a_correlated_mass_are_those_of_finite_differences():
    loc = tensor(0.3, -0.8, 1.0).requires_grad_()
    scale = (correlated(3, 0.6) + 0.2 * torch.eye(3)).requires_grad_()
    box = edge(3)
    assert torch.autograd.gradcheck(
        lambda loc, scale: log_mass(loc, scale.tril(), box, diagonal=False), (loc, scale)
    )


def mixture(box=True, **options):
    """Two components in two dimensions, one in a corner of the box and one far outside."""
    loc = tensor(0.8, -0.5, -3.0, 2.0).reshape(2, 2)
    scale = torch.stack([correlated(2, 0.8, 0.6), correlated(2, -0.5, 1.0)])
    return TruncatedGaussianMixture(
        tensor(0.3, 0.7).log(), loc, scale, edge(2) if box else None, **options
    )


def grid(points=401, half=1.0):
    axis = torch.linspace(-half, half, points + 1, dtype=torch.float64)
    middle = (axis[1:] + axis[:-1]) / 2
    return torch.cartesian_prod(middle, middle), (axis[1] - axis[0]) ** 2


def test_the_density_integrates_to_one_over_the_box():
    where, area = grid()
    assert (mixture().log_prob(where).exp().sum() * area).item() == pytest.approx(1, abs=5e-3)
    fine = mixture(points=2**14).log_prob(where).exp().sum() * area
    assert fine.item() == pytest.approx(1, abs=5e-4)


@given(loc=st.floats(-30, 30), scale=st.floats(0.02, 100))
@settings(max_examples=50, deadline=None)
def test_one_dimensional_densities_integrate_to_one(loc, scale):
    q = TruncatedGaussianMixture(tensor(0.0), tensor(loc)[None], tensor(scale)[None, None], edge(1))
    if abs(loc) > 1 and (abs(loc) - 1) / scale**2 > 500:
        return  # all mass within a cell of the grid at the edge
    axis = torch.linspace(-1, 1, 20_001, dtype=torch.float64)
    density = q.log_prob(axis[:, None]).exp()
    assert torch.trapezoid(density, axis).item() == pytest.approx(1, rel=1e-3)


def test_the_density_inside_is_the_gaussian_over_its_mass():
    tril = correlated(2, 0.5)
    one = TruncatedGaussianMixture(
        tensor(0.0), tensor(0.2, 0.1)[None], tril[None], edge(2), points=2**14
    )
    normal = scipy.stats.multivariate_normal([0.2, 0.1], tril @ tril.mT)
    mass = normal.cdf([1, 1], lower_limit=[-1, -1], rng=0)
    expected = normal.logpdf([0.5, -0.9]) - math.log(mass)
    assert one.log_prob(tensor(0.5, -0.9)).item() == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("value", [1.001, -1.001, math.inf, -math.inf, math.nan])
def test_the_density_outside_is_zero(value):
    assert mixture().log_prob(tensor(0.0, value)) == -torch.inf


def test_a_gradient_passes_by_what_is_outside():
    loc = tensor(0.2)[None].requires_grad_()
    q = TruncatedGaussianMixture(tensor(0.0), loc, tensor(0.5)[None, None], edge(1))
    log_prob = q.log_prob(tensor(0.1, 2.0, math.nan)[:, None])
    torch.where(log_prob.isfinite(), log_prob, 0.0).sum().backward()
    assert loc.grad.isfinite().all()


def test_restriction_keeps_the_shape_of_the_untruncated_mixture():
    free = mixture(box=False)
    restricted = TruncatedGaussianMixture.restrict(free.logits, free.loc, free.scale_tril, edge(2))
    where = 2 * torch.rand(50, 2, generator=generator(0), dtype=torch.float64) - 1
    ratio = free.log_prob(where) - restricted.log_prob(where)
    torch.testing.assert_close(ratio, ratio[:1].expand(50))  # one constant: the mass inside
    torch.testing.assert_close(restricted.untruncated.logits, free.logits)
    # the far component has lost nearly all of its weight
    assert restricted.logits.exp()[1] < 0.1


def test_draws_of_a_correlated_mixture_follow_the_density():
    q = mixture()
    draws = q.sample((20_000,), generator=generator(1))
    assert (draws.abs() <= 1).all()
    where, area = grid()
    density = q.log_prob(where).exp() * area
    mean = density @ where
    covariance = (density[:, None] * (where - mean)).mT @ (where - mean)
    torch.testing.assert_close(draws.mean(0), mean, rtol=0, atol=0.02)
    torch.testing.assert_close(torch.cov(draws.T), covariance, rtol=0, atol=0.01)


def test_draws_of_a_diagonal_component_are_those_of_scipy():
    loc, scale = -2.0, 0.7
    q = TruncatedGaussianMixture(tensor(0.0), tensor(loc)[None], tensor(scale)[None, None], edge(1))
    draws = q.sample((4000,), generator=generator(2)).squeeze(-1)
    exact = scipy.stats.truncnorm((-1 - loc) / scale, (1 - loc) / scale, loc, scale)
    assert scipy.stats.kstest(draws.numpy(), exact.cdf).pvalue > 1e-3


def test_draws_without_a_box_are_gaussian():
    free = mixture(box=False)
    draws = free.sample((40_000,), generator=generator(3))
    expected = 0.3 * free.loc[0] + 0.7 * free.loc[1]
    torch.testing.assert_close(draws.mean(0), expected, rtol=0, atol=0.05)
    assert (draws.abs() > 1).any()


def test_weights_are_probabilities_inside_the_box():
    loc = tensor(-1.0, 30.0)[:, None]
    scale = tensor(0.2, 1.0)[:, None, None]
    q = TruncatedGaussianMixture(tensor(0.25, 0.75).log(), loc, scale, edge(1))
    draws = q.sample((4000,), generator=generator(4))
    assert (draws > 0.5).double().mean().item() == pytest.approx(0.75, abs=0.03)


@pytest.mark.parametrize("diagonal", [False, True])
@pytest.mark.parametrize("distance", [3.0, 50.0, 1e4])
def test_sampling_never_hangs_however_little_mass_is_inside(diagonal, distance):
    scale = torch.eye(3, dtype=torch.float64) if diagonal else correlated(3, 0.9)
    loc = distance * tensor(1.0, -1.0, 1.0)
    q = TruncatedGaussianMixture(tensor(0.0), loc[None], scale[None], edge(3), diagonal=diagonal)
    draws = q.sample((200,), generator=generator(5))
    assert (draws.abs() <= 1).all()
    assert q.log_prob(draws).isfinite().all()
    if diagonal:  # everything is at the nearest corner
        assert (draws * loc.sign()).mean() > (0.6 if distance == 3.0 else 0.97)


@pytest.mark.parametrize("shape", [(), (0,), (5,), (2, 3)])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("box", [False, True])
def test_shapes(shape, batch, box):
    one = mixture(box=box)
    q = TruncatedGaussianMixture(
        one.logits.expand(*batch, 2),
        one.loc.expand(*batch, 2, 2),
        one.scale_tril.expand(*batch, 2, 2, 2),
        one.box,
    )
    draws = q.sample(shape, generator=generator(6))
    assert draws.shape == (*shape, *batch, 2)
    assert q.log_prob(draws).shape == (*shape, *batch)
    assert (q.batch_shape, q.event_shape) == (batch, (2,))


def test_every_row_of_a_batch_is_drawn_from_its_own_mixture():
    loc = tensor(-0.9, 0.0, 0.9).reshape(3, 1, 1)
    scale = 0.01 * torch.ones(3, 1, 1, 1, dtype=torch.float64)
    q = TruncatedGaussianMixture(torch.zeros(3, 1), loc, scale, edge(1))
    draws = q.sample((100,), generator=generator(7))
    torch.testing.assert_close(draws, loc.squeeze(-1).expand(100, 3, 1), rtol=0, atol=0.06)


def test_draws_depend_on_their_generator_alone():
    state = torch.random.get_rng_state()
    first, again, other = (mixture().sample((9,), generator=generator(s)) for s in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.random.get_rng_state(), state)


@pytest.mark.parametrize("box", [False, True])
def test_quadrature_has_the_moments_of_the_density(box):
    q = mixture(box=box)
    where, weight = q.quadrature()
    assert weight.sum().item() == pytest.approx(1)
    mean = weight @ where
    fine, area = grid(half=1.0 if box else 8.0)
    density = q.log_prob(fine).exp() * area
    torch.testing.assert_close(mean, density @ fine, rtol=0, atol=0.01)
    torch.testing.assert_close(weight @ where**2, density @ fine**2, rtol=0.02, atol=0.01)
    again, _ = q.quadrature()
    assert torch.equal(where, again)


def test_untruncated_densities_are_those_of_torch():
    free = mixture(box=False)
    where = torch.randn(5, 2, generator=generator(8), dtype=torch.float64)
    each = MultivariateNormal(free.loc, scale_tril=free.scale_tril).log_prob(where[:, None])
    torch.testing.assert_close(free.log_prob(where), (free.logits + each).logsumexp(-1))


def test_points_made_in_inference_mode_can_be_trained_on_later():
    truncation._points.cache_clear()
    loc, scale = tensor(0.3, -0.8).requires_grad_(), correlated(2, 0.6)
    with torch.inference_mode():
        log_mass(loc, scale, edge(2), diagonal=False)
    log_mass(loc, scale, edge(2), diagonal=False).backward()
    assert loc.grad.isfinite().all()
