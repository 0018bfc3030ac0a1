import pickle

import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.descent import descend
from torchrl_bayessim.inference.features import Features, FourierFeatures, NeuralFeatures
from torchrl_bayessim.inference.fit import fit, fit_several
from torchrl_bayessim.inference.losses import PosteriorLoss
from torchrl_bayessim.inference.network import widened
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.stacked import StackedNetworks, alike
from torchrl_bayessim.inference.steps import _fused_adamw
from torchrl_bayessim.randomness import generator

PRIOR = BoxPrior({"a": (0.0, 1.0), "b": (0.1, 2.0)})
OPTIONS = {"epochs": 4, "progress": False}


def pairs(count=300):
    theta = PRIOR.sample((count,), generator=generator("theta"))
    noise = 0.3 * torch.randn(count, 2, generator=generator("noise"))
    return TensorDict({"theta": theta, "summary": theta + noise}, [count])


def posteriors(**options):
    return [MixtureDensityPosterior(PRIOR, 2, seed=seed, **options) for seed in (0, 1, 2)]


@pytest.mark.parametrize("covariance", ["full", "diagonal"])
@pytest.mark.parametrize("features", ["residual", "neural", "fourier"])
@pytest.mark.parametrize("on_disk", [False, True])
def test_networks_fitted_at_once_are_those_fitted_one_by_one(
    covariance, features, on_disk, tmp_path
):
    data = pairs().memmap_(tmp_path) if on_disk else pairs()
    options = {"covariance": covariance, "features": features}
    together, apart = posteriors(**options), posteriors(**options)
    reports = fit_several(together, data, seeds=[5, 6, 7], **OPTIONS)
    for one, other, report, seed in zip(together, apart, reports, (5, 6, 7), strict=True):
        alone = fit(other, data, seed=seed, split_seed=5, **OPTIONS)
        assert report.validation == pytest.approx(alone.validation, abs=1e-4)
        x = torch.tensor([[0.4, 0.7], [0.9, 0.2]])
        theta = torch.tensor([[0.3, 0.6], [0.8, 0.5]])
        got, expected = (p.distribution(x).log_prob(theta) for p in (one, other))
        torch.testing.assert_close(got, expected, atol=2e-3, rtol=2e-3)


def gradients_of(stacked, networks):
    """Yield the gradient of all parameters of each network, by hand and by autograd."""
    for row, network in zip(stacked.gradient, networks, strict=True):
        yield row, torch.cat([parameter.grad.flatten() for parameter in network.parameters()])


@pytest.mark.parametrize("features", ["residual", "neural"])
def test_gradients_by_hand_are_those_of_autograd(features):
    networks = [posterior.network for posterior in posteriors(features=features)]
    x = torch.randn(3, 8, 2, generator=generator("x"))
    stacked = StackedNetworks(networks)
    raw = stacked.raw(x)
    upstream = torch.randn(raw.shape, generator=generator("upstream"))
    stacked.backpropagate(upstream)
    for network, own, values, gradient in zip(networks, x, raw, upstream, strict=True):
        expected = network.raw(own)
        torch.testing.assert_close(values, expected)
        expected.backward(gradient)
    for got, expected in gradients_of(stacked, networks):
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)


