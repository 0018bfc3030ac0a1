import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.losses import PosteriorLoss
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.randomness import generator

PRIOR = BoxPrior({"mass": (2.0, 6.0), "friction": (0.5, 2.0)})


def posterior(prior=PRIOR, **options):
    return MixtureDensityPosterior(prior, 4, **options)


def pairs(n=8, prior=PRIOR):
    summary = torch.randn(n, 4, generator=generator("summary"))
    theta = prior.sample((n,), generator=generator("theta"))
    return TensorDict({"summary": summary, "theta": theta}, [n])


def value(data, net=None, **options):
    return PosteriorLoss(net or posterior(), **options)(data)["loss_posterior"]


def gradient(data, net, **options):
    net.zero_grad()
    value(data, net, **options).backward()
    return torch.cat([p.grad.flatten() for p in net.parameters()])


def test_it_is_the_negative_log_density():
    net, data = posterior(), pairs()
    expected = -net.get_dist(data).log_prob(data["theta"])
    torch.testing.assert_close(value(data, net, reduction="none"), expected)
    torch.testing.assert_close(value(data, net, reduction="sum"), expected.sum())
    torch.testing.assert_close(value(data, net), expected.mean())


def test_weights_weigh():
    net, data = posterior(), pairs()
    each, weight = value(data, net, reduction="none"), torch.rand(8, generator=generator(0))
    data["weight"] = weight
    torch.testing.assert_close(value(data, net, reduction="sum"), (weight * each).sum())
    torch.testing.assert_close(value(data, net), (weight * each).sum() / weight.sum())
    torch.testing.assert_close(value(data, net, reduction="none"), each)
    data["weight"] = 7 * weight.unsqueeze(-1)  # only ratios count in a mean
    torch.testing.assert_close(value(data, net), (weight * each).sum() / weight.sum())


@pytest.mark.parametrize("key", ["mask", ("collector", "mask")])
@pytest.mark.parametrize("trailing", [False, True])
def test_masked_pairs_do_not_count(trailing, key):
    net, data = posterior(), pairs()
    kept = torch.tensor([True, False, True, True, False, True, True, False])
    expected = value(data[kept], net)
    data[key] = kept.unsqueeze(-1) if trailing else kept
    torch.testing.assert_close(value(data, net), expected)


def test_masks_and_weights_multiply():
    net, data = posterior(), pairs()
    kept, weight = torch.arange(8) % 2 == 0, torch.rand(8, generator=generator(1))
    data["weight"] = weight
    expected = value(data[kept], net, reduction="sum")
    data["collector", "mask"] = kept
    torch.testing.assert_close(value(data, net, reduction="sum"), expected)


@pytest.mark.parametrize("how", ["weight", "mask"])
@pytest.mark.parametrize("entry", ["summary", "theta"])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -1e30])
def test_what_has_no_weight_may_hold_anything(how, entry, bad):
    """Also in the gradient, where a zero times NaN would be NaN."""
    net, data = posterior(), pairs()
    kept = torch.arange(8) < 5
    expected, expected_gradient = value(data[kept], net), gradient(data[kept], net)
    data[entry][~kept] = bad
    if how == "mask":
        data["collector", "mask"] = kept
    else:
        data["weight"] = kept.float()
    torch.testing.assert_close(value(data, net), expected)
    torch.testing.assert_close(gradient(data, net), expected_gradient)


def test_a_batch_without_weight_has_no_loss_and_no_gradient():
    net, data = posterior(), pairs()
    data["weight"] = torch.zeros(8)
    assert value(data, net) == 0
    assert (gradient(data, net) == 0).all()


@pytest.mark.parametrize("prior", [PRIOR, GaussianPrior({"a": (0.0, 1.0), "b": (5.0, 2.0)})])
@pytest.mark.parametrize("covariance", ["diagonal", "full"])
@pytest.mark.parametrize("features", ["residual", "neural", "fourier"])
def test_the_gradient_reaches_every_parameter(prior, covariance, features):
    net = posterior(prior, covariance=covariance, features=features)
    value(pairs(prior=prior), net).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        reached = parameter.grad.reshape(len(parameter), -1).abs().sum(-1) > 0
        # every row of the head: weights, means, deviations, correlations
        assert reached.all() if "head" in name else reached.any(), name


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_the_gradient_is_that_of_finite_differences(covariance):
    net, data = posterior(covariance=covariance).double(), pairs(3).double()
    got = gradient(data, net)
    direction = torch.randn(len(got), generator=generator(2), dtype=torch.float64)
    start = torch.nn.utils.parameters_to_vector(net.parameters()).detach()
    ends = []
    for step in (1e-4, -1e-4):
        torch.nn.utils.vector_to_parameters(start + step * direction, net.parameters())
        # in double precision, so not through log_prob's cast to the default type
        q = net.get_dist(data)
        z = PRIOR.standardize(data["theta"])
        ends.append(-q.mixture.log_prob(z).mean().item())
    assert (got @ direction).item() == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-3)


