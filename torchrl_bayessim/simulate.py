r"""Pairs of parameters and summaries, through a TorchRL collector.

:math:`\theta` comes from a source, :math:`x \sim p(x \mid \theta)` from episodes under a
policy. The statistics depend on the policy, so the policy that made the real data is an argument
here; for recorded data, :class:`ReplayActions` repeats the recorded actions.
"""

from __future__ import annotations

__all__ = ["ReplayActions", "collect_pairs", "simulate"]

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase
from tqdm.auto import tqdm

from .errors import message
from .randomness import isolated, seed_from
from .summaries import SummaryStatistics


class ReplayActions(TensorDictModuleBase):
    """A policy that plays recorded actions: environment i plays row ``i mod n`` at every step.

    Args:
        actions: Recorded actions, shape ``(n, T, A)``; after the last step the last one is held.
        step_key: Entry that counts the steps of the episode (``StepCounter``'s).
        action_key: Entry that is written.

    Raises:
        ValueError: For actions of another shape, or that are not finite.

    Example:
        >>> from tensordict import TensorDict
        >>> replay = ReplayActions(torch.tensor([[[0.1], [0.2]]]))
        >>> replay(TensorDict({"step_count": torch.tensor([[1], [0]])}, [2]))["action"].flatten()
        tensor([0.2000, 0.1000])
    """

    actions: Tensor

    def __init__(
        self,
        actions: Tensor,
        *,
        step_key: NestedKey = "step_count",
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__()
        if actions.ndim != 3 or not actions.numel():
            raise ValueError(message("actions of shape (n, T, A)", tuple(actions.shape)))
        if not actions.isfinite().all():
            raise ValueError(message("finite recorded actions", "NaN or infinity"))
        self.register_buffer("actions", actions)
        self.in_keys, self.out_keys = [step_key], [action_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of each environment's current step."""
        step = tensordict.get(self.in_keys[0]).reshape(tensordict.batch_size)
        rows = torch.arange(step.numel(), device=step.device).reshape(step.shape)
        step = step.clamp(max=self.actions.shape[1] - 1)
        return tensordict.set(self.out_keys[0], self.actions[rows % len(self.actions), step])


def collect_pairs(
    collector: BaseCollector,
    batches: Iterator[TensorDictBase],
    statistics: SummaryStatistics,
    *,
    pairs: int,
    key: tuple[int | str, ...],
    progress: bool = True,
) -> tuple[TensorDictBase, list[TensorDictBase]]:
    """Return at least ``pairs`` pairs, and the batches they were computed from.

    Before every batch the environments are reset, and only each row's first trajectory counts:
    see :func:`.trajectories.first_trajectories`.

    Args:
        collector: Whose policy made the real data; its environments draw parameters at reset.
        batches: ``iter(collector)``.
        statistics: Summaries.
        pairs: Number of pairs wanted.
        key: What the simulations are for: same key, same pairs (for a direct collector).
        progress: Whether to show a progress bar.
    """
    found: list[TensorDictBase] = []
    kept: list[TensorDictBase] = []
    count = 0
    with tqdm(total=pairs, desc="simulate", disable=not progress, leave=False, unit="pair") as bar:
        while count < pairs:
            with isolated(*key, len(kept)):
                collector.set_seed(seed_from(*key, len(kept), "env") % 2**31)
                collector.reset()
                batch = next(batches).clone()
            kept.append(batch)
            found.append(statistics(batch).reshape(-1))
            count += len(found[-1])
            bar.update(len(found[-1]))
    return torch.cat(found), kept  # pyright: ignore[reportCallIssue, reportReturnType, reportArgumentType]


def simulate(
    env: EnvBase,
    policy: TensorDictModuleBase | None,
    statistics: SummaryStatistics,
    *,
    pairs: int,
    max_steps: int,
    seed: int = 0,
    progress: bool = True,
    **collector_options: Any,
) -> TensorDictBase:
    """Simulate pairs ``{"theta", "summary"}`` of batch size ``[N]``, N at least ``pairs``.

    Args:
        env: With a :class:`.transforms.DomainRandomizer`, which draws the parameters.
        policy: That made the real data; ``None`` for uniformly random actions.
        statistics: Summaries.
        pairs: Number of pairs wanted.
        max_steps: Steps after which a trajectory is cut.
        seed: Same seed, same pairs.
        progress: Whether to show a progress bar.
        **collector_options: Passed to TorchRL's ``Collector``.

    Raises:
        ValueError: If the environment's batches have no parameters.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
        >>> from torchrl_bayessim.summaries import linear_dynamics
        >>> from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer
        >>> physics, prior = AttributePhysics("length"), BoxPrior({"length": (0.1, 2.0)})
        >>> env = TransformedEnv(
        ...     CartPoleEnv(64), Compose(ApplyPhysics(physics), DomainRandomizer(prior)))
        >>> simulate(env, None, SummaryStatistics(linear_dynamics), pairs=100, max_steps=30,
        ...          progress=False).batch_size
        torch.Size([128])
    """
    collector = Collector(
        env,
        policy,
        frames_per_batch=max(1, env.batch_size.numel()) * max_steps,
        total_frames=-1,
        **collector_options,
    )
    try:
        found, _ = collect_pairs(
            collector, iter(collector), statistics, pairs=pairs, key=(seed,), progress=progress
        )
    finally:
        collector.shutdown(close_env=False)
    if "theta" not in found.keys():  # noqa: SIM118 (TensorDict iterates rows)
        raise ValueError(
            message(
                "an environment that draws parameters",
                "batches without 'theta'",
                hint="TransformedEnv(env, Compose(ApplyPhysics(physics), DomainRandomizer(prior)))",
            )
        )
    return found
