"""What the real data would have looked like under other physics.

Summaries depend on the policy. So each parameter vector is simulated under every policy that made
real data, as many trajectories each as the robot ran, and the network sees one summary per policy
side by side. Recorded logs are simulated by replaying their actions.
"""

from __future__ import annotations

__all__ = ["Evidence", "EvidenceSimulator"]

import copy
from collections.abc import Callable, Sequence
from typing import Any, TypedDict

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from .errors import message
from .randomness import isolated, seed_from
from .ray_collectors import RayCollectors
from .replay_actions import ReplayActions
from .simulate import collect_summaries, make_collector, next_batch
from .summaries import SummaryStatistics
from .trajectories import first_trajectories
from .transforms.domain_randomizer import DomainRandomizer


class Evidence(TypedDict):
    """What the robot did once, under one policy.

    Attributes:
        policy: The policy's weights.
        episodes: Number n of real episodes.
        summary: Of all of them together, shape ``(L,)``.
    """

    policy: dict[str, Any]
    episodes: int
    summary: Tensor


class EvidenceSimulator:
    """Simulates parameters under the policies, or the recorded actions, of the real data.

    Args:
        env: Simulated environments, batch size ``[N]``, with ``randomizer`` among their transforms.
        policy: The learner's, which changes.
        statistics: Summaries of trajectories.
        randomizer: The transform of ``env`` that draws the parameters.
        horizon: Steps of the trajectories that are summarised.
        keep: Batches simulated under the present policy that are handed on.
        collectors: On Ray, in the place of one in this process.
        progress: Whether to show progress bars.

    Raises:
        ValueError: The collectors have another number of environments.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: TensorDictModuleBase,
        statistics: SummaryStatistics,
        randomizer: DomainRandomizer,
        *,
        horizon: int,
        keep: int = 0,
        collectors: RayCollectors | None = None,
        progress: bool = True,
    ) -> None:
        if collectors is not None:
            collectors.check(env, steps=horizon)
        self.env, self.policy, self.collectors = env, policy, collectors
        self.statistics, self.randomizer = statistics, randomizer
        self.horizon, self.keep, self.progress = horizon, keep, progress
        self._collector: Collector | None = None

    def begin(self, key: tuple[int | str, ...]) -> None:
        """Begin new episodes, for the training batches that follow."""
        if self.collectors is not None:
            self.collectors.begin(self.randomizer, key=key)
            return
        with isolated(*key, "reset"):
            self.collector.set_seed(seed_from(*key, "env") % 2**31)
            self.collector.reset()

    def batch(
        self, key: tuple[int | str, ...], *, meanwhile: Callable[[float], None] | None = None
    ) -> TensorDictBase:
        """Return the next training batch, ``[N, T]``, collected with the present policy.

        ``meanwhile``: See `next_batch`.
        """
        if self.collectors is not None:
            if meanwhile is not None:
                meanwhile(1.0)
            return self.collectors.batch(self.policy)
        with isolated(*key):
            batch = next_batch(self.collector, meanwhile=meanwhile)
        return batch.reshape(-1, batch.shape[-1])

    @property
    def collector(self) -> Collector:
        """The collector of the present policy in this process; made on first use."""
        if self._collector is None:
            # a new collector resets the environments: an episode that a resumed run has on top
            begun = self.randomizer.get_extra_state()
            self._collector = make_collector(self.env, self.policy, steps=self.horizon)
            self.randomizer.set_extra_state(begun)
        return self._collector

    def close(self) -> None:
        """Shut the collector down; the environments stay open."""
        if self._collector is not None:
            self._collector.shutdown(close_env=False)
            self._collector = None

    def policies(
        self, evidence: Sequence[Evidence], theta: Tensor, *, key: tuple[int | str, ...]
    ) -> tuple[Tensor, list[TensorDictBase]]:
        """Return the summaries under each policy side by side, shape ``(N, n L)``.

        The last evidence is the present policy's; the first batches simulated under it come too.
        """
        parts = []
        for index, entry in enumerate(evidence[:-1]):
            parts.append(self.earlier(entry, theta, key=(*key, index)))
        last, batches = self._summaries(
            self.policy,
            theta,
            trajectories=evidence[-1]["episodes"],
            key=(*key, len(evidence) - 1),
            keep=self.keep,
        )
        return torch.cat([*parts, last], -1), batches

    def earlier(self, entry: Evidence, theta: Tensor, *, key: tuple[int | str, ...]) -> Tensor:
        """Return the summaries under an earlier policy, shape ``(N, L)``."""
        policy = copy.deepcopy(self.policy)
        policy.load_state_dict(entry["policy"])
        return self._summaries(policy, theta, trajectories=entry["episodes"], key=key)[0]

    def replay(
        self, real: TensorDictBase, theta: Tensor, *, key: tuple[int | str, ...]
    ) -> tuple[Tensor, list[TensorDictBase]]:
        """Return the summaries under recorded actions, shape ``(N, L)``, and the first batch.

        Environment i replays the actions of log i mod n, and is cut where that log ends.
        """
        steps, rows = real.shape[1], max(1, self.env.batch_size.numel())
        if rows % len(real):
            raise ValueError(
                message(
                    f"environments in multiples of the {len(real)} logs, whose actions they replay",
                    rows,
                    hint=f"{-(-rows // len(real)) * len(real)} environments",
                )
            )
        cut = real.get("mask")[torch.arange(rows) % len(real)]

        def prepare(batch: TensorDictBase) -> TensorDictBase:
            batch = first_trajectories(batch.reshape(-1, steps))
            mask = batch.get("mask")
            return batch.set("mask", mask & cut.to(mask.device))

        action = self.statistics.action_key
        return self._summaries(
            ReplayActions(real.get(action).to(self.env.device), action_key=action),
            theta,
            steps=steps,
            prepare=prepare,
            trajectories=len(real),
            key=key,
            keep=1,
        )

    def _summaries(
        self, policy: TensorDictModuleBase, theta: Tensor, *, steps: int | None = None, **asked: Any
    ) -> tuple[Tensor, list[TensorDictBase]]:
        """Return the summaries under a policy, and the batches to keep."""
        steps = steps or self.horizon
        asked["progress"] = self.progress
        if self.collectors is not None:
            return self.collectors.summaries(policy, self.statistics, theta, steps=steps, **asked)
        present = policy is self.policy
        collector = self.collector if present else make_collector(self.env, policy, steps=steps)
        try:
            return collect_summaries(collector, self.statistics, self.randomizer, theta, **asked)
        finally:
            if not present:
                collector.shutdown(close_env=False)
