import warnings

import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.averaged_posterior import AveragedPosterior
from torchrl_bayessim.inference.ensemble import fit_together
from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.trust import contradictions, trust
from torchrl_bayessim.randomness import generator

PRIOR = BoxPrior({"mass": (0.0, 1.0), "link length 2": (0.0, 1.0)})


def simulate(theta, key="trust"):
    noise = 0.05 * torch.randn(len(theta), 2, generator=generator(key))
    return torch.cat([theta[:, :1], 2 * theta[:, :1]], -1) + noise


@pytest.fixture(scope="module")
def network():
    theta = PRIOR.sample((1000,), generator=generator(0))
    net = MixtureDensityPosterior(PRIOR, 2)
    pairs = TensorDict({"theta": theta, "summary": simulate(theta)}, [1000])
    fit(net, pairs, epochs=20, progress=False)
    return net


def test_real_data_from_the_simulator_are_believed(network):
    found = trust(network, torch.tensor([0.4, 0.8]), simulate=simulate)
    assert found.doubts == ()
    assert found.calibration.passed
    assert found.predictive > 0.05
    assert found.identifiability.names == PRIOR.names
    said = str(found)
    assert "These data say nothing about link length 2" in said
    assert "These data say much about mass" in said
    assert said.endswith("No reason to doubt this posterior.")


def test_a_robot_that_no_parameter_explains_is_doubted(network):
    """The two statistics agree in every simulation; the robot's do not."""
    found = trust(network, torch.tensor([0.8, 0.4]), simulate=simulate)
    said = str(found)
    assert "no parameter explains these data: torchrl_bayessim.diagnosis" in said
    assert "simulations at the posterior lie as far out" in said
    assert found.predictive < 0.01


