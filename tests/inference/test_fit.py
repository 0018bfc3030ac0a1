import copy
import math
import random
import warnings

import numpy as np
import pytest
import scipy.stats
import torch
from tensordict import TensorDict

from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.inference.fit import fit, fit_several, select_lengthscale
from torchrl_bayessim.inference.losses import PosteriorLoss
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.inference.usable_pairs import usable_pairs
from torchrl_bayessim.randomness import generator

PRIOR = BoxPrior({"mass": (2.0, 6.0), "friction": (0.01, 1.0)}, log=["friction"])
SENSITIVITY = torch.tensor([[1.0, 0.3, 0.0], [0.6, -0.5, 1.0]])
NOISE = 0.7


def linear_gaussian(n, *, prior=PRIOR, key=0):
    """x = A^T z + e in standardised coordinates, e ~ N(0, NOISE^2 I)."""
    theta = prior.sample((n,), generator=generator("theta", key))
    noise = torch.randn(n, 3, generator=generator("noise", key))
    sensitivity = SENSITIVITY[: len(prior.names)]
    summary = prior.standardize(theta) @ sensitivity + NOISE * noise
    return TensorDict({"theta": theta, "summary": summary}, [n])


def exact_posterior(summary, prior=PRIOR):
    """The Gaussian posterior under a flat prior, restricted to the prior's box."""
    sensitivity = SENSITIVITY[: len(prior.names)].double()
    precision = sensitivity @ sensitivity.mT / NOISE**2
    if prior.box is None:
        precision = precision + torch.eye(len(precision))
    covariance = torch.linalg.inv(precision)
    mean = summary.double() @ sensitivity.mT / NOISE**2 @ covariance
    scale = torch.linalg.cholesky(covariance).expand(*mean.shape, -1)
    return TruncatedGaussianMixture(
        torch.zeros(*mean.shape[:-1], 1),
        mean.unsqueeze(-2),
        scale.unsqueeze(-3),
        prior.box,
        points=2**12,
    )


def posterior(prior=PRIOR, **options):
    return MixtureDensityPosterior(prior, 3, **{"components": 2} | options)


def short_fit(net, data, **options):
    return fit(net, data, **{"epochs": 3, "progress": False} | options)


@pytest.fixture(scope="module", params=["box", "gaussian"])
def fitted(request):
    prior = PRIOR if request.param == "box" else GaussianPrior({"a": (0, 1), "b": (5, 2)})
    net = posterior(prior)
    data = linear_gaussian(3000, prior=prior)
    report = fit(net, data, epochs=40, batch_size=128, lr=5e-3, progress=False)
    return net, prior, report


def test_a_linear_gaussian_posterior_is_recovered(fitted):
    net, prior, _ = fitted
    summary = linear_gaussian(100, prior=prior, key=1)["summary"]
    exact = exact_posterior(summary, prior)
    z = exact.sample((200,), generator=generator(0))
    learned = net.distribution(summary).mixture
    divergence = (exact.log_prob(z) - learned.log_prob(z)).mean(0)
    assert divergence.mean() < 0.05
    assert divergence.max() < 0.4


def test_its_credible_regions_cover_as_often_as_they_say(fitted):
    net, prior, _ = fitted
    truths = linear_gaussian(400, prior=prior, key=2)
    q = net.distribution(truths["summary"])
    draws = q.sample((200,), generator=generator(1))
    rank = (q.log_prob(draws) > q.log_prob(truths["theta"])).float().mean(0)
    for level in (0.5, 0.8, 0.95):
        covered = int((rank <= level).sum())
        low, high = scipy.stats.binom(400, level).ppf([1e-4, 1 - 1e-4])
        assert low <= covered <= high


def test_several_trajectories_together_are_the_exact_pooled_posterior(fitted):
    net, prior, _ = fitted
    z = prior.standardize(prior.mean.double())
    noise = torch.randn(4, 3, generator=generator(2))
    real = z.float() @ SENSITIVITY + NOISE * noise
    q = net.condition(real).mixture
    precision = 4 * SENSITIVITY.double() @ SENSITIVITY.double().mT / NOISE**2
    if prior.box is None:
        precision = precision + torch.eye(2)
    covariance = torch.linalg.inv(precision)
    mean = real.double().sum(0) @ SENSITIVITY.double().mT / NOISE**2 @ covariance
    exact = TruncatedGaussianMixture(
        torch.zeros(1), mean[None], torch.linalg.cholesky(covariance)[None], prior.box
    )
    draws = exact.sample((2000,), generator=generator(3))
    assert (exact.log_prob(draws) - q.log_prob(draws)).mean() < 0.4


