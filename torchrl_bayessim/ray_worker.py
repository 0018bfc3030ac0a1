"""One worker of `RayCollectors`: a TorchRL collector in a process of Ray's.

What it answers depends on nothing but the question, so that one which dies can be begun anew and
asked again, with the same answer.
"""

from __future__ import annotations

__all__ = ["Block", "Inference", "RayWorker", "described", "randomizer_of"]

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from .errors import message
from .randomness import isolated, seed_from
from .simulate import collect_summaries, make_collector, next_batch
from .summaries import SummaryStatistics
from .transforms.apply_physics import ApplyPhysics
from .transforms.domain_randomizer import DomainRandomizer, randomizers
from .transforms.resets import simulator, transforms_of


@dataclass(frozen=True)
class Inference:
    """What to simulate for inference."""

    policy: TensorDictModuleBase | None
    statistics: SummaryStatistics
    trajectories: int
    steps: int
    key: tuple[int | str, ...]
    prepare: Callable[[TensorDictBase], TensorDictBase]


@dataclass(frozen=True)
class Block:
    """What training batches go on from: nothing that a worker keeps to itself."""

    source: Any
    seed: int
    episodes: Tensor  # begun so far, of all environments
    key: tuple[int | str, ...]


class RayWorker(Collector):
    """A collector of some environments, that simulates for inference with all of them."""

    def __init__(
        self, create_env_fn: Callable[[], EnvBase], *, whole: Callable[[], EnvBase], **options: Any
    ) -> None:
        torch.set_num_threads(1)
        self.number: int = options["worker_idx"]
        super().__init__(create_env_fn, **options)  # pyright: ignore[reportArgumentType]
        self._make_whole: Callable[[], EnvBase] = whole
        self._whole: EnvBase | None = None
        self._at: tuple[Any, int] | None = None  # block, and batches of it so far

    def __bool__(self) -> bool:  # Ray asks before it sends an error; there is no length to tell
        return True

    def __repr__(self) -> str:  # which Ray prints before every line of a worker
        return f"{type(self).__name__}({self.number})"

    def described(self) -> dict[str, str]:
        """Return what this worker simulates: see the function."""
        return described(self.env)

    def summarise(
        self, question: Inference | None, theta: Tensor, first: int, keep: int
    ) -> tuple[Tensor, list[TensorDictBase]]:
        """Return the summaries at ``theta``, the first batch of which has this number."""
        if question is None:
            return torch.empty(0), []
        if self._whole is None:
            self._whole = self._make_whole()
        collector = make_collector(self._whole, question.policy, steps=question.steps)
        try:
            return collect_summaries(
                collector,
                question.statistics,
                randomizer_of(self._whole),
                theta,
                trajectories=question.trajectories,
                key=question.key,
                prepare=question.prepare,
                first=first,
                keep=max(0, keep - first),
                progress=False,
            )
        finally:
            collector.shutdown(close_env=False)

    def collect(self, block: Block, weights: list[Any]) -> tuple[TensorDictBase, Tensor]:
        """Return the batch of the last weights, and the episodes begun so far.

        A worker that has not made the batches before it makes them again.
        """
        import ray  # pyright: ignore[reportMissingImports]

        randomizer, before = randomizer_of(self.env), len(weights) - 1
        if self._at != (block.key, before):
            self._restart(block, randomizer)
            for step in range(before):
                self._next(block, step, ray.get(weights[step]))
        batch = self._next(block, before, ray.get(weights[-1]))
        self._at = (block.key, len(weights))
        return batch.reshape(-1, batch.shape[-1]), randomizer.get_extra_state()["episodes"]

    def _next(self, block: Block, step: int, weights: dict[str, Any]) -> Any:
        policy: Any = self.policy
        policy.td_module.load_state_dict(weights)
        with isolated(*block.key, "worker", self.number, step):
            return next_batch(self)

    def _restart(self, block: Block, randomizer: DomainRandomizer) -> None:
        worker, count = self.number, self.n_env
        randomizer.source = block.source
        mine = block.episodes[worker * count : (worker + 1) * count]
        randomizer.set_extra_state({"seed": block.seed, "episodes": mine})
        with isolated(*block.key, "reset", worker):
            self.set_seed(seed_from(*block.key, "env", worker) % 2**31)
            self.reset()


def described(env: EnvBase) -> dict[str, str]:
    """Return what tells an environment from another, whatever its number of simulations.

    Its simulator, the parameters that are written, and the columns of its entries.
    """
    found = {"simulator": type(simulator(env)).__name__}
    for physics in transforms_of(env, ApplyPhysics):
        found[f"parameters in {physics.key!r}"] = ", ".join(physics.names)
    for specs in (env.full_observation_spec, env.full_action_spec):
        for key, spec in specs.items(include_nested=True, leaves_only=True):
            found[f"columns of {key!r}"] = str(tuple(spec.shape[env.ndim :]))
    return found


def randomizer_of(env: EnvBase) -> DomainRandomizer:
    """Return the randomizer of an environment."""
    found = next(randomizers(env), None)
    if found is None:
        raise ValueError(message("a DomainRandomizer among the transforms of make(n)", "none"))
    return found
