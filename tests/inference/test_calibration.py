import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.calibration import calibrate, calibrate_draws, calibrate_pooled
from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.network import WIDEST
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.randomness import generator

N, DRAWS = 600, 200
NAMES = ("a", "b")


def gaussian_problem(*, width=1.0, shift=0.0, ignore=False, count=N, some=DRAWS):
    """theta ~ N(0, 1), x = theta + N(0, 0.5^2): the posterior is known; here with an error."""
    g = generator("gaussian problem")
    theta = torch.randn(count, 2, generator=g)
    x = theta + 0.5 * torch.randn(count, 2, generator=g)
    precision = 1 + 4.0
    mean, sd = 4 * x / precision + shift, precision**-0.5
    if ignore:
        mean, sd = torch.zeros_like(mean), 1.0
    posterior = torch.distributions.Normal(mean, width * sd)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        draws = posterior.sample((some,))
    log_prob = (posterior.log_prob(theta).sum(-1), posterior.log_prob(draws).sum(-1))
    return calibrate_draws(NAMES, theta, draws, log_prob=log_prob)


def test_the_exact_posterior_passes():
    found = gaussian_problem()
    assert found.passed
    assert found.doubts() == []
    for level in (0.5, 0.9):
        low, high = found.band(level, confidence=0.99)
        assert low < level < high
        for name, share in found.coverage(level).items():
            assert low <= share <= high, name


@pytest.mark.parametrize(("width", "said"), [(0.6, "too sure"), (1.7, "not sure enough")])
def test_a_posterior_of_the_wrong_width_fails(width, said):
    found = gaussian_problem(width=width)
    assert not found.passed
    (doubt,) = found.doubts()
    assert f"the posterior is {said}" in doubt
    low, high = found.band(0.5)
    assert not any(low <= share <= high for share in found.coverage(0.5).values())


def test_a_biased_posterior_shows_in_the_ranks():
    found = gaussian_problem(shift=0.3)
    assert found.p_values()["rank of a"] < 1e-6
    assert not found.passed


def test_a_posterior_that_ignores_the_data_is_calibrated_all_the_same():
    """Which is why nats stand beside coverage."""
    assert gaussian_problem(ignore=True).passed


@pytest.mark.parametrize("some", [2, 10, 50])
def test_few_draws_do_not_make_the_exact_posterior_fail(some):
    found = gaussian_problem(count=2000, some=some).p_values()
    assert min(found.values()) > 1e-3, found


@pytest.mark.parametrize("some", [2, 10, 50])
@pytest.mark.parametrize("wrong", [{"width": 0.6}, {"shift": 0.4}], ids=["narrow", "shifted"])
def test_few_draws_tell_a_wrong_posterior(some, wrong):
    found = gaussian_problem(count=2000, some=some, **wrong)
    assert found.p_values()["distance"] < 1e-3
    assert not found.passed


def test_an_exactly_flat_posterior_passes():
    """All densities are equal: the truth's place among them is anyone's."""
    theta, draws = torch.rand(N, 2), torch.rand(DRAWS, N, 2)
    flat = (torch.zeros(N), torch.zeros(DRAWS, N))
    found = calibrate_draws(NAMES, theta, draws, log_prob=flat)
    assert found.passed, found.p_values()
    assert found.coverage(0.5)["joint"] == pytest.approx(0.5, abs=0.07)


def test_parameters_of_few_values_pass():
    """Ties of ranks, densities and distances, in an exact posterior that takes three values."""
    theta, draws = torch.randint(3, (N, 2)), torch.randint(3, (DRAWS, N, 2))
    log_prob = (-theta.sum(-1).float(), -draws.sum(-1).float())
    found = calibrate_draws(NAMES, theta, draws, log_prob=log_prob)
    assert found.passed, found.p_values()


def test_one_tie_is_shared_evenly():
    """Of three draws one is below and two are equal: places 1 to 3 of 0 to 3, all as likely."""
    theta, draws = torch.ones(4000, 1), torch.tensor([0.0, 1.0, 1.0]).reshape(3, 1, 1)
    flat = (torch.zeros(4000), torch.zeros(3, 4000))
    rank = calibrate_draws(("a",), theta, draws.expand(3, 4000, 1), log_prob=flat).rank
    counts = (4 * rank).long().flatten().bincount(minlength=4)
    assert counts[0] == 0
    assert counts[1:].tolist() == pytest.approx([4000 / 3] * 3, abs=120)


def test_the_band_is_the_binomial_s():
    low, high = gaussian_problem().band(0.9)
    assert low == pytest.approx(0.9 - 1.96 * (0.9 * 0.1 / N) ** 0.5, abs=0.004)
    assert high == pytest.approx(0.9 + 1.96 * (0.9 * 0.1 / N) ** 0.5, abs=0.004)


def linear_pairs(prior, count, key):
    g = generator(key)
    theta = prior.sample((count,), generator=g)
    noise = torch.tensor([0.1, 0.4]) * torch.randn(count, 2, generator=g)
    return TensorDict({"theta": theta, "summary": theta + noise}, [count])


@pytest.mark.parametrize(
    "prior",
    [BoxPrior({"a": (0.0, 1.0), "b": (-1.0, 1.0)}), GaussianPrior({"a": (0, 1), "b": (0, 1)})],
    ids=["box", "gaussian"],
)
def test_a_network_fitted_to_enough_pairs_passes(prior):
    posterior = MixtureDensityPosterior(prior, 2)
    fit(posterior, linear_pairs(prior, 2000, "train"), epochs=20, progress=False)
    found = calibrate(posterior, linear_pairs(prior, 400, "test"), draws=100)
    assert found.passed, found.p_values()


