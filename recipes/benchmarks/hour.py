"""Does memory grow while 1,024 environments run for an hour of simulated time?

CartPole (180,000 steps of 0.02 s) with random actions, new physics in every episode, through the
collector that everything else uses. Prints one JSON line: growth of the process's own memory from
the second tenth to the last, in MiB, and the frames per second::

    python recipes/benchmarks/hour.py [environments=1024] [minutes=60] [mujoco=0]

``mujoco=1`` runs Hopper (steps of 0.008 s) instead, in batched MuJoCo.
"""

from __future__ import annotations

import sys
import time

import torch
from many_pairs import memory
from measuring import options, report
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv

from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.randomness import isolated
from torchrl_bayessim.simulate import make_collector, next_batch
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

BATCH = 100  # steps


def simulator(environments: int, *, mujoco: bool) -> tuple[EnvBase, float]:
    """Return the environments, with new physics in every episode, and the seconds of a step."""
    if mujoco:
        prior = BoxPrior({"body_mass[torso]": (2.0, 6.0)})
        base: EnvBase = BatchedMujocoEnv("Hopper-v5", environments)
        physics, step = MujocoPhysics(*prior.names), 0.008
    else:
        prior = BoxPrior({"length": (0.1, 2.0), "masspole": (0.1, 2.0)})
        base, physics, step = CartPoleEnv(environments), AttributePhysics(*prior.names), 0.02
    transforms = [ApplyPhysics(physics), DomainRandomizer(prior), StepCounter(500), RewardSum()]
    return TransformedEnv(base, Compose(*transforms)), step


def main(*arguments: str) -> None:
    """Run for as long as was asked, and compare the memory."""
    given = options(list(arguments), optional=["mujoco"], environments=1024, minutes=60, mujoco=0)
    torch.set_num_threads(1)
    env, step = simulator(given["environments"], mujoco=bool(given["mujoco"]))
    batches = round(60 * given["minutes"] / step / BATCH)
    collector = make_collector(env, None, steps=BATCH)
    seen, episodes, begun = [], 0, time.perf_counter()
    with isolated("hour"):
        for _ in range(batches):
            episodes += int(next_batch(collector)["next", "done"].sum())
            seen.append(memory()[0])
    seconds = time.perf_counter() - begun
    early, late = seen[batches // 10 :], seen[-max(1, batches // 10) :]
    frames = batches * BATCH * given["environments"]
    report(
        "hour",
        "hopper" if given["mujoco"] else "cartpole",
        [max(late) - max(early[: len(late)])],
        unit="MiB",
        seed=0,
        threads=1,
        **given,
        frames=frames,
        episodes=episodes,
        frames_per_second=round(frames / seconds),
        own=round(max(seen), 1),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
