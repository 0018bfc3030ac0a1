import itertools

import numpy as np
import pytest
import torch

from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.inference.ensemble import pairs_of
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.sequential import CORRECTIONS, _inside, sequential
from torchrl_bayessim.randomness import generator

BOX = BoxPrior({"theta": (-2.0, 2.0)})
OBSERVED = torch.ones(1, 1)
# patience as long as the fit, so that the cosine of the learning rate reaches its end
FIT = {"epochs": 50, "patience": 50, "batch_size": 500, "lr": 5e-3, "progress": False}
FIT_ROUNDS = {"epochs": 60, "progress": False}
QUICK = {"epochs": 2, "batch_size": 64, "progress": False}
every_correction = pytest.mark.parametrize("correction", CORRECTIONS)


def square(key, sd=0.2):
    noise = generator("square", key)
    return lambda theta: theta**2 + sd * torch.randn(theta.shape, generator=noise)


def total_variation(posterior):
    """To the exact posterior of x = theta^2 + N(0, 0.2^2) at x = 1, by the midpoint rule."""
    step = 4 / 8000
    theta = -2 + step * (torch.arange(8000, dtype=torch.float64) + 0.5)
    exact = torch.softmax(-0.5 * ((1 - theta**2) / 0.2) ** 2, 0)
    return 0.5 * (posterior.log_prob(theta[:, None]).exp() * step - exact).abs().sum().item()


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
@every_correction
def test_three_rounds_find_both_modes(correction, seed):
    """Where dividing by a mixture term by term loses one mode or ends in an indefinite matrix."""
    rounds = sequential(
        square(seed),
        BOX,
        OBSERVED,
        rounds=3,
        simulations=2000,
        correction=correction,
        seed=seed,
        **FIT,
    )
    assert total_variation(list(rounds)[-1].posterior) <= 0.1


@pytest.mark.parametrize("correction", ["importance", "analytic"])
def test_a_linear_gaussian_problem_has_its_known_posterior(correction):
    """theta ~ N(1, 2^2), x = theta + N(0, 0.5^2), observed x = 2."""
    noise = generator("linear")
    *_, last = sequential(
        lambda theta: theta + 0.5 * torch.randn(theta.shape, generator=noise),
        GaussianPrior({"theta": (1.0, 2.0)}),
        torch.full((1, 1), 2.0),
        rounds=2,
        simulations=1000,
        correction=correction,
        networks=1,
        make_posterior=lambda size: MixtureDensityPosterior(
            GaussianPrior({"theta": (1.0, 2.0)}), size, components=1
        ),
        **FIT | {"batch_size": 100},
    )
    precision = 1 / 2.0**2 + 1 / 0.5**2
    mean = (1.0 / 2.0**2 + 2.0 / 0.5**2) / precision
    assert last.posterior.mean.item() == pytest.approx(mean, abs=0.1)
    assert last.posterior.stddev.item() == pytest.approx(precision**-0.5, rel=0.12)


@pytest.mark.parametrize("observed", [torch.tensor([[torch.nan]]), torch.zeros(1, 1, 1)])
def test_what_was_observed_is_checked_before_simulating(observed):
    def never(theta):
        raise AssertionError

    with pytest.raises(ValueError, match=r"finite statistics of|trajectories, shape \(L,\) or"):
        next(sequential(never, BOX, observed, rounds=1, simulations=100, **QUICK))


@pytest.mark.filterwarnings("ignore:.*left out")
def test_simulations_that_diverge_are_not_effective_pairs():
    def half(theta):
        return torch.where(theta > 0, theta, torch.nan)

    turn = next(sequential(half, BOX, OBSERVED, rounds=1, simulations=200, **QUICK))
    assert turn.effective_pairs == pytest.approx(100, abs=20)


@pytest.mark.filterwarnings("ignore:.*quotient wider than the prior")
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_analytic_correction_stays_at_the_known_posterior_round_after_round(seed):
    """theta ~ N(0, 1), x = theta + N(0, 0.1^2), observed x = 0.3, mixtures of four components."""
    noise = generator("sharp", seed)
    rounds = sequential(
        lambda theta: theta + 0.1 * torch.randn(theta.shape, generator=noise),
        GaussianPrior({"theta": (0.0, 1.0)}),
        torch.tensor([[0.3]]),
        rounds=3,
        simulations=600,
        correction="analytic",
        seed=seed,
        networks=2,
        epochs=40,
        progress=False,
    )
    for each in rounds:
        assert each.posterior.mean.item() == pytest.approx(0.297, abs=0.07)
        assert each.posterior.stddev.item() == pytest.approx(0.0995, rel=0.35)
        assert not each.refused