def test_the_report_says_what_was_done(fitted):
    _, _, report = fitted
    assert (report.pairs, report.dropped) == (3000, 0)
    assert report.epochs == len(report.train) == len(report.validation) <= 40
    assert report.best == min(report.validation) < report.validation[0]
    assert report.train[-1] < report.train[0]


def test_a_better_fit_has_a_lower_loss_by_as_many_nats():
    """The held-out loss of a good fit is the entropy of the exact posterior, in original units."""
    prior = BoxPrior({"mass": (2.0, 6.0)})
    data = linear_gaussian(1500, prior=prior)
    report = fit(posterior(prior), data, epochs=30, lr=5e-3, progress=False)
    z = prior.standardize(data["theta"])
    volume = prior.standardization.log_abs_det_jacobian(z, data["theta"])
    entropy = (volume - exact_posterior(data["summary"], prior).log_prob(z)).mean().item()
    assert report.best == pytest.approx(entropy, abs=0.15)


def test_divergent_simulations_are_dropped_and_counted():
    """In the first fit as in any other: the result is that of the finite pairs alone."""
    data = linear_gaussian(40)
    data["summary"][3, 1] = torch.nan
    data["summary"][7] = torch.inf
    data["theta"][11, 0] = torch.nan
    net, clean = posterior(), posterior()
    said = "3 of 40 pairs are not finite: left out .*in theta of 1 and summary of 2"
    with pytest.warns(UserWarning, match=said):
        report = short_fit(net, data)
    assert (report.pairs, report.dropped) == (37, 3)
    good = [row for row in range(40) if row not in {3, 7, 11}]
    expected = short_fit(clean, data[good])
    assert report.train == expected.train
    assert report.validation == expected.validation


def test_finite_pairs_give_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        short_fit(posterior(), linear_gaussian(20))


def test_usable_pairs_keeps_what_else_belongs_to_a_pair():
    data = linear_gaussian(5)
    data["weight"] = torch.arange(5.0)
    data["summary"][2] = torch.nan
    with pytest.warns(UserWarning, match="1 of 5 pairs .*NaN or infinity in summary of 1"):
        pairs, dropped = usable_pairs(data)
    assert dropped == 1
    assert pairs["weight"].tolist() == [0, 1, 3, 4]


def test_without_a_finite_simulation_there_is_nothing_to_fit():
    data = linear_gaussian(20)
    data["summary"][:] = torch.nan
    match = "at least one simulation with finite summaries, got '20 diverged simulations of 20: "
    with pytest.raises(SimulationError, match=match):
        short_fit(posterior(), data)


def test_parameters_that_are_not_finite_are_not_blamed_on_simulations():
    data = linear_gaussian(20)
    data["theta"][:, 0] = torch.nan
    with pytest.raises(SimulationError, match=r"parameters in 'theta', got .* theta of 20 of 20"):
        short_fit(posterior(), data)


@pytest.mark.parametrize("options", [{"lr": 0.1, "epochs": 20}, {"epochs": 20, "patience": 2}])
def test_the_parameters_of_the_best_epoch_are_kept(options):
    net, data = posterior(), linear_gaussian(60)
    report = short_fit(net, data, **{"lr": 0.05, "batch_size": 16} | options)
    order = torch.randperm(60, generator=generator(0, "split"))
    assert (net.network.widening > 1.0).all()  # chosen afterwards, of a network alone
    net.network.widening.fill_(1.0)
    with torch.no_grad():
        kept = PosteriorLoss(net)(data[order[:6]])["loss_posterior"].item()
    assert kept == pytest.approx(report.best, abs=2e-4)
    assert report.validation[-1] > report.best + 1e-3  # the last epoch was not the best


def test_it_stops_once_patience_is_spent():
    prior = GaussianPrior({"a": (0, 1), "b": (5, 2)})  # a box would come in after the patience
    net, data = posterior(prior), linear_gaussian(60, prior=prior)
    report = short_fit(net, data, epochs=60, patience=3, lr=0.01, batch_size=16)
    best = report.validation.index(report.best)
    assert report.epochs < 60
    assert report.epochs - best - 1 == 3


