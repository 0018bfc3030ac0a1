import math

import pytest
import torch

from torchrl_bayessim.inference.features import (
    FourierFeatures,
    NeuralFeatures,
    ResidualFeatures,
    spectral_frequencies,
)
from torchrl_bayessim.randomness import generator

# Each of M terms cos(w (x - x')) varies by at most 1 / sqrt 2 about the kernel, so plain Monte
# Carlo has a deviation below 1 / sqrt(2 M) = 0.006. Two deviations tell a Matérn kernel from one
# with a degree of freedom less (0.03 at r = 1) and from a product of one-dimensional kernels.
FREQUENCIES = 2**14
TOLERANCE = 2 / math.sqrt(2 * FREQUENCIES)

CLOSED_FORMS = {
    "rbf": lambda r: (-(r**2) / 2).exp(),
    "matern12": lambda r: (-r).exp(),
    "matern32": lambda r: (1 + math.sqrt(3) * r) * (-math.sqrt(3) * r).exp(),
    "matern52": lambda r: (1 + math.sqrt(5) * r + 5 * r**2 / 3) * (-math.sqrt(5) * r).exp(),
}
DISTANCES = torch.tensor([0.0, 0.25, 0.5, 1.0, 1.5, 2.5, 4.0])


def directions(dim):
    """An axis, the diagonal (where a product of one-dimensional kernels is worst), and one more."""
    some = torch.randn(dim, generator=generator("direction", dim))
    return [torch.eye(dim)[0], torch.ones(dim) / math.sqrt(dim), some / some.norm()]


@pytest.mark.parametrize("kernel", CLOSED_FORMS)
@pytest.mark.parametrize("dim", [1, 2, 12])
def test_inner_products_are_the_isotropic_kernel(kernel, dim):
    phi = FourierFeatures(dim, frequencies=FREQUENCIES, kernel=kernel)
    for direction in directions(dim):
        x = DISTANCES[:, None] * direction
        torch.testing.assert_close(
            phi(x) @ phi(torch.zeros(dim)),
            CLOSED_FORMS[kernel](DISTANCES),
            rtol=0,
            atol=TOLERANCE,
        )


def test_the_tolerance_tells_kernels_apart():
    r = torch.tensor(1.0)
    # Matérn-1, the Student t of two degrees: sqrt 2 K_1(sqrt 2) by scipy.special.kv
    assert abs(CLOSED_FORMS["matern32"](r).item() - 0.4473) > 2 * TOLERANCE
    isotropic, per_axis = (CLOSED_FORMS["matern52"](x) for x in (0.5 * r * 12**0.5, 0.5 * r))
    assert isotropic - per_axis**12 > 5 * TOLERANCE


@pytest.mark.parametrize("kernel", CLOSED_FORMS)
def test_the_kernel_is_stationary_and_one_at_zero(kernel):
    phi = FourierFeatures(3, frequencies=32, kernel=kernel).double()
    x, y, shift = torch.randn(3, 3, generator=generator(0), dtype=torch.float64)
    torch.testing.assert_close(phi(x) @ phi(y), phi(x + shift) @ phi(y + shift))
    torch.testing.assert_close(phi(x).norm(), torch.ones_like(x[0]))


def test_the_lengthscale_divides_the_inputs():
    x = torch.tensor([[0.3, -0.8], [2.0, 1.0]])
    wide = FourierFeatures(2, lengthscale=4.0)
    torch.testing.assert_close(wide(4 * x), FourierFeatures(2)(x))


@pytest.mark.parametrize("kernel", CLOSED_FORMS)
def test_the_first_points_of_the_sequence_are_finite(kernel):
    for seed in range(20):
        first = spectral_frequencies(kernel, 1, 12, seed=seed)
        assert first.isfinite().all()


def test_high_dimensions_stay_uncorrelated():
    # unscrambled Halton coordinates 39 and 40 correlate at 0.85 over 199 points
    w = spectral_frequencies("rbf", 199, 40)
    correlation = torch.corrcoef(w.T) - torch.eye(40)
    assert correlation.abs().max() < 0.4


def test_frequencies_follow_their_seed_and_no_global_generator():
    state = torch.random.get_rng_state()
    first, again, other = (spectral_frequencies("matern32", 64, 3, seed=s) for s in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.random.get_rng_state(), state)


def test_fourier_features_are_saved_and_not_trained():
    phi = FourierFeatures(2, frequencies=8, lengthscale=3.0, seed=1)
    assert not list(phi.parameters())
    other = FourierFeatures(2, frequencies=8, seed=2)
    other.load_state_dict(phi.state_dict())
    x = torch.randn(5, 2, generator=generator(0))
    assert torch.equal(phi(x), other(x))
    assert phi(x).shape == (5, phi.out_features) == (5, 16)


@pytest.mark.parametrize("width", [(8,), (8, 4), (5, 5, 5)])
def test_neural_features_have_the_asked_layers_and_train_them_all(width):
    phi = NeuralFeatures(3, widths=width)
    features = phi(torch.randn(6, 2, 3, generator=generator(0)))
    assert features.shape == (6, 2, phi.out_features) == (6, 2, width[-1])
    features.square().sum().backward()
    weights = [p for name, p in phi.named_parameters() if name.endswith("weight")]
    assert [tuple(w.shape) for w in weights] == list(zip(width, (3, *width), strict=False))
    assert all(p.grad.abs().sum() > 0 for p in phi.parameters())


@pytest.mark.parametrize("blocks", [1, 3])
def test_residual_layers_add_to_the_first_and_all_train(blocks):
    phi = ResidualFeatures(3, width=8, blocks=blocks)
    x = torch.randn(6, 2, 3, generator=generator(0))
    features = phi(x)
    assert features.shape == (6, 2, phi.out_features) == (6, 2, 8)
    features.square().sum().backward()
    assert len(list(phi.parameters())) == 2 * (1 + blocks)
    assert all(p.grad.abs().sum() > 0 for p in phi.parameters())
    with torch.no_grad():  # SiLU is 0 at 0: blocks without weights leave the first layer
        for block in phi.blocks:
            block.weight.zero_()
            block.bias.zero_()
        torch.testing.assert_close(phi(x), torch.nn.functional.silu(phi.first(x)))


@pytest.mark.parametrize("sizes", [{"width": 0}, {"blocks": 0}, {"dim": 0}])
def test_residual_features_need_sizes(sizes):
    with pytest.raises(ValueError, match=f"{next(iter(sizes))} to be positive, got 0"):
        ResidualFeatures(**{"dim": 3} | sizes)


@pytest.mark.parametrize("kind", [NeuralFeatures, ResidualFeatures])
def test_networks_follow_their_seed_and_no_global_generator(kind):
    state = torch.random.get_rng_state()
    x = torch.ones(1, 3)
    assert torch.equal(kind(3, seed=4)(x), kind(3, seed=4)(x))
    assert not torch.equal(kind(3, seed=4)(x), kind(3, seed=5)(x))
    assert torch.equal(torch.random.get_rng_state(), state)


def test_an_unknown_kernel_is_refused():
    with pytest.raises(ValueError, match=r"a kernel, got 'matern53'. Available: .*did you mean"):
        FourierFeatures(2, kernel="matern53")
