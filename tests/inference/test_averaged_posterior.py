import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.averaged_posterior import AveragedPosterior, _of_products
from torchrl_bayessim.inference.calibration import calibrate
from torchrl_bayessim.inference.ensemble import fit_apart, fit_together
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.inference.widening import average

PRIOR = BoxPrior({"mass": (2.0, 6.0)})


def fitted(fit):
    theta = PRIOR.sample((600,), generator=torch.Generator().manual_seed(0))
    pairs = TensorDict({"theta": theta, "summary": theta}, [600])
    networks = [MixtureDensityPosterior(PRIOR, 1, seed=seed) for seed in (0, 1)]
    fit(networks, pairs, seeds=(0, 1), epochs=10, progress=False)
    return networks


def test_densities_are_the_mean_of_the_networks():
    networks = fitted(fit_together)
    for network in networks:
        network.network.apart.fill_(1.0)  # each where it is by itself
    averaged = AveragedPosterior(networks)
    summary, theta = torch.tensor([[3.0], [5.0]]), torch.tensor([[3.1], [4.9]])
    each = torch.stack([n.distribution(summary).log_prob(theta).exp() for n in networks])
    found = averaged.distribution(summary).log_prob(theta).exp()
    torch.testing.assert_close(found, each.mean(0))
    one, other = (averaged.condition(row).log_prob(theta) for row in (summary[0], summary[:1]))
    torch.testing.assert_close(one, other)
    assert averaged.held_out is networks[0].held_out
    assert calibrate(averaged, averaged.held_out).names == ("mass",)


def test_networks_that_held_out_other_pairs_have_none_in_common():
    assert AveragedPosterior(fitted(fit_apart)).held_out is None
    assert AveragedPosterior([MixtureDensityPosterior(PRIOR, 1)]).held_out is None


def products(summary, apart):
    """Return answers to three trajectories: of each network, and together.

    Of the first networks whose answers are ``apart``: how they come out depends on the processor.
    """
    theta = torch.linspace(2, 6, 600)[:, None]
    pairs = TensorDict({"theta": theta, "summary": summary(theta)}, [600])
    several = summary(torch.tensor([[5.0], [5.02], [4.98]]))
    for first in range(0, 20, 2):
        seeds = first, first + 1
        networks = [MixtureDensityPosterior(PRIOR, 1, components=4, seed=seed) for seed in seeds]
        fit_apart(networks, pairs, seeds=seeds, epochs=30, progress=False)
        each = [network.condition(several).mixture for network in networks]
        if apart(*each):
            return each, AveragedPosterior(networks).condition(several).mixture
    pytest.fail("all networks answer alike")


def mean(mixture):
    return (mixture.logits.softmax(-1) @ mixture.loc).item()


def on_the_right(mixture):
    return (mixture.logits.softmax(-1) @ (mixture.loc > 0).to(mixture.loc)).item()


def test_means_of_products_come_half_of_the_way_together():
    each, together = products(lambda x: x, lambda a, b: abs(mean(b) - mean(a)) > 2e-4)
    (one, other), loc = each, together.loc
    moved = loc - torch.cat([one.loc, other.loc])
    way = (mean(other) - mean(one)) / 2
    share = torch.cat([moved[: len(one.loc)] / way, moved[len(one.loc) :] / -way])
    assert (share > 0.4).all()
    assert (share <= 0.5 + 1e-6).all()


def test_products_that_lie_apart_along_a_ridge_stay_on_it():
    along, across = torch.tensor([1.0, 0.3]).double(), torch.tensor([-0.3, 1.0]).double()
    along, across = along / along.norm(), across / across.norm()
    covariance = 0.45**2 * torch.outer(along, along) + 0.01**2 * torch.outer(across, across)
    scale = torch.linalg.cholesky(covariance)[None]
    box = torch.full((2,), -(3**0.5)).double(), torch.full((2,), 3**0.5).double()
    members = [
        TruncatedGaussianMixture(torch.zeros(1).double(), at * along[None], scale, box)
        for at in (-0.5, 0.0, 0.5)
    ]
    together = average(members, _of_products(members))
    assert ((together.loc @ across).abs() < 0.3 * 0.01).all()


def test_modes_of_products_stay_where_they_are():
    # n answers choose a mode, and networks not the same one
    each, together = products(
        lambda theta: (theta - 4).abs(), lambda a, b: abs(on_the_right(a) - on_the_right(b)) > 0.8
    )
    before = torch.cat([own.loc for own in each])
    moved = (together.loc - before).abs().flatten()
    assert (moved < 0.01 * together.scale_tril.flatten()).all()


def test_conditioning_far_from_all_simulations_warns():
    averaged = AveragedPosterior(fitted(fit_together))
    with pytest.warns(UserWarning, match=r"lie as far out as|edge of BoxPrior"):
        averaged.condition(torch.tensor([40.0]))


def test_networks_must_agree_in_prior_keys_and_device():
    one = MixtureDensityPosterior(PRIOR, 1)
    with pytest.raises(ValueError, match="one network or more, got 'none'"):
        AveragedPosterior([])
    with pytest.raises(TypeError, match="a MixtureDensityPosterior"):
        AveragedPosterior([one, torch.nn.Linear(1, 1)])
    others = (
        MixtureDensityPosterior(BoxPrior({"mass": (2.0, 5.0)}), 1),
        MixtureDensityPosterior(PRIOR, 1, in_key="x"),
    )
    for other in others:
        with pytest.raises(ValueError, match=r"networks over BoxPrior\(mass: \[2, 6\]\), all with"):
            AveragedPosterior([one, other])
    with pytest.raises(
        ValueError, match=r"networks on one device, since.*got 'cpu and meta'\. Try: network\.to"
    ):
        AveragedPosterior([one, MixtureDensityPosterior(PRIOR, 1).to("meta")])
