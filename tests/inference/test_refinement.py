import re
import warnings

import numpy as np
import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from torchrl_bayessim import checkpoint
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.robots import SurrogateRobot
from torchrl_bayessim.simulate import collect_summaries, make_collector
from torchrl_bayessim.sources import draw
from torchrl_bayessim.summaries import SummaryStatistics, linear_dynamics
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

BOX = BoxPrior({"a": (-1.0, 1.0), "b": (0.1, 10.0)}, log=["b"], units={"b": "kg"})
NORMAL = GaussianPrior({"a": (0.0, 1.0), "b": (0.0, 2.0)})
QUICK = {"epochs": 40, "lr": 2e-2, "progress": False}


def small(prior, size):
    return MixtureDensityPosterior(prior, size, components=1)


def refinement(prior=BOX, simulations=300, **options):
    options = {"networks": 1, "make_posterior": small, "fit_options": QUICK} | options
    return PosteriorRefinement(prior, simulations=simulations, **options)


def noisy(prior, seed=0):
    """Return a simulator of standardised parameters plus noise, two statistics each."""
    generator = torch.Generator().manual_seed(seed)

    def simulate(theta):
        z = prior.standardize(theta.double()).float().repeat(1, 2)
        return z + 0.1 * torch.randn(z.shape, generator=generator)

    return simulate


@pytest.mark.parametrize("prior", [BOX, NORMAL])
def test_refinements_close_in_on_the_truth_and_report_what_they_used(prior):
    truth = torch.tensor([0.4, 2.0])
    observed = noisy(prior, 7)(truth[None])[0]
    gains, made = [], refinement(prior)
    for turn in range(2):
        report = made.refine(noisy(prior, turn), observed, key=(turn,))
        assert (report.pairs, report.dropped) == (300, 0)
        gains.append((made.posterior.log_prob(truth) - prior.log_prob(truth)).item())
    assert gains[0] > 1
    assert gains[1] > 2.5  # 0.1 / sqrt(2) deviations of noise on two parameters: at most 3.3
    assert made.posterior.names == prior.names
    assert made.posterior.units == prior.units
    told = made.trust.identifiability
    assert told.names == prior.names
    assert (told.nats > 1.2).all()  # over the prior, not over the box that was simulated last
    torch.testing.assert_close(made.trust.posterior.mean, made.posterior.mean)


def test_the_report_says_whether_simulations_at_the_posterior_give_the_data_where_asked():
    truth, asked = torch.tensor([[0.4, 2.0]]), []
    simulate = noisy(BOX)
    made = PosteriorRefinement(BOX, simulations=300, predictive=120, fit_options=QUICK)
    made.refine(
        lambda theta: asked.append(len(theta)) or simulate(theta),
        noisy(BOX, 7)(truth)[0],
        key=(0,),
    )
    assert asked == [300, 120]
    assert made.trust.predictive > 0.05
    assert made.settings["predictive"] == 120
    off = lambda theta: noisy(BOX, len(theta))(theta) + (5.0 if len(theta) == 120 else 0.0)
    with pytest.warns(UserWarning, match=r"only 0\.8% of 120 simulations at the posterior"):
        made.refine(off, noisy(BOX, 7)(truth)[0], key=(1,))
    assert made.trust.predictive < 0.01


def test_a_report_on_several_trajectories_says_that_their_answer_together_was_not_checked():
    made = refinement()
    rows = noisy(BOX, 7)(torch.tensor([[0.4, 2.0]]).expand(3, -1))
    made.refine(noisy(BOX), rows, key=(0,))
    assert made.trust.trajectories == 3
    assert "calibration of 3 together" in str(made.trust)


@pytest.mark.filterwarnings("ignore:the answer for 5 trajectories together")
def test_answers_for_several_trajectories_are_checked_at_known_parameters_where_asked():
    rows = noisy(BOX, 7)(torch.tensor([[0.4, 2.0]]).expand(5, -1))
    made, asked = PosteriorRefinement(BOX, simulations=300, truths=60, fit_options=QUICK), []
    simulate = noisy(BOX)
    made.refine(lambda theta: asked.append(len(theta)) or simulate(theta), rows, key=(0,))
    assert asked == [300, 60 * 5]
    assert made.trust.pooled is not None
    assert len(made.trust.pooled.rank) == 60
    assert "calibration of 5 together" not in str(made.trust)
    assert made.settings["truths"] == 60
    made.refine(simulate, rows[0], key=(1,))
    assert made.trust.pooled is None
    with pytest.raises(ValueError, match="50"):
        PosteriorRefinement(BOX, truths=20)


def test_too_few_simulations_for_a_predictive_check_are_refused():
    with pytest.raises(ValueError, match="99"):
        PosteriorRefinement(BOX, predictive=50)


