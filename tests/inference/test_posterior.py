import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_bayessim.inference.features import Features, NeuralFeatures
from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.mixtures import moment_match
from torchrl_bayessim.inference.network import melu
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.randomness import generator

LINEAR = {"mass": (200.0, 600.0)}
LOGARITHMIC = {"damping": (0.01, 1.0)}
ONE = {
    "linear": BoxPrior(LINEAR),
    "logarithmic": BoxPrior(LOGARITHMIC, log=["damping"]),
    "gaussian": GaussianPrior({"mass": (400.0, 50.0)}),
}
TWO = {
    "box": BoxPrior(LINEAR | LOGARITHMIC, log=["damping"]),
    "gaussian": GaussianPrior(
        {"mass": (400.0, 50.0), "offset": (0.0, 0.01)},
        correlation=torch.tensor([[1.0, 0.8], [0.8, 1.0]]),
    ),
}


def summaries(*shape, key=0):
    return torch.randn(*shape, generator=generator("summaries", key))


def posterior(prior=TWO["box"], dim=5, **options):
    return MixtureDensityPosterior(prior, dim, **options)


def ends(prior):
    if prior.box is None:
        half = 8 * prior.variance.sqrt().double()
        return prior.mean.double() - half, prior.mean.double() + half
    return prior.low.double(), prior.high.double()


def midpoints(low, high, points):
    axis = torch.linspace(0, 1, points + 1, dtype=torch.float64)
    return low + (axis[1:] + axis[:-1]) / 2 * (high - low), (high - low) / points


def test_weights_of_other_summaries_are_refused():
    prior = BoxPrior({"mass": (2.0, 6.0)})
    state = MixtureDensityPosterior(prior, 3).state_dict()
    MixtureDensityPosterior(prior, 3).load_state_dict(state)
    with pytest.raises(ValueError, match="fitted with compress=False, got 'compress=True'"):
        MixtureDensityPosterior(prior, 3, compress=False).load_state_dict(state)


@pytest.mark.parametrize("name", ONE)
def test_densities_in_original_units_integrate_to_one(name):
    prior = ONE[name]
    q = posterior(prior).distribution(summaries(5))
    axis, step = midpoints(*(end[0] for end in ends(prior)), 20_000)
    assert (q.log_prob(axis[:, None]).double().exp().sum() * step).item() == pytest.approx(1, 1e-4)


@pytest.mark.parametrize("name", TWO)
@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_joint_densities_in_original_units_integrate_to_one(name, covariance):
    prior = TWO[name]
    q = posterior(prior, covariance=covariance, seed=3).distribution(summaries(5))
    (first, second), steps = zip(
        *(midpoints(low, high, 600) for low, high in zip(*ends(prior), strict=True)), strict=True
    )
    density = q.log_prob(torch.cartesian_prod(first, second)).double().exp()
    assert (density.sum() * steps[0] * steps[1]).item() == pytest.approx(1, abs=5e-3)