def test_conditioning_far_from_all_simulations_warns(network):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        network.condition(torch.tensor([40.0, 80.0]))
    apart = [
        str(warning.message) for warning in seen if "lie as far out as" in str(warning.message)
    ]
    assert len(apart) == 1
    assert "no parameter explains these data" in apart[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        network.condition(torch.tensor([0.4, 0.8]))
        network.condition(torch.tensor([40.0, 80.0]), check=False)


def test_a_network_that_is_too_sure_is_doubted(network):
    theta = PRIOR.sample((200,), generator=generator(1))
    noisy = simulate(theta, "other") + 0.2 * torch.randn(200, 2, generator=generator(2))
    pairs = TensorDict({"theta": theta, "summary": noisy}, [200])
    found = trust(network, torch.tensor([0.4, 0.8]), held_out=pairs)
    assert not found.calibration.passed
    assert any("too sure" in doubt for doubt in found.doubts)


def test_few_held_out_pairs_tell_nothing(network):
    assert (
        trust(network, torch.tensor([0.4, 0.8]), held_out=network.held_out[:49]).calibration is None
    )


def test_a_network_without_a_fit_is_refused():
    with pytest.raises(ValueError, match=r"a fitted network, got 'one that is not'\. Try: fit"):
        trust(MixtureDensityPosterior(PRIOR, 2), torch.zeros(2))


def test_many_trajectories_that_are_right_are_believed_and_wrong_ones_are_not(network):
    """However many there are: the mean of n is compared with means of n."""
    right = simulate(torch.tensor([[0.4, 0.5]]).expand(10, 2), "ten")
    assert trust(network, right, simulate=simulate).doubts == ()
    for count in (3, 10):
        wrong = right[:count] + torch.tensor([0.4, -0.4])
        found = trust(network, wrong, simulate=simulate)
        assert found.predictive == pytest.approx(1 / 201)
        assert any("simulations at the posterior lie as far out" in text for text in found.doubts)


def test_a_small_bias_of_every_trajectory_is_found_in_their_mean(network):
    """Off by twice the noise each, which one alone may be; the product is sure of nonsense."""
    right = simulate(torch.tensor([[0.4, 0.5]]).expand(16, 2), "sixteen")
    off = right + torch.tensor([0.1, -0.1])
    assert trust(network, off[:1], simulate=simulate).predictive > 0.01
    assert trust(network, off, simulate=simulate).predictive < 0.01


def test_a_product_that_is_too_sure_is_doubted_where_single_answers_are_not(network):
    """Runs of which most of the noise is the same say little more than one does."""

    def once(theta):
        few = simulate(theta[::4], "runs of one robot").repeat_interleave(4, 0)[: len(theta)]
        exact = torch.cat([theta[:, :1], 2 * theta[:, :1]], -1)
        own = simulate(theta, "each run") - exact
        return exact + 0.9 * (few - exact) + 0.44 * own

    real = once(torch.tensor([[0.4, 0.5]]).expand(4, 2))
    found = trust(network, real, simulate=once, truths=100)
    assert found.calibration.passed
    assert not found.pooled.passed
    assert any("answer for 4 trajectories together is too sure" in text for text in found.doubts)
    alone = trust(network, real)
    assert "Not checked: calibration of 4 together, without simulate and truths." in str(alone)


@pytest.mark.parametrize("masses", [[0.1, 0.9], [0.3, 0.7] * 5, [0.5] * 9 + [0.9]])
def test_trajectories_that_contradict_each_other_are_doubted(network, masses):
    """Each may be, and so may their mean; no one robot makes both."""
    theta = torch.tensor([[mass, 0.5] for mass in masses])
    found = trust(network, simulate(theta, "contradiction"), simulate=simulate)
    assert found.predictive <= 0.01
    expected = f"as far out as the real {len(masses)} summaries together"
    assert any(expected in text for text in found.doubts)
    without = str(trust(network, simulate(theta, "contradiction")))
    assert f"the {len(masses)} trajectories contradict each other about mass. Either" in without
    assert "torchrl_bayessim.diagnosis" in without


def test_trajectories_of_one_robot_seldom_contradict_each_other(network):
    truths = PRIOR.sample((60,), generator=generator("of one robot"))
    for index, truth in enumerate(truths):
        rows = simulate(truth.expand(2 + index % 10, 2), ("one robot", index))
        assert contradictions(network, rows) == []


def test_truths_without_a_simulator_are_refused(network):
    with pytest.raises(ValueError, match="simulate, for summaries at the truths"):
        trust(network, torch.zeros(3, 2), truths=60)


def test_simulations_that_all_diverge_are_said_to(network):
    found = trust(network, torch.tensor([0.4, 0.8]), simulate=lambda theta: theta * torch.nan)
    assert found.predictive == 0.0
    assert "all 200 simulations at the posterior diverged" in str(found)


@pytest.mark.parametrize("count", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_right_trajectories_are_a_surprise_as_rarely_as_was_promised(network, count):
    alarms = 0
    few = network.held_out[:1]  # of calibration nothing is asked here
    for turn in range(20):
        theta = PRIOR.sample((1,), generator=generator("robot", turn)).expand(count, 2)
        real = simulate(theta, f"real {turn}")
        told = trust(network, real, held_out=few, simulate=simulate, simulations=99, seed=turn)
        alarms += told.predictive <= 0.01
    assert alarms <= 2  # 0.2 expected, and the network is not exact


def test_several_networks_are_reported_on_together():
    theta = PRIOR.sample((1000,), generator=generator(0))
    networks = [MixtureDensityPosterior(PRIOR, 2, seed=seed) for seed in (0, 1)]
    pairs = TensorDict({"theta": theta, "summary": simulate(theta)}, [1000])
    fit_together(networks, pairs, seeds=(0, 1), epochs=20, progress=False)
    found = trust(AveragedPosterior(networks), torch.tensor([0.4, 0.8]), simulate=simulate)
    assert found.doubts == ()
    assert found.unchecked == ()
    assert len(found.calibration.rank) == 100
    assert found.posterior.mixture.logits.numel() > networks[0].network.components


def test_what_was_not_checked_is_said(network):
    again = MixtureDensityPosterior(PRIOR, 2)
    again.load_state_dict(network.state_dict())
    said = str(trust(again, torch.tensor([0.4, 0.8])))
    assert "No reason to doubt" in said
    assert "Not checked: calibration, without 50 held-out pairs of equal weight." in said
    assert "Not checked: whether simulations at the posterior give such data" in said


def test_simulations_of_another_shape_or_too_few_are_refused(network):
    with pytest.raises(ValueError, match=r"summaries of shape \(200, 2\) from simulate, got \(200"):
        trust(network, torch.zeros(2), simulate=lambda theta: theta[:, :1])
    with pytest.raises(ValueError, match="simulations"):
        trust(network, torch.zeros(2), simulate=simulate, simulations=50)


def test_a_fit_of_a_few_pairs_is_doubted():
    theta = PRIOR.sample((20,), generator=generator("few"))
    net = MixtureDensityPosterior(PRIOR, 2)
    fit(net, TensorDict({"theta": theta, "summary": simulate(theta)}, [20]), progress=False)
    said = str(trust(net, torch.tensor([0.4, 0.8])))
    assert "Doubt: it was fitted to 18 pairs only, too few to tell what it gets wrong." in said
    assert "No reason to doubt" not in said
    with_pairs = TensorDict({"theta": theta, "summary": simulate(theta, "held out")}, [20])
    assert "too few to tell" not in str(trust(net, torch.tensor([0.4, 0.8]), held_out=with_pairs))