def test_keys_can_be_set():
    net = posterior(in_key=("real", "x"))
    data = pairs()
    expected = value(data, posterior())
    loss = PosteriorLoss(net)
    loss.set_keys(theta="phi", weight=("my", "weight"), mask="valid")
    renamed = TensorDict(
        {
            "real": {"x": data["summary"]},
            "phi": data["theta"],
            "my": {"weight": torch.ones(8)},
            "valid": torch.ones(8, dtype=torch.bool),
        },
        [8],
    )
    assert loss.in_keys == [("real", "x"), "phi"]
    torch.testing.assert_close(loss(renamed)["loss_posterior"], expected)
    renamed["valid"][3:] = False
    expected = value(data[:3], posterior())
    torch.testing.assert_close(loss(renamed)["loss_posterior"], expected)


def test_an_unknown_key_cannot_be_set():
    with pytest.raises(ValueError, match="advantage"):
        PosteriorLoss(posterior()).set_keys(advantage="a")


def test_it_can_be_called_with_tensors():
    net, data = posterior(), pairs()
    got = PosteriorLoss(net)(summary=data["summary"], theta=data["theta"])
    torch.testing.assert_close(got, value(data, net))


def test_it_shares_the_parameters_of_the_posterior():
    net, data = posterior(), pairs()
    loss = PosteriorLoss(net)
    before = loss(data)["loss_posterior"].item()
    with torch.no_grad():
        net.network.head.bias.add_(0.5)
    assert loss(data)["loss_posterior"].item() != pytest.approx(before)
    optimised = {id(p) for p in loss.parameters()}
    assert {id(p) for p in net.parameters()} <= optimised


def test_batches_of_more_dimensions_are_one_batch():
    net, data = posterior(), pairs()
    torch.testing.assert_close(value(data.reshape(2, 4), net), value(data, net))
    assert value(data.reshape(2, 4), net, reduction="none").shape == (2, 4)


def test_an_unknown_reduction_is_refused():
    with pytest.raises(ValueError, match=r"a reduction, got 'average'. Available: mean, sum, none"):
        PosteriorLoss(posterior(), reduction="average")


@pytest.mark.parametrize("entry", ["theta", "summary"])
def test_a_missing_entry_is_named(entry):
    with pytest.raises(KeyError, match=rf"pairs with an entry, got '{entry}'\. Available: "):
        value(pairs().exclude(entry))


@pytest.mark.parametrize("weight", [-1.0, torch.nan, torch.inf])
def test_weights_that_are_none_are_refused(weight):
    with pytest.raises(ValueError, match=r"finite weights of 0 or more, got '8 others, the first"):
        value(pairs().set("weight", torch.full((8,), weight)))


@pytest.mark.parametrize("kind", ["weight", "mask"])
def test_there_is_one_weight_and_one_mask_for_each_pair(kind):
    data = pairs().auto_batch_size_(0).set(kind, torch.ones(7).bool())
    with pytest.raises(ValueError, match=rf"one {kind} per pair, shape \(8,\), got \(7,\)"):
        value(data)


def test_a_mask_of_floats_is_refused():
    with pytest.raises(TypeError, match=r"booleans in 'mask', got 'torch.float32'"):
        value(pairs().set("mask", torch.ones(8)))


@pytest.mark.parametrize(
    ("entry", "bad", "said"),
    [
        ("summary", torch.nan, "1 with NaN or infinity, 0 outside"),
        ("theta", torch.nan, "1 with NaN or infinity, 0 outside"),
        ("theta", 9.0, "0 with NaN or infinity, 1 outside"),
    ],
)
@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_pairs_that_have_no_loss_are_refused_or_masked(entry, bad, said, reduction):
    data = pairs()
    data[entry][2] = bad
    with pytest.raises(ValueError, match=rf"inside BoxPrior.*{said}.*Try: mask them"):
        value(data, reduction=reduction)
    assert value(data, reduction="none").isfinite().sum() == 7
    data["mask"] = torch.arange(8) != 2
    assert value(data, reduction=reduction).isfinite()


def test_a_network_that_is_no_posterior_is_refused_at_once():
    with pytest.raises(TypeError, match=r"a posterior network with get_dist.*got 'Linear'"):
        PosteriorLoss(torch.nn.Linear(4, 2))
