"""Memory does not grow with the episodes that environments run; an hour of it is a benchmark."""

import gc
import tracemalloc
from pathlib import Path

import pytest
import torch
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv

from torchrl_bayessim import episode_draws
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.randomness import isolated
from torchrl_bayessim.simulate import make_collector, next_batch
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

LENGTH, STEPS, WARM, BATCHES = 5, 20, 10, 20  # of an episode, of a batch, batches


class Hoarder(DomainRandomizer):
    """A randomizer that keeps what it has drawn."""

    def _reset(self, tensordict, tensordict_reset):
        found = super()._reset(tensordict, tensordict_reset)
        self.__dict__.setdefault("hoard", []).append(found.get(self.key).clone())
        return found


def cartpole():
    prior = BoxPrior({"length": (0.1, 2.0), "masspole": (0.1, 2.0)})
    return CartPoleEnv(64), prior, AttributePhysics(*prior.names)


def hopper():
    prior = BoxPrior({"body_mass[torso]": (2.0, 6.0)})
    return BatchedMujocoEnv("Hopper-v5", 16), prior, MujocoPhysics(*prior.names)


def tensors():
    """Return the bytes of all tensors that something holds."""
    gc.collect()
    held = {}
    for found in gc.get_objects():
        if issubclass(type(found), torch.Tensor) and found.layout == torch.strided:
            storage = found.untyped_storage()
            held[storage.data_ptr()] = storage.nbytes()
    return sum(held.values())


def resident():
    """Return the bytes of the process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def growth(make, randomizer=DomainRandomizer):
    """Return by how many bytes tensors, Python's objects and the process grow, and the episodes."""
    env, prior, physics = make()
    transforms = [ApplyPhysics(physics), randomizer(prior), StepCounter(LENGTH), RewardSum()]
    collector = make_collector(TransformedEnv(env, Compose(*transforms)), None, steps=STEPS)
    seen, episodes = [], 0
    tracemalloc.start()
    try:
        with isolated("memory"):
            for number in range(WARM + BATCHES):
                episodes += int(next_batch(collector)["next", "done"].sum())
                if number in {WARM - 1, WARM + BATCHES - 1}:
                    seen.append((tensors(), tracemalloc.get_traced_memory()[0], resident()))
    finally:
        tracemalloc.stop()
        collector.shutdown()
    return *(late - early for early, late in zip(*seen, strict=True)), episodes


@pytest.fixture(autouse=True)
def few_tables(monkeypatch):
    """Let the store of draws, of at most 4,096 tables, be full before anything is measured."""
    monkeypatch.setattr(episode_draws, "_TABLES", 8)


@pytest.mark.parametrize("make", [cartpole, pytest.param(hopper, marks=pytest.mark.slow)])
def test_episodes_leave_nothing_behind(make):
    held, traced, whole, episodes = growth(make)
    assert episodes > 1_000
    assert held < 2_000
    assert traced < 150_000
    assert (
        whole < 2**25
    )  # what neither counts: a MuJoCo model of each episode would be 30 MiB or more


def test_what_is_kept_would_show():
    held, *_ = growth(cartpole, Hoarder)
    assert held >= BATCHES * (STEPS // LENGTH) * 64 * 2 * 4