@pytest.mark.parametrize("features", ["residual", "neural", "fourier"])
def test_the_same_seed_gives_the_same_fit(features):
    data = linear_gaussian(40)
    nets = [posterior(features=features) for _ in range(3)]
    first, second, other = (
        short_fit(net, data, seed=seed) for net, seed in zip(nets, (5, 5, 6), strict=True)
    )
    assert first == second
    assert first.validation != other.validation
    weights = [net.network.state_dict() for net in nets]
    for name, value in weights[0].items():
        assert torch.equal(value, weights[1][name]), name


def test_the_users_generators_are_untouched():
    def states():
        numpy = np.random.get_state()[1].tolist()  # noqa: NPY002
        return torch.random.get_rng_state().tolist(), random.getstate(), numpy

    before = states()
    net = posterior(features="fourier")
    short_fit(net, linear_gaussian(40))
    select_lengthscale(net, linear_gaussian(40), factors=[1.0], epochs=1, progress=False)
    net.condition(torch.zeros(2, 3))
    assert states() == before


@pytest.mark.filterwarnings("ignore:None of the 3 statistics varies")
def test_weights_choose_among_pairs():
    """Pairs of weight zero are not learned from."""
    prior = BoxPrior({"mass": (2.0, 6.0)})
    theta = torch.cat([torch.full((200, 1), 2.5), torch.full((200, 1), 5.5)])
    weight = torch.cat([torch.ones(200), torch.zeros(200)])
    data = TensorDict({"theta": theta, "summary": torch.zeros(400, 3), "weight": weight}, [400])
    net = posterior(prior)
    fit(net, data, epochs=25, lr=2e-2, progress=False)
    assert net.condition(torch.zeros(3)).mean.item() == pytest.approx(2.5, abs=0.3)


def test_constant_statistics_are_ignored():
    data, widened = linear_gaussian(60), linear_gaussian(60)
    widened["summary"] = torch.cat([data["summary"], torch.full((60, 1), 1e3)], -1)
    net = MixtureDensityPosterior(PRIOR, 4)
    report = short_fit(net, widened)
    assert all(math.isfinite(loss) for loss in report.validation)
    x = torch.cat([data["summary"][:3], torch.tensor([[0.0], [1e3], [-1e9]])], -1)
    x[:, :3] = x[0, :3]
    log_prob = net.distribution(x).log_prob(data["theta"][0])
    assert (log_prob == log_prob[0]).all()


def test_statistics_that_are_all_constant_leave_the_prior():
    data = linear_gaussian(600)
    data["summary"].zero_()
    net = posterior()
    with pytest.warns(UserWarning, match="None of the 3 statistics varies over 600 simulations"):
        fit(net, data, epochs=40, lr=1e-2, progress=False)
    z = PRIOR.standardize(net.condition(torch.zeros(3)).sample((4000,), generator=generator(4)))
    assert z.mean(0).abs().max() < 0.2
    torch.testing.assert_close(z.std(0), torch.ones(2), rtol=0, atol=0.1)


def test_rescaling_is_left_out_on_request():
    data, net = linear_gaussian(40), posterior()
    data["summary"] += 100
    short_fit(net, data, rescale=False)
    assert (net.network.shift == 0).all()
    short_fit(net, data)
    assert (net.network.shift - 100).abs().max() < 1


def test_summaries_of_double_precision_can_be_fitted():
    data = linear_gaussian(40)
    expected = short_fit(posterior(), data).train
    assert short_fit(posterior(), data.double()).train == pytest.approx(expected, abs=1e-3)


def test_select_lengthscale_finds_the_scale_of_the_data():
    prior = BoxPrior({"mass": (2.0, 6.0)})
    data = linear_gaussian(300, prior=prior)
    net = posterior(prior, features="fourier")
    before = copy.deepcopy(dict(net.named_parameters()))
    factors = [0.02, 1.0]
    chosen = select_lengthscale(net, data, factors=factors, epochs=10, progress=False)
    median = torch.pdist(net.network.scaled(data["summary"])).median().item()
    # features far narrower than the distance between summaries cannot generalise
    assert chosen == pytest.approx(median, rel=0.05)
    assert net.network.features.lengthscale.item() == pytest.approx(chosen)
    for name, parameter in net.named_parameters():
        assert torch.equal(parameter, before[name]), name


def test_select_lengthscale_needs_fourier_features():
    with pytest.raises(TypeError, match="a posterior over FourierFeatures, got 'ResidualFeatures'"):
        select_lengthscale(posterior(), linear_gaussian(10))


