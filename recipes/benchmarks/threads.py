"""How far apart are weights that were learned with one thread of torch and with two?

Fits a posterior to 1,000 pairs, and updates PPO once from 128 environments of CartPole, with the
same seeds; one thread twice, which must give the same, then ``threads``. Prints one JSON line each:
the largest difference, and the seconds they took::

    python recipes/benchmarks/threads.py [threads=2]
"""

from __future__ import annotations

import sys
import time

import torch
from measuring import options, report
from tensordict import TensorDict
from torch import Tensor

from torchrl_bayessim import BoxPrior, MixtureDensityPosterior, fit
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.randomness import generator, isolated


def learned(threads: int) -> dict[str, Tensor]:
    """Return the weights, flat, of a posterior after 10 epochs and a policy after an update."""
    torch.set_num_threads(threads)
    theta = torch.rand(1000, 2, generator=generator(0, "theta"))
    noise = torch.randn(1000, 18, generator=generator(0, "summary"))
    pairs = TensorDict({"theta": theta, "summary": torch.cat([theta, noise], -1)}, [1000])
    posterior = MixtureDensityPosterior(BoxPrior({"a": (0.0, 1.0), "b": (0.0, 1.0)}), 20)
    fit(posterior, pairs, epochs=10, progress=False)
    env = CartPoleEnv(128, max_steps=100, seed=0)
    ppo = PPO(env, minibatch_size=4096, epochs=4)
    with isolated(0, "rollout"), torch.no_grad():
        batch = env.rollout(128, ppo.policy, break_when_any_done=False)
    ppo.update(batch, key=(0,))
    return {
        name: torch.cat([weight.detach().flatten() for weight in module.parameters()])
        for name, module in {"posterior": posterior, "policy": ppo.policy}.items()
    }


def main(*arguments: str) -> None:
    """Learn thrice, and compare."""
    more = options(list(arguments), threads=2)["threads"]
    first = learned(1)
    for threads in (1, more):
        start = time.perf_counter()
        weights = learned(threads)
        told = {"seed": 0, "threads": threads, "seconds": round(time.perf_counter() - start, 1)}
        for name, values in weights.items():
            far = (values - first[name]).abs().max().item()
            report("threads", name, [far], unit="largest difference of a weight", **told)


if __name__ == "__main__":
    main(*sys.argv[1:])
