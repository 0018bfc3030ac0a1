"""Every count of the public functions is refused in words if it is no whole number."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from torchrl_bayessim.agents.hindsight import HindsightReplayBuffer
from torchrl_bayessim.counts import check_count
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.evaluation import evaluate
from torchrl_bayessim.excitation import excite
from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.inference.sequential import sequential
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.robots import SurrogateRobot
from torchrl_bayessim.simulate import simulate
from torchrl_bayessim.summaries import SummaryStatistics, autocorrelation, moments, waypoints
from torchrl_bayessim.trainer import PosteriorTrainerHook
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

PRIOR = BoxPrior({"length": (0.2, 1.5)})
STATISTICS = SummaryStatistics(moments)


def pairs(**counts):
    randomizer = DomainRandomizer(PRIOR)
    physics = ApplyPhysics(AttributePhysics("length"))
    env = TransformedEnv(CartPoleEnv(2), Compose(physics, randomizer))
    options = {"pairs": 4, "max_steps": 3} | counts
    return simulate(env, None, STATISTICS, randomizer, **options, progress=False)


def robot(max_steps):
    env = TransformedEnv(CartPoleEnv(2), ApplyPhysics(AttributePhysics("length")))
    return SurrogateRobot(env, [0.6], max_steps=max_steps)


def fitted(**counts):
    data = TensorDict({"theta": PRIOR.sample((8,)), "summary": torch.rand(8, 1)}, [8])
    fit(MixtureDensityPosterior(PRIOR, 1), data, **counts, progress=False)


def rounds(**counts):
    options = {"rounds": 1, "simulations": 9} | counts
    next(sequential(lambda theta: theta, PRIOR, torch.tensor([0.5]), **options))


def hook(**counts):
    refinement = PosteriorRefinement(PRIOR)
    PosteriorTrainerHook(robot(3), refinement=refinement, statistics=STATISTICS, **counts)


def excited(**counts):
    options = {"steps": 5} | counts
    bounds, noise = (-torch.ones(1), torch.ones(1)), torch.ones(1)
    excite(lambda theta, actions: actions, torch.ones(2, 1), noise=noise, bounds=bounds, **options)


COUNTS = {
    "components": lambda: MixtureDensityPosterior(PRIOR, 3, components=2.0),
    "summary_dim": lambda: MixtureDensityPosterior(PRIOR, 3.0),
    "simulations": lambda: PosteriorRefinement(PRIOR, simulations=1e3),
    "networks": lambda: PosteriorRefinement(PRIOR, networks=2.5),
    "pairs": lambda: pairs(pairs=10.0),
    "max_steps": lambda: pairs(max_steps=8.0),
    "trajectories": lambda: pairs(trajectories="2"),
    "rounds": lambda: rounds(rounds=1.0),
    "simulations ": lambda: rounds(simulations=64.0),
    "max_steps ": lambda: robot(16.0),
    "episodes": lambda: robot(4).rollouts(None, episodes=1.5, key=(0,)),
    "episodes ": lambda: hook(episodes=2.0),
    "batches per interval": lambda: hook(interval=2.5),
    "epochs": lambda: fitted(epochs=2.0),
    "batch_size": lambda: fitted(batch_size=None),
    "steps of a lag": lambda: autocorrelation(1.5),
    "draws in a pool": lambda: DomainRandomizer(PRIOR, pool=2.5),
    "transitions of capacity": lambda: HindsightReplayBuffer(None, capacity=1e6),
    "waypoints": lambda: waypoints(2.5),
    "knots": lambda: excited(knots=3.0),
    "candidates": lambda: excited(candidates=3.0),
    "max_steps  ": lambda: evaluate(CartPoleEnv(1), None, max_steps=5.0),
}


@pytest.mark.parametrize("name", COUNTS)
def test_counts_are_whole_numbers(name):
    with pytest.raises(TypeError, match=f"a whole number of {name.strip()}, got"):
        COUNTS[name]()


def test_whole_numbers_of_any_kind_are_counts():
    for value in (3, np.int64(3), torch.tensor(3)):
        check_count("steps", value, least=3)
        with pytest.raises(ValueError, match="at least 4 steps, got 3"):
            check_count("steps", value, least=4)
    with pytest.raises(TypeError, match=r"a whole number of steps, got 1000\.0\. Try: 1000"):
        check_count("steps", 1e3)


def test_counts_that_would_not_end_are_refused():
    check_count("epochs", 10**15)
    with pytest.raises(
        ValueError, match="at most 1000000000000000 epochs, got 100000000000000000000"
    ):
        fitted(epochs=10**20)