@pytest.mark.parametrize("value", [1.5, 6.5])
def test_parameters_outside_the_prior_are_refused(value):
    data = linear_gaussian(20)
    data["theta"][4, 0] = value
    match = rf"inside the prior BoxPrior\(mass: .*got '1 outside it, the first \[{value}"
    with pytest.raises(ValueError, match=match):
        short_fit(posterior(), data)


def test_too_few_pairs_are_refused():
    with pytest.raises(ValueError, match=r"at least 4 usable pairs, got 3\. Try: simulate more"):
        short_fit(posterior(), linear_gaussian(3))
    with pytest.raises(TypeError, match=r"pairs in a TensorDict.*got 'dict'"):
        short_fit(posterior(), {"theta": torch.zeros(9, 2), "summary": torch.zeros(9, 3)})


@pytest.mark.parametrize("fraction", [0.0, 1.0, 1.5])
def test_all_or_nothing_cannot_be_held_out(fraction):
    with pytest.raises(ValueError, match="a finite validation_fraction above 0 and below 1"):
        short_fit(posterior(), linear_gaussian(20), validation_fraction=fraction)


@pytest.mark.parametrize("fraction", [0.01, 0.99])
def test_both_parts_of_the_split_hold_a_pair(fraction):
    report = short_fit(posterior(), linear_gaussian(6), validation_fraction=fraction)
    assert math.isfinite(report.best)


@pytest.mark.parametrize(("dims", "size"), [(2, 4), (1, 3)])
def test_pairs_of_other_shapes_are_refused(dims, size):
    data = TensorDict({"theta": torch.zeros(9, dims), "summary": torch.zeros(9, size)}, [9])
    with pytest.raises(ValueError, match=rf"the posterior, \(2, 3\), got \({dims}, {size}\)"):
        short_fit(posterior(), data)


def test_a_loss_that_is_not_finite_is_reported():
    broken = posterior()
    torch.nn.init.constant_(broken.network.head.bias, torch.nan)
    with pytest.raises(SimulationError, match=r"a finite loss, got nan\. Try: a smaller learning"):
        short_fit(broken, linear_gaussian(20))


def test_one_parameter_and_one_statistic_can_be_fitted():
    prior = BoxPrior({"mass": (2.0, 6.0)})
    theta = prior.sample((20,), generator=generator(5))
    data = TensorDict({"theta": theta, "summary": theta + 0.1}, [20])
    net = MixtureDensityPosterior(prior, 1, components=1)
    assert math.isfinite(short_fit(net, data).best)


@pytest.mark.parametrize("weight", [torch.zeros(64), -torch.ones(64), torch.full((64,), torch.nan)])
def test_weights_that_teach_nothing_are_refused(weight):
    prior = BoxPrior({"a": (0.0, 1.0)})
    theta = prior.sample((64,), generator=generator(0))
    data = TensorDict({"theta": theta, "summary": theta, "weight": weight}, [64])
    with pytest.raises(ValueError, match="finite weights of 0 or more"):
        fit(MixtureDensityPosterior(prior, 1), data, progress=False)


@pytest.mark.parametrize("scale", [1.0, 1e-200])
def test_the_epoch_is_chosen_by_pairs_that_count(scale):
    """Six of 400 pairs count, and hardly ever one of the tenth that is held out at random."""
    data = linear_gaussian(400)
    few = torch.zeros(400, dtype=torch.float64)
    few[::75] = scale
    one, other = posterior(), posterior()
    report = short_fit(one, data.clone().set("weight", few))
    assert report.pairs == 6
    assert all(loss != 0 for loss in report.validation)
    same = short_fit(other, data[::75].set("weight", torch.ones(6)))
    assert report.validation == pytest.approx(same.validation)


def test_weights_are_one_for_each_pair():
    data = linear_gaussian(20)
    with pytest.raises(ValueError, match=r"one weight per pair, shape \(20,\), got \(20, 3\)"):
        short_fit(posterior(), data.clone().set("weight", torch.ones(20, 3)))
    column = short_fit(posterior(), data.clone().set("weight", torch.ones(20, 1)))
    assert column == short_fit(posterior(), data.clone().set("weight", torch.ones(20)))


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"lr": "a"}, TypeError, "a finite lr above 0, got 'a'"),
        ({"lr": -1.0}, ValueError, r"a finite lr above 0, got -1\.0"),
        ({"lr": math.inf}, ValueError, "a finite lr above 0, got inf"),
        ({"weight_decay": -1e-3}, ValueError, "a finite weight_decay of at least 0"),
        ({"patience": 0}, ValueError, "patience to be positive, got 0"),
        ({"validation_fraction": None}, TypeError, "above 0 and below 1, got None"),
    ],
)
def test_rates_and_shares_are_numbers(options, error, said):
    with pytest.raises(error, match=said):
        short_fit(posterior(), linear_gaussian(20), **options)


