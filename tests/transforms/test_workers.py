import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import Compose, GymEnv, ParallelEnv, SerialEnv, TransformedEnv

from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.sources import Grid
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

PRIOR = BoxPrior({"length": (0.1, 2.0), "masspole": (0.1, 2.0)})


def inside(source=PRIOR, **options):
    """An environment with both transforms, as a batched environment's function may make it."""
    physics = ApplyPhysics(AttributePhysics("length", "masspole"))
    randomizer = DomainRandomizer(source, **options)
    return TransformedEnv(GymEnv("CartPole-v1"), Compose(physics, randomizer))


def serial(count, make=inside):
    return SerialEnv(count, make)


def thetas(env, *, seed, resets=2):
    env.set_seed(seed)
    found = torch.stack([env.reset()["theta"] for _ in range(resets)])
    env.close(raise_if_closed=False)
    return found


def test_workers_draw_differently_and_the_same_seed_gives_the_same_draws():
    first = thetas(serial(3), seed=0)
    assert len(first.flatten(0, 1).unique(dim=0)) == 6
    assert torch.equal(thetas(serial(3), seed=0), first)
    assert not torch.isin(thetas(serial(3), seed=1), first).any()


def test_one_process_or_several_makes_no_difference():
    processes = ParallelEnv(2, inside, mp_start_method="spawn")
    assert torch.equal(thetas(serial(2), seed=3), thetas(processes, seed=3))


def test_a_collector_of_such_workers_records_different_parameters():
    env = serial(2)
    env.set_seed(0)
    collector = Collector(env, None, frames_per_batch=20, total_frames=20)
    theta = next(iter(collector))["theta"][:, 0]
    collector.shutdown()
    assert (theta[0] != theta[1]).all()


def test_workers_that_nothing_tells_apart_are_an_error():
    env = serial(2)
    with pytest.raises(
        PhysicsError, match=r"workers .* apart, got 'no seed yet'.* the randomizer outside, Transf"
    ):
        env.reset()


def test_a_grid_needs_the_numbers_of_its_environments():
    points = Grid([[0.5, 0.2], [0.6, 0.3]])
    env = serial(2, lambda: inside(points))
    env.set_seed(0)
    with pytest.raises(PhysicsError, match=r"a Grid, which goes by their numbers.*first_env"):
        env.reset()
    makers = [lambda i=i: inside(points, first_environment=i) for i in range(2)]
    assert torch.equal(SerialEnv(2, makers).reset()["theta"], points.theta)


def test_alone_the_seed_of_the_simulator_changes_no_draw():
    one, other = inside(), inside()
    one.set_seed(5)
    assert torch.equal(one.reset()["theta"], other.reset()["theta"])


def test_two_entries_of_an_environment_are_drawn_independently():
    def make(seed):
        return TransformedEnv(
            GymEnv("CartPole-v1"),
            Compose(
                ApplyPhysics(AttributePhysics("length"), key="one"),
                ApplyPhysics(AttributePhysics("masspole"), key=("other", "two")),
                DomainRandomizer(PRIOR_OF_LENGTH, key="one", seed=seed),
                DomainRandomizer(PRIOR_OF_MASS, key=("other", "two"), seed=seed, pool=50),
            ),
        )

    resets = [make(seed).reset() for seed in range(40)]
    one = torch.cat([td["one"] for td in resets])
    two = torch.cat([td["other", "two"] for td in resets])
    assert abs(torch.corrcoef(torch.stack([one, two]))[0, 1]) < 0.5
    assert not torch.isin(one, two).any()


PRIOR_OF_LENGTH = BoxPrior({"length": (0.1, 2.0)})
PRIOR_OF_MASS = BoxPrior({"masspole": (0.1, 2.0)})


def test_float64_as_the_default_does_not_change_the_draws():
    expected = inside().reset()["theta"]
    torch.set_default_dtype(torch.float64)
    try:
        theta = inside().reset()["theta"]
    finally:
        torch.set_default_dtype(torch.float32)
    assert theta.dtype == torch.float32
    torch.testing.assert_close(theta, expected, rtol=1e-6, atol=0)
