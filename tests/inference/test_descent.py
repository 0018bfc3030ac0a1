import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.descent import descend
from torchrl_bayessim.inference.losses import PosteriorLoss
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.randomness import generator

OPTIONS = {
    "batch_size": 32,
    "lr": 1e-2,
    "weight_decay": 0.0,
    "patience": 100,
    "seeds": [0],
    "progress": False,
}


def pairs(prior, count, key=0):
    theta = prior.sample((count,), generator=generator("theta", key))
    noise = 0.3 * torch.randn(count, 2, generator=generator("noise", key))
    return TensorDict({"theta": theta, "summary": theta + noise}, [count])


@pytest.mark.parametrize(
    "prior",
    [
        BoxPrior({"a": (0.0, 1.0), "b": (0.1, 2.0)}, log=["b"]),
        GaussianPrior({"a": (0, 1), "b": (5, 2)}),
    ],
    ids=["box", "gaussian"],
)
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("covariance", ["full", "diagonal"])
def test_the_loss_reported_is_that_of_the_loss_module(prior, weighted, covariance):
    net = MixtureDensityPosterior(prior, 2, covariance=covariance)
    train, held = pairs(prior, 64), pairs(prior, 40, key=1)
    if weighted:
        train["weight"], held["weight"] = torch.ones(64), torch.arange(40.0)
    _, validation = descend([net], train, held, epochs=3, **OPTIONS)[0]
    with torch.no_grad():
        expected = PosteriorLoss(net)(held)["loss_posterior"].item()
    assert min(validation) == pytest.approx(expected, abs=1e-4)


def test_the_parameters_of_the_best_epoch_are_kept_of_each_network():
    prior = BoxPrior({"a": (0.0, 1.0), "b": (0.0, 1.0)})
    nets = [MixtureDensityPosterior(prior, 2, components=1, seed=seed) for seed in (0, 1)]
    held = pairs(prior, 200, key=1)
    two = {"seeds": [0, 1]}
    for net, (_, validation) in zip(
        nets, descend(nets, pairs(prior, 24), held, epochs=60, **OPTIONS | two), strict=True
    ):
        assert validation[-1] > min(validation)
        loss = PosteriorLoss(net)(held)["loss_posterior"].item()
        assert loss == pytest.approx(min(validation), abs=1e-4)


def test_overfitting_ends_it_by_itself_but_not_before_the_box():
    prior = BoxPrior({"a": (0.0, 1.0), "b": (0.0, 1.0)})
    held, own = pairs(prior, 200, key=1), {"patience": None, "seeds": [0, 1]}
    nets = [MixtureDensityPosterior(prior, 2, components=1, seed=seed) for seed in (0, 1)]
    traces = descend(nets, pairs(prior, 24), held, epochs=60, **OPTIONS | own)
    mean = [sum(losses) / 2 for losses in zip(*(trace[1] for trace in traces), strict=True)]
    best = mean.index(min(mean))
    # the box, then 12 % of 60 epochs, or half of that: the pairs learned from are far likelier
    learned = [sum(losses) / 2 for losses in zip(*(trace[0] for trace in traces), strict=True)]
    assert mean[-1] - learned[-1] > 2 * 0.5
    assert len(mean) == max(best + 1, min(best + 1 + 25, 36)) + 3


def test_a_last_part_in_vain_is_longer_where_nothing_is_overfitted():
    prior = BoxPrior({"a": (0.0, 1.0), "b": (0.0, 1.0)})
    held, own = pairs(prior, 200, key=1), {"patience": None}
    net = MixtureDensityPosterior(prior, 2, components=1)
    ((learned, losses),) = descend([net], pairs(prior, 400), held, epochs=60, **OPTIONS | own)
    assert losses[-1] - learned[-1] < 2 * 0.5
    assert len(losses) == max(losses.index(min(losses)) + 1, 36) + 7


def test_without_a_box_it_is_as_patient_until_the_last_part():
    """Nothing to learn, so that the held-out loss wavers: a few epochs in vain are no end."""
    prior = GaussianPrior({"a": (0.0, 1.0)})
    theta = prior.sample((1400,), generator=generator(2))
    noise = torch.randn(1400, 2, generator=generator(3))
    data = TensorDict({"theta": theta, "summary": noise}, [1400])
    net = MixtureDensityPosterior(prior, 2, components=1)
    own = {"patience": None, "lr": 3e-2}
    ((_, losses),) = descend([net], data[200:], data[:200], epochs=40, **OPTIONS | own)
    best = losses.index(min(losses))
    assert len(losses) == max(best + 1, min(best + 1 + 25, 24)) + 5
    assert best + 6 < 24  # five epochs in vain, long before


def test_the_box_comes_in_before_the_end():
    """Summaries that say nothing: the posterior is flat to its edges, the entropy 0."""
    prior = BoxPrior({"a": (0.0, 1.0)})
    theta = prior.sample((3000,), generator=generator(1))
    data = TensorDict({"theta": theta, "summary": torch.zeros(3000, 2)}, [3000])
    net = MixtureDensityPosterior(prior, 2, components=1)
    descend([net], data[:1500], data[1500:], epochs=16, **OPTIONS)
    density = net.distribution(torch.zeros(2)).log_prob(torch.tensor([[0.0], [0.5], [1.0]]))
    assert density.abs().max() < 0.3  # one Gaussian without the box: 1.1 apart