def test_a_second_refinement_simulates_around_the_first_posterior():
    observed = torch.tensor([0.5, 0.5, 0.5, 0.5])
    made, asked = refinement(), []
    simulate = noisy(BOX)
    for turn in range(2):
        made.refine(lambda theta: asked.append(theta) or simulate(theta), observed, key=(turn,))
    volume = [BOX.standardize(theta.double()).std(0).prod() for theta in asked]
    assert volume[1] < 0.3 * volume[0]
    assert BOX.contains(asked[1]).all()
    assert made.posterior.prior.contains(asked[1]).all()


@pytest.mark.parametrize("prior", [BOX, NORMAL])
def test_pairs_simulated_elsewhere_teach_the_same(prior):
    observed = torch.zeros(4)
    one, other = refinement(prior), refinement(prior)
    for turn in range(2):
        one.refine(noisy(prior, turn), observed, key=(turn,))
        theta = draw(other.proposal(), 300, key=(0, turn, "theta"))
        other.learn(theta, noisy(prior, turn)(theta), observed, key=(turn,))
    assert torch.equal(one.posterior.mean, other.posterior.mean)


def test_independent_trajectories_sharpen_the_posterior():
    observed = noisy(BOX)(torch.tensor([[0.2, 1.0]]).repeat(6, 1))
    spread = []
    for rows in (observed[0], observed):
        made = refinement()
        made.refine(noisy(BOX), rows, key=(0,))
        spread.append(made.posterior.stddev)
    assert (spread[1] < 0.7 * spread[0]).all()


def test_more_networks_are_averaged_and_have_other_splits():
    one, two = refinement(networks=1), refinement(networks=2)
    for made in (one, two):
        made.refine(noisy(BOX), torch.zeros(4), key=(0,))
    parts = two.posterior.mixture
    assert len(parts.logits) == 2 * len(one.posterior.mixture.logits)
    assert torch.equal(parts.loc[:1], one.posterior.mixture.loc)
    assert not torch.equal(parts.loc[0], parts.loc[1])


@pytest.mark.parametrize("prior", [BOX, NORMAL])
def test_a_checkpoint_goes_on_to_the_same_numbers(prior, tmp_path):
    def turn(made, key):
        made.refine(noisy(prior, key), torch.full((4,), 0.3), key=(key,))

    whole, first, second = refinement(prior), refinement(prior), refinement(prior)
    turn(whole, 0)
    turn(whole, 1)
    turn(first, 0)
    checkpoint.save(tmp_path / "state.pt", first.state_dict())
    second.load_state_dict(checkpoint.load(tmp_path / "state.pt"))
    theta = prior.sample((5,))
    assert torch.equal(second.posterior.log_prob(theta), first.posterior.log_prob(theta))
    turn(second, 1)
    assert torch.equal(second.posterior.log_prob(theta), whole.posterior.log_prob(theta))
    second.load_state_dict(refinement(prior).state_dict())
    assert second.posterior is None


def test_simulations_that_diverge_are_dropped_counted_and_warned_about():
    inside = noisy(BOX)

    def simulate(theta):
        return torch.where(theta[:, :1] > 0.5, torch.nan, inside(theta))

    made, asked = refinement(networks=2), []
    with pytest.warns(UserWarning, match=r"\d+ of 300 pairs are not finite") as warned:
        report = made.refine(
            lambda theta: asked.append(theta) or simulate(theta), torch.zeros(4), key=(0,)
        )
    assert len([w for w in warned if "not finite" in str(w.message)]) == 1  # of two networks
    assert report.dropped == (asked[0][:, 0] > 0.5).sum()
    assert report.pairs == 300 - report.dropped


def test_if_all_simulations_diverge_nothing_is_claimed():
    made = refinement()
    with pytest.raises(SimulationError, match="300 diverged simulations of 300"):
        made.refine(lambda theta: torch.full((300, 4), torch.nan), torch.zeros(4), key=(0,))
    assert made.posterior is None


def test_a_real_summary_that_is_not_finite_is_refused_before_anything_is_simulated():
    bad = torch.tensor([0.0, torch.nan, 0.0, torch.inf])
    with pytest.raises(ValueError, match=r"infinity in statistics \[1, 3\].*Try: drop the traj"):
        refinement().refine(lambda theta: pytest.fail("simulated"), bad, key=(0,))


# When the prior excludes the robot, or the simulator lacks what it does; and when all is well.


def cartpoles(prior, length, seed, *, force=10.0):
    """Return the summary of a robot of this length and motor, and a simulator under ``prior``."""
    physics = AttributePhysics("length")
    statistics = SummaryStatistics(linear_dynamics)
    base = CartPoleEnv(4)
    base.set_parameters({"force_mag": torch.full((4,), force)}, torch.ones(4, dtype=torch.bool))
    robot = SurrogateRobot(TransformedEnv(base, ApplyPhysics(physics)), [length], max_steps=40)
    real = robot.rollouts(None, episodes=4, key=(seed,))
    randomizer = DomainRandomizer(prior)
    env = TransformedEnv(CartPoleEnv(400), Compose(ApplyPhysics(physics), randomizer))
    collector = make_collector(env, None, steps=40)

    def simulate(theta):
        return collect_summaries(
            collector, statistics, randomizer, theta, trajectories=4, key=(seed,), progress=False
        )[0]

    return statistics.together(real), simulate


