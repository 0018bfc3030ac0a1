import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.averaged_posterior import AveragedPosterior
from torchrl_bayessim.inference.calibration import calibrate
from torchrl_bayessim.inference.ensemble import fit_apart, fit_together
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior

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


def test_conditioning_far_from_all_simulations_warns():
    averaged = AveragedPosterior(fitted(fit_together))
    with pytest.warns(UserWarning, match=r"lie as far out as|edge of BoxPrior"):
        averaged.condition(torch.tensor([40.0]))


def test_networks_must_agree_in_prior_and_keys():
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