def test_a_refused_division_keeps_the_posterior_before_and_the_pairs(monkeypatch):
    divisions = []

    def refuse(learned, proposal):
        divisions.append(proposal)
        raise SimulationError("no division.")

    monkeypatch.setattr("torchrl_bayessim.inference.sequential.analytic_correction", refuse)
    rounds = sequential(
        square(0), BOX, OBSERVED, rounds=3, simulations=100, correction="analytic", **QUICK
    )
    with pytest.warns(UserWarning, match="no division. The posterior of the round before stays"):
        first, second, third = rounds
    assert first.posterior is second.posterior is third.posterior
    assert divisions[0] is divisions[1]
    assert (second.refused, second.fit.pairs, third.fit.pairs) == (True, 100, 200)


@every_correction
def test_the_same_seed_gives_the_same_rounds(correction):
    def densities(seed):
        options = {"rounds": 2, "simulations": 100, "correction": correction, "seed": seed}
        rounds = sequential(square(0), BOX, OBSERVED, **options, **QUICK)
        return [r.posterior.log_prob(torch.tensor([[-0.5], [1.0]])) for r in rounds]

    before = torch.random.get_rng_state()
    first, again, other = densities(3), densities(3), densities(4)
    assert torch.equal(torch.stack(first), torch.stack(again))
    assert not torch.equal(torch.stack(first), torch.stack(other))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_rounds_belong_to_the_caller_and_later_ones_simulate_where_the_posterior_is():
    asked = []

    def simulator(theta):
        asked.append(theta)
        return square(0)(theta)

    rounds = sequential(
        simulator,
        BOX,
        OBSERVED,
        rounds=100,
        simulations=500,
        correction="importance",
        networks=1,
        **FIT | {"batch_size": 50},
    )
    found = list(itertools.islice(rounds, 2))
    assert [r.index for r in found] == [0, 1]
    assert [len(theta) for theta in asked] == [500] * 2  # the caller stopped: no third
    first, second = (((theta.abs() - 1).abs() < 0.3).float().mean().item() for theta in asked)
    assert first == pytest.approx(0.3, abs=0.06)
    assert second > 0.6
    assert found[0].effective_pairs == pytest.approx(500)
    for index, r in enumerate(found):
        assert r.fit.pairs == 500 * (index + 1)
        assert 0.2 * r.fit.pairs < r.effective_pairs <= r.fit.pairs
    assert all(BOX.contains(theta).all() for theta in asked)


def test_simulations_that_diverge_are_left_out_and_counted():
    def simulator(theta):
        return torch.where(theta > 1.9, torch.nan, theta**2)

    rounds = sequential(simulator, BOX, OBSERVED, rounds=1, simulations=400, **QUICK)
    with pytest.warns(UserWarning, match="pairs are not finite"):
        (only,) = rounds
    assert 0 < only.fit.dropped < 40
    assert only.fit.pairs == 400 - only.fit.dropped


def test_counts_are_summaries_too():
    """Contacts, resets and encoder ticks are whole numbers."""
    counted = sequential(
        lambda theta: (100 * theta).round().long(),
        BOX,
        torch.tensor([[50]]),
        rounds=1,
        simulations=100,
        **QUICK,
    )
    floating = sequential(
        lambda theta: (100 * theta).round(),
        BOX,
        torch.tensor([[50.0]]),
        rounds=1,
        simulations=100,
        **QUICK,
    )
    theta = torch.linspace(-1.9, 1.9, 5)[:, None]
    (one,), (other,) = counted, floating
    assert torch.equal(one.posterior.log_prob(theta), other.posterior.log_prob(theta))


def test_the_analytic_correction_trains_on_the_last_round_alone():
    *_, last = sequential(
        square(0), BOX, OBSERVED, rounds=2, simulations=300, correction="analytic", **QUICK
    )
    assert last.fit.pairs == 300
    assert last.effective_pairs == pytest.approx(300)


def test_a_prior_that_excludes_the_data_is_said():
    far = torch.full((1, 1), 50.0)  # x = θ² is 4 at most
    rounds = sequential(square(0), BOX, far, rounds=1, simulations=400, **QUICK)
    with pytest.warns(UserWarning, match="Does the prior hold the real"):
        list(rounds)


@pytest.mark.parametrize("wrong", [lambda theta: theta[:3], lambda theta: theta[:, 0], list])
def test_a_simulator_gives_one_summary_per_simulation(wrong):
    rounds = sequential(wrong, BOX, OBSERVED, rounds=1, simulations=9, **QUICK)
    with pytest.raises(ValueError, match=r"one summary per simulation, shape \(9, L\), got"):
        next(rounds)


def test_an_unknown_correction_is_refused():
    rounds = sequential(square(0), BOX, OBSERVED, rounds=1, simulations=9, correction="snpe")
    with pytest.raises(ValueError, match=r"expected a correction.*snpe.*importance.*truncated"):
        next(rounds)


NORMAL = GaussianPrior({"theta": (1.0, 2.0)})