def test_a_network_whose_deviations_are_too_small_fails():
    prior = BoxPrior({"a": (0.0, 1.0), "b": (-1.0, 1.0)})
    posterior = MixtureDensityPosterior(prior, 2, components=1)
    fit(posterior, linear_pairs(prior, 500, "train"), epochs=15, progress=False)
    variances = slice(3, 5)
    with torch.no_grad():
        posterior.network.head.bias[variances] -= 2.0
    found = calibrate(posterior, linear_pairs(prior, 200, "test"), draws=100)
    assert not found.passed
    assert "too sure" in found.doubts()[0]


def test_the_same_seed_gives_the_same_shares():
    prior = BoxPrior({"a": (0.0, 1.0), "b": (-1.0, 1.0)})
    posterior, pairs = MixtureDensityPosterior(prior, 2), linear_pairs(prior, 70, "test")
    before = torch.random.get_rng_state()
    first, again = (calibrate(posterior, pairs, draws=20) for _ in range(2))
    assert torch.equal(first.rank, again.rank)
    assert torch.equal(first.density, again.density)
    assert torch.equal(first.distance, again.distance)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert first.rank.shape == (70, 2)


@pytest.mark.parametrize(
    ("summary", "theta"), [("observation", "physics"), (("sim", "x"), ("sim", "theta"))]
)
def test_a_network_of_other_keys_is_calibrated_by_them(summary, theta):
    prior = BoxPrior({"a": (0.0, 1.0), "b": (-1.0, 1.0)})
    pairs = linear_pairs(prior, 70, "test")
    renamed = TensorDict(batch_size=[70])
    renamed[summary], renamed[theta] = pairs["summary"], pairs["theta"]
    network = MixtureDensityPosterior(prior, 2, in_key=summary, out_key=theta)
    found = calibrate(network, renamed, draws=20)
    same = calibrate(MixtureDensityPosterior(prior, 2), pairs, draws=20)
    assert torch.equal(found.rank, same.rank)
    assert torch.equal(found.density, same.density)


@pytest.mark.parametrize("key", ["theta", "summary"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_held_out_pairs_that_are_not_finite_are_refused(key, value):
    prior = BoxPrior({"a": (0.0, 1.0), "b": (-1.0, 1.0)})
    pairs = linear_pairs(prior, 70, "test")
    pairs[key][3, 1] = value
    with pytest.raises(ValueError, match=rf"finite held-out pairs, got .*'{key}' of 1 of 70"):
        calibrate(MixtureDensityPosterior(prior, 2), pairs, draws=20)


@pytest.mark.parametrize("key", ["theta", "summary"])
def test_held_out_pairs_without_an_entry_are_refused(key):
    prior = BoxPrior({"a": (0.0, 1.0), "b": (-1.0, 1.0)})
    pairs = linear_pairs(prior, 70, "test").exclude(key)
    (left,) = pairs.keys()
    with pytest.raises(
        ValueError, match=f"held-out pairs with an entry, got '{key}'. Available: {left}"
    ):
        calibrate(MixtureDensityPosterior(prior, 2), pairs, draws=20)


def test_no_held_out_pairs_are_refused():
    prior = BoxPrior({"a": (0.0, 1.0), "b": (-1.0, 1.0)})
    with pytest.raises(ValueError, match="at least one held-out pair, got 'none'"):
        calibrate(MixtureDensityPosterior(prior, 2), linear_pairs(prior, 70, "test")[:0])


def test_draws_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"draws of shape .* got \(5, 3, 2\)"):
        calibrate_draws(
            NAMES,
            torch.zeros(4, 2),
            torch.zeros(5, 3, 2),
            log_prob=(torch.zeros(4), torch.zeros(5, 4)),
        )


def that_says(deviation):
    """Return a network that answers N(0, deviation^2) to every summary, under a prior N(0, 1)."""
    network = MixtureDensityPosterior(GaussianPrior({"a": (0.0, 1.0)}), 1, components=1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        free = WIDEST * math.atanh(deviation / WIDEST)
        network.network.head.bias[2] = 2 * math.log(free) if free < 1 else free**2 - 1
    return network


def test_a_product_of_answers_may_be_too_sure_where_each_is_not(monkeypatch):
    theta = torch.randn(60, 1, generator=generator("truths"))
    nothing = torch.zeros(60, 20, 1)
    assert calibrate_pooled(that_says(1.0), theta, nothing).passed
    pairs = TensorDict({"theta": theta, "summary": nothing[:, 0]}, [60])
    assert calibrate(that_says(0.9), pairs).passed
    # answers that are all the same are not taken for twenty
    assert calibrate_pooled(that_says(0.9), theta, nothing).passed
    independent = lambda *_, **__: torch.ones(1).double()
    monkeypatch.setattr("torchrl_bayessim.inference.posterior.design_effect", independent)
    pooled = calibrate_pooled(that_says(0.9), theta, nothing)
    # of twenty answers the variance is 1 / (1 + 20 (1 / 0.81 - 1))
    assert pooled.coverage(0.9)["joint"] == pytest.approx(0.51, abs=0.13)
    assert not pooled.passed
    assert "the answer is too sure, or biased: of 60 known" in pooled.doubts(what="the answer")[0]


def test_groups_of_another_number_are_refused():
    with pytest.raises(ValueError, match=r"shape \(N, n, L\) for truths of shape \(3, 1\), got"):
        calibrate_pooled(that_says(1.0), torch.zeros(3, 1), torch.zeros(2, 4, 1))