def test_the_gradient_of_each_network_is_clipped_by_itself():
    networks = [posterior.network for posterior in posteriors()[:2]]
    x = torch.randn(2, 8, 2, generator=generator("x"))
    stacked = StackedNetworks(networks)
    upstream = torch.ones_like(stacked.raw(x)) * torch.tensor([1e2, 1e-4]).view(2, 1, 1)
    stacked.backpropagate(upstream)
    stacked.clip_gradients(0.5)
    norms = []
    for network, own, gradient in zip(networks, x, upstream, strict=True):
        network.raw(own).backward(gradient)
        norms.append(torch.nn.utils.clip_grad_norm_(network.parameters(), 0.5))
    assert norms[0] > 0.5 > norms[1]
    for got, expected in gradients_of(stacked, networks):
        torch.testing.assert_close(got, expected, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("frozen", ["head", "features.first"])
def test_frozen_layers_stay_as_they_are(frozen):
    nets = posteriors()
    for net in nets:
        net.network.get_submodule(frozen).requires_grad_(False)
    before = [net.network.get_submodule(frozen).weight.clone() for net in nets]
    fit_several(nets, pairs(), seeds=[5, 6, 7], **OPTIONS)
    for net, weight in zip(nets, before, strict=True):
        assert torch.equal(net.network.get_submodule(frozen).weight, weight)


class Normalised(Features):
    """Features of someone's own, which learn besides by no gradient."""

    def __init__(self):
        super().__init__()
        self.dim, self.out_features, self.norm = 2, 2, torch.nn.BatchNorm1d(2)

    def forward(self, x):
        return self.norm(x)


def test_features_of_ones_own_keep_what_they_had_learned_at_the_best_epoch():
    features = Normalised()
    net = MixtureDensityPosterior(PRIOR, 2, features=features)
    report = fit(net, pairs(60), epochs=40, lr=0.1, progress=False)
    best = min(range(report.epochs), key=report.validation.__getitem__)
    assert 0 < best < report.epochs - 1
    # one step and one look at the held-out pairs an epoch, one to choose how wide it is to be, and
    # one at what near pairs share
    assert features.norm.num_batches_tracked == 2 * (best + 1) + 2


class Doubled(Features):
    """Features of someone's own that calculate in double precision."""

    def __init__(self):
        super().__init__()
        self.dim, self.out_features = 2, 4
        self.weight = torch.nn.Parameter(torch.ones(4, 2, dtype=torch.float64).T)

    def forward(self, x):
        self.last = (x.double() @ self.weight).float()
        return self.last


def test_features_of_ones_own_may_be_of_any_make():
    nets = posteriors(features=Doubled())
    fit(nets[0], pairs(), **OPTIONS)
    before = nets[0].network.features.weight.clone()
    fit(nets[0], pairs(), **OPTIONS)
    assert nets[0].network.features.weight.ne(before).any()


def test_only_networks_that_differ_in_parameters_alone_are_stacked():
    first, second, third = (posterior.network for posterior in posteriors())
    assert alike([first, second, third])
    diagonal = posteriors(covariance="diagonal")[0].network
    fewer = posteriors(components=2)[0].network
    plain = posteriors(compress=False)[0].network
    narrow = posteriors(features=NeuralFeatures(2, widths=(8,)))[0].network
    for other in (diagonal, fewer, plain, narrow):
        assert not alike([first, other])
    other, again = posteriors()[:2]
    other.network.features.blocks[0] = torch.nn.Sequential(torch.nn.Tanh())
    assert not alike([first, other.network])
    again.network.head.register_forward_hook(lambda *_: None)
    assert not alike([first, again.network])
    curved = [posterior.network for posterior in posteriors(features="neural")]
    assert alike(curved)
    for network in curved:
        network.features.layers[1] = torch.nn.Tanh()
    assert not alike(curved)
    unbiased = posteriors()[0].network
    unbiased.head = torch.nn.Linear(96, sum(unbiased.sizes), bias=False)
    assert not alike([unbiased])
    assert not alike([first, first])
    assert not alike([first, posteriors()[0].network.double()])
    fourier = posteriors(features=FourierFeatures(2))
    assert not alike([fourier[0].network, fourier[1].network])
    third.shift.fill_(1.0)
    assert not alike([first, third])


@pytest.mark.parametrize("features", ["residual", "neural"])
def test_layers_that_are_one_are_not_trained_as_several(features):
    options = {"features": NeuralFeatures(2, widths=(8, 8, 8))} if features == "neural" else {}
    net = posteriors(**options)[0]
    layers = net.network.features.layers if options else net.network.features.blocks
    assert alike([net.network])
    layers[-2 if options else 1] = layers[2 if options else 0]
    assert not alike([net.network])
    report = fit(net, pairs(), **OPTIONS)
    net.network.widening.fill_(1.0)
    assert net.held_out is not None
    loss = PosteriorLoss(net)(net.held_out)["loss_posterior"].item()
    assert loss == pytest.approx(report.best, abs=1e-4)


@pytest.mark.parametrize(
    "hook",
    [
        lambda network, found: network.head.register_full_backward_pre_hook(
            lambda *_: found.append(1)
        ),
        lambda network, found: network.head.bias.register_hook(lambda _: found.append(1)),
        lambda network, found: network.head.bias.register_post_accumulate_grad_hook(
            lambda _: found.append(1)
        ),
    ],
)
def test_who_waits_for_a_backward_pass_sees_it(hook):
    net, found = posteriors()[0], []
    hook(net.network, found)
    fit(net, pairs(60), **OPTIONS)
    assert len(found) == OPTIONS["epochs"]


def test_parameters_stay_where_they_are():
    nets = posteriors()
    before = [[p.data_ptr() for p in net.parameters()] for net in nets]
    fit_several(nets, pairs(), seeds=[1, 2, 3], **OPTIONS)
    assert [[p.data_ptr() for p in net.parameters()] for net in nets] == before


class Written(Features):
    """One linear map, written so that its gradient comes in another layout, or from two places."""

    def __init__(self, form):
        super().__init__()
        self.dim, self.out_features, self.form = 2, 6, form
        draw = torch.randn(6, 2, generator=generator("written"))
        parts = [draw, torch.zeros(6, 2)]
        self.w, self.v = (torch.nn.Parameter(part.clone()) for part in parts)

    def forward(self, x):
        if self.form == "einsum":
            return torch.einsum("bl,hl->bh", x, self.w)
        if self.form == "contiguous":
            return x @ self.w.T.contiguous()
        if self.form == "moved":
            self.w.data = self.w.data.clamp(-50.0, 50.0)
        return x @ self.w.T


@pytest.mark.parametrize("form", ["einsum", "contiguous", "moved"])
def test_the_way_in_which_features_are_written_does_not_matter(form):
    one, other = (posteriors(features=Written(form))[0] for form in (form, "plain"))
    for net in (one, other):
        fit(net, pairs(), weight_decay=0.5, **OPTIONS)
    features, expected = one.network.features, other.network.features
    torch.testing.assert_close(features.w, expected.w, rtol=1e-4, atol=1e-5)
    assert features.w.ne(torch.randn(6, 2, generator=generator("written"))).any()
    assert not features.v.any()  # unused ones are left alone


def test_a_network_that_is_frozen_is_refused():
    net = posteriors()[0]
    net.network.requires_grad_(False)
    with pytest.raises(ValueError, match="parameters that are to be learned, got 'all frozen'"):
        fit(net, pairs(), **OPTIONS)


@pytest.mark.parametrize("features", ["residual", "fourier"])
def test_a_fit_does_not_ask_what_autograd_is_set_to(features):
    nets = posteriors(features=features)[:2]
    usual = fit(nets[0], pairs(), **OPTIONS)
    nets = posteriors(features=features)[:2]
    with torch.no_grad(), torch.autocast("cpu"):
        assert fit(nets[0], pairs(), **OPTIONS).validation == usual.validation


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"seeds": [1]}, "posteriors, and as many seeds, got '3 and 1'"),
        ({"epoch": 1}, "an option of fit, got 'epoch'.*did you mean"),
    ],
)
def test_what_cannot_be_fitted_together_is_refused(options, text):
    with pytest.raises(ValueError, match=text):
        fit_several(posteriors(), pairs(), **{"seeds": [1, 2, 3]} | options)
    other = MixtureDensityPosterior(PRIOR, 2, in_key="x")
    with pytest.raises(ValueError, match=r"posteriors of the same keys, got .*'x'"):
        fit_several([*posteriors()[:2], other], pairs(), seeds=[1, 2, 3])