@pytest.mark.parametrize("seed", range(4))
def test_a_robot_within_the_prior_raises_no_doubt(seed):
    prior = BoxPrior({"length": (0.3, 1.5)})
    truth = draw(prior, 1, key=(seed, "truth"))[0].item()
    observed, simulate = cartpoles(prior, truth, seed)
    made = refinement(prior, 100, seed=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for turn in range(2):
            made.refine(simulate, observed, key=(turn,))


def warned(prior, length, seed, **robot):
    """Return the warnings of one refinement."""
    observed, simulate = cartpoles(prior, length, seed, **robot)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        refinement(prior, 100, seed=seed).refine(simulate, observed, key=(0,))
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_outside_the_prior_is_never_passed_over_in_silence(seed):
    """By the summaries, by the edge of the prior, or by both."""
    texts = warned(BoxPrior({"length": (1.0, 1.5)}), 0.3, seed)
    assert texts
    for text in texts:
        assert "real summaries lie as far" in text or "'length' lie at the lower edge" in text


@pytest.mark.parametrize("seed", range(4))
def test_a_robot_that_does_what_the_simulator_cannot_is_noticed(seed):
    texts = warned(BoxPrior({"length": (1.0, 1.5)}), 1.2, seed, force=20.0)
    (apart,) = [text for text in texts if "1 of 1 real summaries lie as far out" in text]
    assert "of 100 simulated ones" in apart
    assert float(re.search(r"number \d+ by ([\d.e+]+),", apart)[1]) > 100
    assert "Does the prior hold the real parameters, and the simulator all that" in apart


def test_sizes_are_checked_at_construction():
    prior = BoxPrior({"a": (0.0, 1.0)})
    with pytest.raises(ValueError, match="at least 4 simulations, got 0"):
        PosteriorRefinement(prior, simulations=0)
    with pytest.raises(ValueError, match="components to be positive, got 0"):
        MixtureDensityPosterior(prior, 3, components=0)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"margin": -1.0}, "a finite margin of 0 or more, got -1.0"),
        ({"margin": float("nan")}, "a finite margin of 0 or more, got nan"),
        ({"margin": "1"}, "a finite margin of 0 or more, got '1'"),
        ({"prior_share": 7}, "prior_share to be a probability, 0 to 1, got 7"),
        ({"fit_options": {"epoch": 3}}, r"an option of fit, got 'epoch'.*epochs \(did you mean"),
    ],
    ids=str,
)
def test_options_that_cannot_be_are_refused_at_construction(options, text):
    with pytest.raises(ValueError, match=text):
        PosteriorRefinement(BOX, **options)


def test_a_distribution_without_names_is_no_prior():
    with pytest.raises(TypeError, match=r"a prior with named parameters, got 'Normal'\. Try: Box"):
        PosteriorRefinement(torch.distributions.Normal(0.0, 1.0))


@pytest.mark.parametrize("kind", [list, np.asarray])
def test_lists_and_arrays_may_be_observed(kind):
    observed = noisy(BOX, 7)(torch.tensor([[0.4, 2.0]]))[0]
    means = []
    for x in (observed, kind(observed.tolist())):
        made = refinement(simulations=64)
        made.refine(noisy(BOX), x, key=(0,))
        means.append(made.posterior.mean)
    assert torch.equal(*means)


def test_progress_bars_are_shown_as_the_options_say_or_else_as_asked(capsys):
    shown = []
    for options, asked in (({}, False), ({}, True), ({"progress": False}, True)):
        made = refinement(simulations=32, fit_options={"epochs": 1} | options)
        made.refine(noisy(BOX), torch.zeros(4), key=(0,), progress=asked)
        shown.append("epoch" in capsys.readouterr().err)
    assert shown == [False, True, False]


def members(mixture, count):
    """Return each network's share of an average: its means."""
    return mixture.loc.chunk(count, -2)


@pytest.mark.parametrize("maker", [None, small])
def test_networks_disagree_even_where_one_batch_holds_all_pairs(maker):
    """So few that no order of minibatches makes a difference."""
    made = refinement(networks=2, simulations=60, make_posterior=maker)
    made.refine(noisy(BOX), noisy(BOX, 7)(torch.tensor([[0.4, 2.0]]))[0], key=(0,))
    one, two = members(made.posterior.mixture, 2)
    assert (one - two).abs().max() > 0.01