def test_posteriors_on_several_devices_are_refused():
    posteriors = [posterior(), posterior().to("meta")]
    with pytest.raises(ValueError, match=r"on one device.*got 'cpu and meta'\. Try: network\.to"):
        fit_several(posteriors, linear_gaussian(20), seeds=[0, 1])


def test_complex_summaries_are_refused():
    data = linear_gaussian(20)
    data["summary"] = data["summary"].to(torch.complex64)
    with pytest.raises(TypeError, match=r"real numbers in 'summary', got 'torch\.complex64'"):
        short_fit(posterior(), data)


@pytest.mark.parametrize("options", [{"epochs": 0}, {"batch_size": 0}])
def test_epochs_and_batches_are_positive(options):
    (name,) = options
    prior = BoxPrior({"a": (0.0, 1.0)})
    theta = prior.sample((8,), generator=generator(0))
    data = TensorDict({"theta": theta, "summary": theta}, [8])
    with pytest.raises(ValueError, match=f"{name} to be positive, got 0"):
        fit(MixtureDensityPosterior(prior, 1), data, progress=False, **options)


def test_pairs_may_lie_in_rows_and_columns():
    data = linear_gaussian(40)
    data["summary"][[3, 7, 11], 0] = torch.nan
    with pytest.warns(UserWarning, match="3 of 40"):
        expected = short_fit(posterior(), data)
    with pytest.warns(UserWarning, match="3 of 40"):
        report = short_fit(posterior(), data.reshape(8, 5))
    assert report.train == expected.train


def test_counts_are_summaries_and_gradients_of_pairs_are_not_asked_for():
    data = linear_gaussian(40)
    data["summary"] = data["summary"].round()
    expected = short_fit(posterior(), data)
    whole = data.clone().set("summary", data["summary"].long())
    assert short_fit(posterior(), whole).train == expected.train
    grown = TensorDict({k: v.clone().requires_grad_() for k, v in data.items()}, [40])
    assert short_fit(posterior(), grown).train == expected.train
    assert whole["summary"].dtype == torch.long  # the caller's pairs are as they were
    assert all(value.grad is None for value in grown.values())


@pytest.mark.parametrize("key", ["theta", "summary"])
def test_pairs_hold_vectors(key):
    data = linear_gaussian(40)
    with pytest.raises(ValueError, match=rf"vectors in '{key}', shape \(N, size\), got \(40,\)"):
        short_fit(posterior(), data.set(key, data[key][:, 0]))


def test_without_pairs_there_is_nothing_to_fit_either():
    empty = linear_gaussian(4)[:0]
    with pytest.raises(ValueError, match="at least one pair, got 'none'"):
        usable_pairs(empty)
    with pytest.raises(ValueError, match="at least one pair, got 'none'"):
        short_fit(posterior(), empty)


@pytest.mark.parametrize("key", ["theta", "summary"])
def test_pairs_have_both_entries(key):
    with pytest.raises(ValueError, match=f"pairs with an entry, got '{key}'. Available: "):
        short_fit(posterior(), linear_gaussian(50).exclude(key))


def test_a_fit_reads_the_keys_that_the_posterior_was_made_with():
    data = linear_gaussian(60)
    other = data.clone().rename_key_("summary", "x").rename_key_("theta", ("physics", "mass"))
    expected = short_fit(posterior(), data)
    report = short_fit(posterior(in_key="x", out_key=("physics", "mass")), other)
    assert report.train == expected.train
    assert report.validation == expected.validation


def test_a_length_scale_is_selected_under_the_posterior_s_own_keys():
    data = linear_gaussian(60)
    net = posterior(features="fourier")
    renamed = posterior(features="fourier", in_key="x")
    options = {"factors": (0.5, 1.0), "epochs": 2, "progress": False}
    expected = select_lengthscale(net, data, **options)
    assert select_lengthscale(renamed, data.rename_key_("summary", "x"), **options) == expected
