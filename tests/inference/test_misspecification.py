import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_bayessim.inference.misspecification import doubts, piled_up, strangeness
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture
from torchrl_bayessim.randomness import generator

BOX = BoxPrior({"mass": (2.0, 6.0), "drag": (0.01, 1.0)}, log=["drag"])


def gaussian(prior, loc, scale):
    mixture = TruncatedGaussianMixture(
        torch.zeros(1), torch.tensor([loc]), scale * torch.eye(2)[None], prior.box, diagonal=True
    )
    return PhysicsPosterior(mixture, prior)


WITHIN = gaussian(BOX, [0.0, 0.0], 0.3)


def heavy(count):
    """Summaries with tails so long that their variance does not exist."""
    return torch.randn(count, 6) / torch.rand(count, 1)


def edge(count):
    """Summaries that pile up at one end, as episode lengths do."""
    return torch.rand(count, 6).pow(8)


def redundant(count):
    """Twenty statistics of one number, and a constant one."""
    one = torch.randn(count, 1)
    return torch.cat([one.expand(-1, 20), torch.full((count, 1), 3.0)], -1)


@pytest.mark.parametrize("kind", [lambda n: torch.randn(n, 30), heavy, edge, redundant])
def test_a_model_that_holds_is_doubted_as_rarely_as_was_promised(kind):
    """A law of exchangeability, whatever the distribution: once in N + 1 times at most."""
    trials, count = 500, 59
    alarms = 0
    for _ in range(trials):
        rows = kind(count + 1)
        alarms += len(doubts(rows[1:], rows[0], WITHIN))
    expected = trials / (count + 1)
    assert alarms <= expected + 3 * expected**0.5


@given(st.integers(0, 29), st.sampled_from([-1.0, 1.0]), st.floats(15.0, 1e6))
def test_one_statistic_far_out_among_thirty_is_found_and_named(index, sign, size):
    simulated = torch.randn(200, 30, generator=torch.Generator().manual_seed(index))
    observed = torch.zeros(30)
    observed[index] = sign * size
    share, deviation = strangeness(simulated, observed)
    assert share == pytest.approx(1 / 201)
    assert int(deviation.abs().argmax()) == index
    assert deviation[index].sign() == sign
    (doubt,) = doubts(simulated, observed, WITHIN)
    assert "1 of 1 real summaries lie as far out as the 0.7% of 200 simulated ones" in doubt
    assert f"number {index} by {abs(deviation[index]):.3g}" in doubt


def test_a_combination_that_never_occurs_is_found_though_each_statistic_does():
    common = torch.randn(300, 1)
    simulated = torch.cat([common, common + 0.01 * torch.randn(300, 1)], -1)
    share, deviation = strangeness(simulated, torch.tensor([1.5, -1.5]))
    assert share == pytest.approx(1 / 301)
    assert (deviation.abs() < 2).all()


def test_a_statistic_that_simulation_never_changes_and_reality_does():
    simulated = torch.randn(100, 3)
    simulated[:, 1] = 5.0
    share, deviation = strangeness(simulated, torch.tensor([0.0, 5.0, 0.0]))
    assert share > 0.1
    assert deviation[1] == 0
    share, deviation = strangeness(simulated, torch.tensor([0.0, 5.1, 0.0]))
    assert share == pytest.approx(1 / 101)
    assert int(deviation.abs().argmax()) == 1


def test_rounding_is_no_deviation():
    simulated = torch.cat([torch.randn(100, 2), torch.full((100, 1), 1000.0)], -1)
    observed = torch.tensor([0.0, 0.0, 1000.0001])
    assert strangeness(simulated, observed)[0] > 0.1


def test_simulations_that_diverged_are_not_compared_with():
    simulated = torch.randn(100, 3)
    simulated[::2] = torch.nan
    assert strangeness(simulated, torch.zeros(3))[0] > 0.1
    (doubt,) = doubts(simulated, torch.full((3,), 20.0), WITHIN)
    assert "of 50 simulated" in doubt


def test_too_few_simulations_cannot_tell():
    assert doubts(torch.randn(49, 3), torch.full((3,), 20.0), WITHIN) == []
    assert len(doubts(torch.randn(50, 3), torch.full((3,), 20.0), WITHIN)) == 1


def test_several_real_trajectories_are_counted():
    observed = torch.cat([torch.zeros(2, 3), torch.full((1, 3), 20.0)])
    (doubt,) = doubts(torch.randn(100, 3), observed, WITHIN)
    assert "1 of 3 real summaries" in doubt


def test_many_right_trajectories_are_doubted_no_more_often_than_one():
    alarms = 0
    for _ in range(60):
        simulated, observed = torch.randn(200, 4), torch.randn(40, 4)
        alarms += len(doubts(simulated, observed, WITHIN))
    assert alarms <= 2  # a fifth of the rows' sets have one among the furthest 0.7 %


def test_what_no_parameter_explains_is_found_by_few_times_the_noise():
    """Twelve statistics of four parameters: eight of their combinations never vary but by noise."""
    effects = torch.randn(4, 12, generator=generator("effects"))
    basis = torch.linalg.qr(effects.mT).Q
    way = torch.randn(12, generator=generator("way"))
    way = way - basis @ (basis.mT @ way)

    def simulated(count):
        return (2 * torch.rand(count, 4) - 1) @ effects + 0.02 * torch.randn(count, 12)

    rows, robot = simulated(1000), simulated(1)[0] + 0.2 * way / way.norm()
    share, deviation = strangeness(rows, robot)
    assert share == pytest.approx(1 / 1001)
    assert (deviation.abs() < 2).all()
    (doubt,) = doubts(rows, robot, WITHIN)
    assert "none is off by itself: their combination does not occur" in doubt


def test_many_simulations_are_compared_with_in_part():
    share, _ = strangeness(torch.randn(50_000, 3), torch.full((3,), 20.0))
    assert share == pytest.approx(1 / 1001)


def test_a_posterior_at_an_edge_is_named():
    edge = 3**0.5
    posterior = gaussian(BOX, [0.0, -2 * edge], 0.1)
    ((name, which, share),) = piled_up(posterior)
    assert (name, which) == ("drag", "lower")
    assert share > 0.5
    (doubt,) = doubts(torch.randn(50, 2), torch.zeros(2), posterior)
    assert "of the posterior of 'drag' lie at the lower edge of BoxPrior(mass: [2, 6], " in doubt
    assert [row[:2] for row in piled_up(gaussian(BOX, [9.0, 9.0], 0.1))] == [
        ("mass", "upper"),
        ("drag", "upper"),
    ]


@pytest.mark.parametrize("scale", [0.1, 0.5, 3.0])
def test_a_posterior_inside_or_as_wide_as_the_prior_is_at_no_edge(scale):
    assert piled_up(gaussian(BOX, [1.0, -1.0], scale)) == []


def test_a_prior_without_edges_has_none():
    prior = GaussianPrior({"a": (0.0, 1.0), "b": (0.0, 1.0)})
    assert piled_up(gaussian(prior, [50.0, 0.0], 0.1)) == []


def test_one_absurd_simulation_hides_no_strange_summary():
    rows = torch.randn(200, 2, generator=generator("rows"))
    rows[17, 1] = 3e38
    share, deviation = strangeness(rows, torch.tensor([0.0, 30.0]))
    assert share == pytest.approx(2 / 201)  # the absurd one lies further out
    assert deviation[1] > 20
    assert strangeness(rows, torch.zeros(2))[0] > 0.1