@pytest.mark.parametrize("prior", [*ONE.values(), *TWO.values()])
def test_a_posterior_equal_to_the_prior_has_the_density_of_the_prior(prior):
    """What an unidentifiable parameter must score: a gain of exactly nothing."""
    dim = len(prior.names)
    flat = torch.eye(dim, dtype=torch.float64)[None] * (1.0 if prior.box is None else 1e5)
    same = TruncatedGaussianMixture(
        torch.zeros(1), torch.zeros(1, dim), flat, prior.box, diagonal=True
    )
    theta = prior.sample((50,), generator=generator(0)).double()
    got = PhysicsPosterior(same, prior).log_prob(theta)
    torch.testing.assert_close(got, prior.log_prob(theta).float(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "theta", [[199.0, 0.1], [601.0, 0.1], [400.0, 0.009], [400.0, 0.0], [400.0, -1.0]]
)
def test_nothing_leaks_outside_the_prior(theta):
    q = posterior().distribution(summaries(5))
    assert q.log_prob(torch.tensor(theta)) == -torch.inf


@pytest.mark.parametrize("name", TWO)
def test_draws_lie_in_the_support_and_have_the_stated_moments(name):
    q = posterior(TWO[name], seed=1).distribution(summaries(5))
    draws = q.sample((20_000,), generator=generator(1))
    assert q.prior.contains(draws).all()
    error = draws.std(0) / len(draws) ** 0.5
    assert ((draws.mean(0) - q.mean).abs() < 5 * error).all()
    torch.testing.assert_close(draws.std(0), q.stddev, rtol=0.02, atol=0)


def test_the_network_yields_variances_and_not_deviations():
    network = posterior(covariance="diagonal", components=2).network
    with torch.no_grad():
        network.head.weight.zero_()
        network.head.bias.split(network.sizes)[2].copy_(torch.tensor([-4.0, -2.0, -6.0, -3.0]))
    covariance = network(summaries(5)).covariance
    expected = torch.tensor([[-4.0, -2.0], [-6.0, -3.0]]).exp()
    torch.testing.assert_close(covariance, torch.diag_embed(expected), rtol=1e-2, atol=0)


def test_melu_is_a_variance_without_cancellation():
    z = torch.linspace(-80, 20, 2001, requires_grad=True)
    assert (melu(z) > 0).all()
    below = torch.tensor([-17.0, -10.0, -1.0])  # elu(z) + 1 is exactly 0 at -17
    torch.testing.assert_close(melu(below), below.exp() + 1e-8)
    torch.testing.assert_close(melu(torch.tensor([0.0, 3.0])), torch.tensor([1.0, 4.0]))
    melu(z).sum().backward()
    assert ((z.grad >= 0) & (z.grad <= 1)).all()
    at_zero = torch.tensor([-1e-6, 1e-6], requires_grad=True)
    melu(at_zero).sum().backward()
    torch.testing.assert_close(at_zero.grad, torch.ones(2))


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_covariances_have_the_asked_structure(covariance):
    net = posterior(covariance=covariance).network
    mixture = net(summaries(7, 5))
    off_diagonal = mixture.covariance[..., 1, 0]
    assert (off_diagonal != 0).all() if covariance == "full" else (off_diagonal == 0).all()
    assert (torch.linalg.eigvalsh(mixture.covariance.double()) > 0).all()


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_extreme_summaries_give_finite_densities(covariance):
    q = posterior(covariance=covariance).distribution(
        torch.tensor([[1e8], [-1e30]]) * torch.ones(5)
    )
    theta = TWO["box"].sample((30, 2), generator=generator(2))
    assert q.log_prob(theta).isfinite().all()
    assert TWO["box"].contains(q.sample((30,), generator=generator(3))).all()


@pytest.mark.parametrize("features", ["residual", "neural", "fourier"])
def test_prediction_is_deterministic(features):
    net, x = posterior(features=features), summaries(7, 5)
    theta = TWO["box"].sample((7,), generator=generator(4))
    state = torch.random.get_rng_state()
    first, second = net.train().distribution(x), net.eval().distribution(x)
    assert torch.equal(first.log_prob(theta), second.log_prob(theta))
    twin = posterior(features=features)
    assert torch.equal(twin.distribution(x).log_prob(theta), first.log_prob(theta))
    other = posterior(features=features, seed=1)
    assert not torch.equal(other.distribution(x).log_prob(theta), first.log_prob(theta))
    assert torch.equal(torch.random.get_rng_state(), state)


@pytest.mark.parametrize("copied", ["state", "deepcopy", "pickle"])
def test_copies_predict_the_same(copied):
    net, x = posterior(features="fourier"), summaries(7, 5)
    net.network.standardize_inputs(3 * summaries(20, 5, key=1))
    if copied == "state":
        twin = posterior(features="fourier", seed=1)
        twin.load_state_dict(net.state_dict())
    else:
        twin = copy.deepcopy(net) if copied == "deepcopy" else pickle.loads(pickle.dumps(net))
    theta = TWO["box"].sample((7,), generator=generator(5))
    assert torch.equal(twin.distribution(x).log_prob(theta), net.distribution(x).log_prob(theta))


def test_as_a_tensordict_module_it_writes_parameters_and_their_log_density():
    net = posterior()
    data = net(TensorDict({"summary": summaries(4, 3, 5)}, [4, 3]))
    assert TWO["box"].contains(data["theta"]).all()
    expected = net.get_dist(data).log_prob(data["theta"])
    torch.testing.assert_close(data["theta_log_prob"], expected)


def test_without_exploration_it_writes_the_mean():
    net, x = posterior(), summaries(4, 5)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        theta = net(TensorDict({"summary": x}, [4]))["theta"]
    torch.testing.assert_close(theta, net.distribution(x).mean, rtol=1e-3, atol=0)


def test_keys_can_be_chosen():
    net = posterior(in_key=("real", "x"), out_key="phi")
    data = net(TensorDict({"real": {"x": summaries(4, 5)}}, [4]))
    assert data["phi"].shape == (4, 2)
    assert data["phi_log_prob"].shape == (4,)


@pytest.mark.parametrize("pooling", ["product", "mean"])
@pytest.mark.parametrize("covariance", ["diagonal", "full"])
@pytest.mark.parametrize("prior", ONE.values(), ids=ONE)
def test_one_parameter_and_one_trajectory_keep_their_axes(prior, covariance, pooling):
    net = posterior(prior, dim=1, covariance=covariance, components=1)
    for x in (summaries(1), summaries(1, 1), summaries(3, 1)):
        q = net.condition(x, pooling=pooling)
        assert (q.batch_shape, q.event_shape) == ((), (1,))
        assert q.sample().shape == q.mean.shape == q.stddev.shape == (1,)
        assert q.sample((4,)).shape == (4, 1)
        assert q.log_prob(q.sample((4,))).shape == (4,)


def test_one_trajectory_is_its_own_pool():
    net, x = posterior(), summaries(5)
    theta = TWO["box"].sample((20,), generator=generator(6))
    expected = net.distribution(x)
    # reweighting by masses and back is all that happens, the many-point mass twice
    torch.testing.assert_close(net.condition(x).log_prob(theta), expected.log_prob(theta))


def test_pooling_by_the_mean_is_the_posterior_of_the_mean_summary():
    net, x = posterior(), summaries(6, 5)
    theta = TWO["box"].sample((20,), generator=generator(7))
    got = net.condition(x, pooling="mean").log_prob(theta)
    torch.testing.assert_close(got, net.distribution(x.mean(0)).log_prob(theta).detach())


def test_summaries_of_double_precision_are_accepted():
    net, x = posterior(), summaries(3, 5)
    theta = TWO["box"].sample((20,), generator=generator(8))
    for other in (x.double(), x.double().numpy(), x.tolist()):
        torch.testing.assert_close(
            net.condition(other).log_prob(theta), net.condition(x).log_prob(theta)
        )


@pytest.mark.parametrize("value", [7.0, 0.0, -1e6])
def test_constant_statistics_are_ignored(value):
    net = posterior()
    training = summaries(50, 5)
    training[:, 2] = value
    net.network.standardize_inputs(training)
    x = summaries(3, 5, key=1)
    surprised = x.clone()
    surprised[:, 2] = 1e9  # a sensor that never moved in simulation says nothing
    theta = TWO["box"].sample((3,), generator=generator(9))
    got = net.distribution(surprised).log_prob(theta)
    assert torch.equal(got, net.distribution(x).log_prob(theta))
    assert got.isfinite().all()


def test_inputs_are_standardised_by_training_summaries():
    net = posterior().network
    training = 1e3 + 10 * summaries(4000, 5)
    net.standardize_inputs(training)
    scaled = 3 * (net.scaled(training) / 3).sinh()
    torch.testing.assert_close(scaled.mean(0), torch.zeros(5), rtol=0, atol=1e-3)
    torch.testing.assert_close(scaled.std(0), torch.ones(5), rtol=1e-3, atol=0)


def test_features_of_ones_own_are_used():
    class Squares(Features):
        dim, out_features = 5, 5

        def forward(self, x):
            return x.square()

    net, x = posterior(features=Squares()), summaries(3, 5)
    theta = TWO["box"].sample((3,), generator=generator(10))
    first, second = (net.distribution(sign * x).log_prob(theta) for sign in (1, -1))
    assert torch.equal(first, second)


def test_means_start_apart_and_within_the_prior():
    mixture = posterior(components=8).network(torch.zeros(5))
    distance = torch.pdist(mixture.loc)
    assert distance.min() > 0.1
    assert mixture.loc.abs().max() < 3**0.5
    mean, covariance = moment_match(mixture)
    assert mean.abs().max() < 0.5
    assert (covariance.diagonal() > 0.5).all()


@pytest.mark.parametrize(
    ("real", "match"),
    [
        (torch.zeros(0, 5), r"shape \(n, 5\), got \(0, 5\)"),
        (torch.zeros(0), r"shape \(n, 5\), got \(0,\)"),
        (torch.zeros(2, 3, 5), r"shape \(n, 5\), got \(2, 3, 5\)"),
        (torch.zeros(3, 4), r"shape \(n, 5\), got \(3, 4\)"),
        (torch.zeros(4), r"shape \(n, 5\), got \(4,\)"),
        (torch.tensor([[0.0] * 5, [torch.nan] * 5]), r"rows \[1\]'. Try: drop these trajectories"),
        (torch.tensor([torch.inf, 0.0, 0.0, 0.0, 0.0]), r"NaN or infinity in rows \[0\]"),
    ],
)
@pytest.mark.parametrize("pooling", ["product", "mean"])
def test_unusable_real_summaries_are_refused(real, match, pooling):
    with pytest.raises(ValueError, match=match):
        posterior().condition(real, pooling=pooling)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"covariance": "fulll"}, r"a covariance structure, got 'fulll'. .* full \(did you"),
        ({"features": "fouier"}, r"name of a feature map, got 'fouier'. Available: fourier"),
    ],
)
def test_unknown_options_are_refused(options, match):
    with pytest.raises(ValueError, match=match):
        posterior(**options)


