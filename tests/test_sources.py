import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_bayessim.episode_draws import EpisodeDraws
from torchrl_bayessim.sources import Defensive, Empirical, Grid, draw


class Normal:
    def __init__(self, loc, names=None):
        self.loc, self.names = loc, names

    def sample(self, shape, *, generator):
        return self.loc + torch.randn((*shape, 2), generator=generator)


GLOBAL = torch.distributions.Normal(torch.zeros(2), torch.ones(2))


@pytest.mark.parametrize("source", [Normal(0.0), GLOBAL], ids=["generator", "global"])
def test_draw_is_a_function_of_its_key_and_leaves_global_generators_alone(source):
    state = torch.random.get_rng_state()
    a, b, c = (draw(source, 5, key=key) for key in [(0, "a"), (0, "a"), (0, "b")])
    assert torch.equal(a, b)
    assert (a != c).all()
    assert torch.equal(state, torch.random.get_rng_state())


@pytest.mark.parametrize(
    ("theta", "match"),
    [
        (torch.zeros(3), r"draws of shape \(3, D\) .* got \(3,\)"),
        (torch.tensor([[0.0], [torch.nan], [1.0]]), r"finite draws .* got \[nan\]"),
    ],
)
def test_draw_refuses_bad_samples(theta, match):
    class Bad:
        def sample(self, shape):
            return theta

    with pytest.raises(ValueError, match=match):
        draw(Bad(), 3, key=(0,))


def test_defensive_draws_from_the_prior_as_often_as_its_weight():
    source = Defensive(Normal(0.0), Normal(100.0), 0.25)
    theta = draw(source, 10_000, key=(0,))
    assert (theta[:, 0] > 50).double().mean() == pytest.approx(0.25, abs=0.02)
    assert ((theta[:, 0] > 50) == (theta[:, 1] > 50)).all()


def test_defensive_refuses_other_names_and_impossible_weights():
    with pytest.raises(ValueError, match=r"a prior over \('a', 'b'\)"):
        Defensive(Normal(0.0, ("a", "b")), Normal(0.0, ("b", "a")), 0.1)
    with pytest.raises(ValueError, match="prior_share to be a probability"):
        Defensive(Normal(0.0), Normal(0.0), 1.5)
    assert Defensive(Normal(0.0), Normal(0.0, ("a", "b")), 0.1).names == ("a", "b")


def test_empirical_draws_every_row_equally_often():
    theta = draw(Empirical([[0.0], [1.0], [2.0]]), 9_000, key=(0,))
    counts = torch.bincount(theta.flatten().long()) / 9_000
    torch.testing.assert_close(counts, torch.full((3,), 1 / 3), rtol=0, atol=0.02)


@pytest.mark.parametrize("make", [Empirical, Grid])
@pytest.mark.parametrize("theta", [[0.0, 1.0], torch.zeros(0, 2), [[torch.inf]]])
def test_rows_are_checked(make, theta):
    with pytest.raises(ValueError, match=r"rows of shape \(M, D\)|finite rows"):
        make(theta)


indices = st.lists(st.tuples(st.integers(0, 200), st.integers(0, 5)), min_size=1, max_size=20)


@given(indices, st.randoms())
def test_episode_draws_depend_on_environment_and_episode_alone(pairs, random):
    draws = EpisodeDraws(Normal(0.0), seed=3)
    together = draws(*torch.tensor(pairs).T)
    shuffled = random.sample(range(len(pairs)), len(pairs))
    fresh = EpisodeDraws(Normal(0.0), seed=3)
    for i in shuffled:
        assert torch.equal(fresh(*torch.tensor([pairs[i]]).T)[0], together[i])


def test_episode_draws_follow_the_source_and_differ_between_environments_and_episodes():
    draws = EpisodeDraws(Normal(5.0))
    environments = torch.arange(1000).repeat(3)
    theta = draws(environments, torch.arange(3).repeat_interleave(1000))
    assert len(theta.unique(dim=0)) == 3000
    torch.testing.assert_close(theta.mean(0), torch.full((2,), 5.0), rtol=0, atol=0.1)
    torch.testing.assert_close(theta.std(0), torch.ones(2), rtol=0, atol=0.1)


def test_episode_draws_remember_a_bounded_number_of_tables():
    calls = []

    class Counting(Normal):
        def sample(self, shape, *, generator):
            calls.append(1)
            return super().sample(shape, generator=generator)

    draws = EpisodeDraws(Counting(0.0))
    for environment in range(64):
        draws(torch.tensor([environment]), torch.tensor([7]))
    assert len(calls) == 1
    for episode in range(5000):
        draws(torch.tensor([0]), torch.tensor([episode]))
    assert len(draws._tables) == 4096


def test_pool_needs_a_source_that_samples():
    with pytest.raises(ValueError, match="draws in a pool to be positive, got 0"):
        EpisodeDraws(Normal(0.0), pool=0)
    with pytest.raises(ValueError, match="a source that samples, to draw a pool from, got 'a G"):
        EpisodeDraws(Grid([[0.0]]), pool=3)
