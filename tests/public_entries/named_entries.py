"""What README names with its module."""

from types import SimpleNamespace

import torch
from entry import Entry
from makers import (
    PRIOR,
    QUICK,
    cartpole,
    pairs,
    posterior,
)

import torchrl_bayessim as package
from torchrl_bayessim.agents.ddpg import DDPG
from torchrl_bayessim.agents.hindsight import HindsightReplayBuffer
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.tasks.fetch import goal_reward
from torchrl_bayessim.excitation import excite
from torchrl_bayessim.inference.trust import trust
from torchrl_bayessim.remote_source import PolicyWithSource, push_source
from torchrl_bayessim.sbi_source import SbiSource


class Sampled:
    """Stands for a posterior of sbi."""

    def sample(self, shape, x=None, show_progress_bars=True):
        return torch.ones(*shape, 1)


def trusted():
    made = posterior()
    package.fit(made, pairs(), **QUICK)
    return made


def collector():
    policy = PolicyWithSource(PPO(cartpole()).policy, PRIOR, draws=8)
    return SimpleNamespace(policy=policy, update_policy_weights_=lambda weights: None)


def goals():
    return package.BatchedMujocoEnv("FetchReach-v4", 2, threads=1)


ENTRIES = {
    "excitation.excite": Entry(
        excite,
        lambda: {
            "simulate": lambda theta, actions: theta[:, None, None] * actions.cumsum(1),
            "theta": torch.tensor([[1.0], [2.0]]),
            "noise": torch.ones(1),
            "bounds": (-torch.ones(1), torch.ones(1)),
            "steps": 3,
            "knots": 2,
            "candidates": 4,
            "rounds": 1,
        },
        {
            "simulate": "function",
            "theta": "parameters",
            "noise": "deviations",
            "bounds": "bounds",
            "steps": "count",
            "knots": "count",
            "candidates": "count",
            "rounds": "count",
        },
    ),
    "inference.trust.trust": Entry(
        trust,
        lambda: {
            "network": trusted(),
            "observed": torch.tensor([0.5]),
            "held_out": None,
            "simulate": None,
            "simulations": 99,
        },
        {
            "network": "object",
            "observed": "summary",
            "held_out": "object or none",
            "simulate": "function or none",
            "simulations": "count",
        },
    ),
    "sbi_source.SbiSource": Entry(
        SbiSource,
        lambda: {"posterior": Sampled(), "observed": None, "names": ["length"]},
        {"posterior": "object", "names": "names"},
    ),
    "remote_source.push_source": Entry(
        push_source,
        lambda: {"collector": collector(), "source": PRIOR, "key": (0,)},
        {"collector": "object", "source": "object", "key": "draw key"},
    ),
    "agents.hindsight.HindsightReplayBuffer": Entry(
        HindsightReplayBuffer,
        lambda: {"reward": goal_reward, "capacity": 8, "share": 0.8, "moving": None},
        {
            "reward": "function",
            "capacity": "count",
            "share": "share",
            "moving": "distance or none",
        },
    ),
    "agents.ddpg.DDPG": Entry(
        DDPG,
        lambda: {
            "env": goals(),
            "reward": goal_reward,
            "algorithm": "ddpg",
            "actor_every": 2,
            "gamma": 0.9,
            "learning_rate": 1e-3,
            "tau": 0.1,
            "batch_size": 4,
            "capacity": 8,
            "relabelled": 0.5,
            "hidden": (4,),
        },
        {
            "env": "object",
            "reward": "function",
            "algorithm": "name",
            "actor_every": "count or none",
            "gamma": "share",
            "learning_rate": "rate",
            "tau": "share",
            "batch_size": "count",
            "capacity": "count",
            "relabelled": "share",
            "hidden": "widths",
        },
    ),
}