@pytest.mark.parametrize(
    ("prior", "make", "error", "text"),
    [
        (NORMAL, None, TypeError, "expected a BoxPrior, of which .*got 'GaussianPrior'. Try: anot"),
        (BOX, lambda size: MixtureDensityPosterior(BOX, size), ValueError, "default networks.*Try"),
    ],
)
def test_focused_rounds_need_boxes_and_the_default_networks(prior, make, error, text):
    options = {"rounds": 1, "simulations": 9, "make_posterior": make}
    with pytest.raises(error, match=text):
        next(sequential(square(0), prior, OBSERVED, correction="focused", **options))
    usual = next(sequential(square(0), prior, OBSERVED, **options, **QUICK))
    assert usual.posterior.prior is prior or make is not None


def test_focused_rounds_use_the_pairs_in_the_last_box_of_rounds_that_drew_from_all_of_it():
    """x = theta to 0.003: rounds resolve what one round over the whole prior cannot."""
    asked = []

    def simulator(theta):
        asked.append(theta)
        return theta + 0.003 * torch.randn(theta.shape, generator=generator("sharp", len(asked)))

    rounds = list(sequential(simulator, BOX, OBSERVED, rounds=3, simulations=400, **FIT_ROUNDS))
    last = rounds[-1]
    box = last.posterior.prior
    drawn_from = [turn.posterior.prior for turn in rounds]
    whole = [(own.low <= box.low) & (own.high >= box.high) for own in drawn_from]
    assert sum(w.all().item() for w in whole) > 1
    inside = [box.contains(theta).sum().item() * w for theta, w in zip(asked, whole, strict=True)]
    assert last.fit.pairs == sum(inside) == last.effective_pairs > 400
    assert (box.high - box.low).item() < 1.0
    assert last.posterior.mean.item() == pytest.approx(1.0, abs=0.0012)
    assert last.posterior.stddev.item() == pytest.approx(0.003, rel=0.25)
    assert abs(rounds[0].posterior.stddev.item() / 0.003 - 1) > 0.3


def test_pairs_of_a_round_that_drew_from_less_than_the_box_are_left_out():
    theta = torch.linspace(-1, 1, 9)[:, None]
    narrow, wide = BoxPrior({"theta": (-0.5, 0.5)}), BoxPrior({"theta": (-1.5, 1.5)})
    history = [(BOX, pairs_of(theta, theta)), (narrow, pairs_of(theta / 2, theta))]
    assert len(_inside(history, wide)) == 9
    assert len(_inside(history, narrow)) == 5 + 9


@pytest.mark.parametrize(
    ("small", "text"),
    [
        ({"rounds": 0}, "rounds to be positive, got 0"),
        ({"simulations": 3}, "at least 4 simulations, got 3"),
        ({"networks": 0}, "networks to be positive, got 0"),
    ],
    ids=str,
)
def test_counts_that_are_too_small_are_refused(small, text):
    options = {"rounds": 1, "simulations": 9} | small
    with pytest.raises(ValueError, match=text):
        next(sequential(square(0), BOX, OBSERVED, **options))


def test_networks_are_averaged():
    options = {"rounds": 1, "simulations": 200, **QUICK}
    components = [
        next(sequential(square(0), BOX, OBSERVED, networks=n, **options)).posterior.mixture
        for n in (1, 3)
    ]
    one, three = components
    assert three.logits.numel() == 3 * one.logits.numel()
    torch.testing.assert_close(three.loc[..., : one.loc.shape[-2], :], one.loc, atol=1e-4, rtol=0)


@pytest.mark.parametrize("observed", [[1.0], [[1]], np.ones((1, 1)), torch.ones(1)], ids=repr)
def test_lists_and_arrays_may_be_observed(observed):
    options = {"rounds": 1, "simulations": 64, **QUICK}
    (turn,), (same,) = (sequential(square(0), BOX, x, **options) for x in (observed, OBSERVED))
    assert torch.equal(turn.posterior.mixture.loc, same.posterior.mixture.loc)


@pytest.mark.parametrize(
    ("bad", "error", "text"),
    [
        ({"observed": "x"}, TypeError, "numbers, the summaries of real trajectories, got 'x'"),
        ({"observed": []}, ValueError, r"trajectories, shape \(L,\) or \(n, L\), got \(0,\)"),
        ({"prior": torch.distributions.Normal(0.0, 1.0)}, TypeError, "named param.*got 'Normal'"),
        ({"prior_share": 7}, ValueError, "prior_share to be a probability, 0 to 1, got 7"),
        ({"epoch": 3}, ValueError, r"an option of fit, got 'epoch'.*epochs \(did you mean"),
    ],
    ids=str,
)
def test_what_cannot_be_is_refused_before_simulating(bad, error, text):
    def never(theta):
        raise AssertionError("simulated")

    options = {"prior": BOX, "observed": OBSERVED, "rounds": 1, "simulations": 9} | bad
    with pytest.raises(error, match=text):
        next(sequential(never, options.pop("prior"), options.pop("observed"), **options))