def test_one_seed_for_several_is_refused():
    with pytest.raises(TypeError, match="expected seeds, one for each posterior, got 'one seed'"):
        fit_several(posteriors(), pairs(), seeds=[1, 2, 3], seed=0)


@pytest.mark.parametrize("count", [1, 3])
def test_an_interrupted_fit_leaves_each_network_at_its_best_epoch(count, monkeypatch):
    data, steps = pairs(), []

    def interrupted(*args, **kwargs):
        steps.append(1)
        if len(steps) == 12:  # in the third epoch, of five steps each
            raise KeyboardInterrupt
        _fused_adamw(*args, **kwargs)

    options = {"batch_size": 60, "epochs": 9, "progress": False}
    seeds = list(range(count))
    whole, broken = posteriors()[:count], posteriors()[:count]
    monkeypatch.setattr("torchrl_bayessim.inference.steps._fused_adamw", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit_several(broken, data, seeds=seeds, **options)
    monkeypatch.undo()
    reports = fit_several(whole, data, seeds=seeds, **options)
    for posterior, report in zip(broken, reports, strict=True):
        held_out = posterior.held_out
        assert held_out is not None
        loss = PosteriorLoss(posterior)(held_out)["loss_posterior"].item()
        assert loss == pytest.approx(min(report.validation[:2]), abs=1e-4)


def test_a_short_fit_ends_with_the_loss_itself():
    nets, data = posteriors()[:2], pairs()
    options = {"batch_size": 32, "lr": 1e-2, "weight_decay": 0.0, "patience": 9, "progress": False}
    found = descend(nets, data, data, epochs=1, seeds=[0, 1], **options)
    for net, (_, validation) in zip(nets, found, strict=True):
        assert PosteriorLoss(net)(data)["loss_posterior"].item() == pytest.approx(
            validation[0], abs=1e-4
        )


def test_weights_in_one_place_are_not_trained_as_several():
    net = posteriors()[0]
    blocks = net.network.features.blocks
    blocks[1].weight.data = blocks[0].weight.data
    assert not alike([net.network])
    own = posteriors()[0].network
    own.features.forward = lambda x: 2 * type(own.features).forward(own.features, x)
    assert not alike([own])


def test_weights_may_lie_in_any_order():
    nets = posteriors()[:2]
    block = nets[0].network.features.blocks[1]
    block.weight = torch.nn.Parameter(block.weight.detach().T.contiguous().T)
    assert not block.weight.is_contiguous()
    reports = [fit(net, pairs(), **OPTIONS) for net in (nets[0], posteriors()[0])]
    assert reports[0].validation == pytest.approx(reports[1].validation, abs=1e-5)


@pytest.mark.parametrize("features", ["residual", "fourier"])
def test_a_fit_leaves_no_gradients(features):
    net = posteriors(features=features)[0]
    fit(net, pairs(), **OPTIONS)
    assert all(parameter.grad is None for parameter in net.parameters())


def test_a_contrast_belongs_to_its_factor_and_pickles_of_before_have_none():
    net = posteriors()[0].network
    net.contrast.fill_(1.5)
    net.tails = torch.tensor([0.5])
    some = {key: value for key, value in net.state_dict().items() if key.startswith("features")}
    net.load_state_dict(some, strict=False)
    assert net.contrast.tolist() == [1.5, 1.5]
    assert net.tails == 0.5
    del net._buffers["contrast"], net._buffers["tails"]
    again = pickle.loads(pickle.dumps(net))
    assert again.contrast.tolist() == [1.0, 1.0]
    assert len(again.tails) == 0


def test_no_contrast_makes_a_point_of_a_component():
    net = posteriors()[0].network
    raw = torch.full((1, sum(net.sizes)), -60.0)
    mixture = widened(net.components_of(raw), torch.ones(2), torch.full((2,), 2.0), torch.zeros(0))
    assert mixture.scale_tril.norm(dim=-1).min().item() == pytest.approx(1e-4, rel=1e-3)


def test_states_of_one_factor_for_all_parameters_are_understood():
    net = posteriors()[0]
    state = net.state_dict()
    name = next(key for key in state if key.endswith("widening"))
    newer = ("contrast", "tails")
    older = {key: value for key, value in state.items() if not key.endswith(newer)}
    net.network.contrast.fill_(1.5)
    net.network.tails = torch.tensor([0.5])
    net.load_state_dict(older | {name: torch.tensor(1.25)})
    assert net.network.widening.tolist() == [1.25, 1.25]
    assert net.network.contrast.tolist() == [1.0, 1.0]
    assert len(net.network.tails) == 0