def test_a_prior_without_names_is_refused():
    with pytest.raises(TypeError, match=r"a prior with named parameters, got 'dict'\. Try: Box"):
        MixtureDensityPosterior({"mass": (0.0, 1.0)}, 5)


def test_summaries_of_the_wrong_length_are_refused():
    with pytest.raises(ValueError, match=r"summaries of shape \(\*, 5\), got \(3, 4\)"):
        posterior().distribution(torch.zeros(3, 4))


def test_an_unknown_pooling_is_refused():
    with pytest.raises(ValueError, match=r"a pooling, got 'produkt'. Available: product \(did"):
        posterior().condition(torch.zeros(2, 5), pooling="produkt")


def test_it_shows_its_prior():
    assert "mass: [200, 600]" in repr(posterior())


@pytest.mark.parametrize("features", ["fourier", "neural"])
def test_paper_mode_learns_and_keeps_to_the_support(features):
    prior = BoxPrior({"a": (0.0, 1.0)})
    theta = prior.sample((256,), generator=torch.Generator().manual_seed(0))
    data = TensorDict({"theta": theta, "summary": torch.cat([theta, theta**2], -1)}, [256])
    posterior = MixtureDensityPosterior.paper_mode(prior, 2, features=features)
    report = fit(posterior, data, epochs=40, progress=False)
    assert report.best < -1.0  # the prior's is 0
    q = posterior.condition(data["summary"][:4], pooling="mean", check=False)
    assert prior.contains(q.sample((100,))).all()


@pytest.mark.parametrize("given", ["a", None, [[1.0, 2.0], [1.0]]])
def test_summaries_are_numbers(given):
    with pytest.raises(TypeError, match=r"real trajectories, numbers of shape \(n, 2\), got"):
        posterior(ONE["linear"], dim=2).condition(given)


def test_features_are_of_summaries_of_the_given_size():
    with pytest.raises(ValueError, match="features of summaries of size 3, got 'of size 2'"):
        MixtureDensityPosterior(ONE["linear"], 3, features=NeuralFeatures(2))


def test_paper_mode_knows_its_feature_maps():
    with pytest.raises(ValueError, match="the name of a feature map"):
        MixtureDensityPosterior.paper_mode(BoxPrior({"a": (0.0, 1.0)}), 2, features="rff")


def fitted(prior):
    found = posterior(prior, dim=2)
    theta = prior.sample((300,), generator=generator("fitted"))
    pairs = TensorDict({"theta": theta, "summary": theta[:, :1] / 400 + summaries(300, 2)}, [300])
    fit(found, pairs, epochs=1, progress=False)
    return found


@pytest.mark.filterwarnings("ignore:.* of the posterior of 'mass' lie at the")  # so far out, any
def test_a_loaded_posterior_is_the_saved_one_and_warns_as_it_did(tmp_path):
    saved, loaded = fitted(ONE["linear"]), posterior(ONE["linear"], dim=2, seed=9)
    torch.save(saved.state_dict(), tmp_path / "posterior.pt")
    loaded.load_state_dict(torch.load(tmp_path / "posterior.pt", weights_only=True))
    near, theta = summaries(1, 2), ONE["linear"].sample((5,))
    densities = [each.condition(near).log_prob(theta) for each in (saved, loaded)]
    assert torch.equal(*densities)
    with pytest.warns(UserWarning, match="1 of 1 real summaries lie as far out") as warned:
        loaded.condition(near + 100)
    assert warned[0].filename == __file__  # not in torch


@pytest.mark.parametrize(
    "other",
    [
        BoxPrior({"mass": (200.0, 601.0)}),
        BoxPrior({"mass": (200.0, 600.0)}, log=["mass"]),
        BoxPrior({"weight": (200.0, 600.0)}),
        BoxPrior({"mass": (200.0, 600.0001)}),
        GaussianPrior({"mass": (400.0, 50.0)}),
    ],
    ids=repr,
)
def test_weights_of_another_prior_are_refused(other):
    with pytest.raises(ValueError, match=r"weights fitted under .*Try: a posterior over the prior"):
        posterior(other, dim=2).load_state_dict(posterior(ONE["linear"], dim=2).state_dict())


@pytest.mark.parametrize("name", TWO)
def test_a_moved_posterior_computes_where_it_is(name):
    """The meta device refuses every operation with a tensor that was left behind."""
    moved = posterior(TWO[name], covariance="diagonal").to("meta")
    q = moved.distribution(torch.zeros(3, 5, device="meta"))
    theta = q.sample((4,))
    assert theta.shape == (4, 3, 2)
    for found in (theta, q.log_prob(theta), q.mean, q.variance):
        assert found.device.type == "meta"
    q.log_prob(theta).sum().backward()


def test_a_posterior_in_double_precision_gives_the_same():
    q, double = posterior(seed=1), posterior(seed=1).double()
    real, theta = summaries(2, 5), TWO["box"].sample((4,))
    torch.testing.assert_close(
        double.condition(real.double()).log_prob(theta),
        q.condition(real).log_prob(theta),
        rtol=1e-3,
        atol=1e-3,
    )
