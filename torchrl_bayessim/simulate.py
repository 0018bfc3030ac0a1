r"""Pairs of parameters and summaries, through a TorchRL collector.

:math:`\theta` comes from a source, :math:`x \sim p(x \mid \theta)` from episodes under a
policy. The statistics depend on the policy, so the policy that made the real data is an argument
here; for recorded data, :class:`ReplayActions` repeats the recorded actions.
"""

from __future__ import annotations

__all__ = ["ReplayActions", "collect_summaries", "make_collector", "next_batch", "simulate"]

from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase
from tqdm.auto import tqdm

from .diverged import UndisturbedPolicy
from .errors import PhysicsError, SimulationError, message
from .randomness import isolated, seed_from
from .sources import Grid, draw
from .summaries import SummaryStatistics
from .trajectories import concatenate, first_trajectories
from .transforms.domain_randomizer import DomainRandomizer


class ReplayActions(TensorDictModuleBase):
    """A policy that plays recorded actions: environment i plays row ``i mod n`` at every step.

    Args:
        actions: Recorded actions, shape ``(n, T, A)``; after the last step the last one is held.
        step_key: Entry that counts the steps of the episode (``StepCounter``'s).
        action_key: Entry that is written.

    Raises:
        ValueError: For actions of another shape, or that are not finite; in a call, if nothing
            counts the steps.

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
        step = tensordict.get(self.in_keys[0], None)
        if step is None:
            raise ValueError(
                message(
                    f"steps of the episode counted in {self.in_keys[0]!r}",
                    "no such entry",
                    hint="a StepCounter among the environment's transforms",
                )
            )
        step = step.reshape(tensordict.batch_size)
        rows = torch.arange(step.numel(), device=step.device).reshape(step.shape)
        step = step.clamp(max=self.actions.shape[1] - 1)
        return tensordict.set(self.out_keys[0], self.actions[rows % len(self.actions), step])


def make_collector(env: EnvBase, policy: TensorDictModuleBase | None, *, steps: int) -> Collector:
    """Return a collector of batches of ``steps`` steps of each environment.

    The policy goes on where a simulation diverges: see :mod:`.diverged`.
    """
    if isinstance(policy, TensorDictModuleBase):
        policy = UndisturbedPolicy(policy)
    with isolated("collector"):  # it tries out the policy
        return Collector(
            env,
            policy,
            frames_per_batch=max(1, env.batch_size.numel()) * steps,
            total_frames=-1,
            auto_register_policy_transforms=False,
        )


def next_batch(collector: BaseCollector) -> Any:
    """Return the collector's next batch.

    Raises:
        SimulationError: The collector failed, for instance because a policy was given NaN.
    """
    try:
        return collector.next()
    except RuntimeError as error:
        raise SimulationError(
            message(
                "a batch of finite observations from the simulator",
                str(error).splitlines()[0],
                hint="does a simulation diverge? Let the environment end such an episode with its "
                "last finite observation, as the batched environments do",
            )
        ) from error


def collect_summaries(
    collector: BaseCollector,
    statistics: SummaryStatistics,
    randomizer: DomainRandomizer,
    theta: Tensor,
    *,
    trajectories: int = 1,
    key: tuple[int | str, ...],
    prepare: Callable[[TensorDictBase], TensorDictBase] = first_trajectories,
    keep: int = 0,
    progress: bool = True,
) -> tuple[Tensor, list[TensorDictBase]]:
    """Return the summaries of simulations at ``theta``, and the first ``keep`` batches.

    Each parameter vector is given to as many environments as there are ``trajectories`` per pair,
    which are summarised together. Before every batch all environments are reset, and only each
    row's first trajectory counts: see :func:`.trajectories.first_trajectories`.

    Args:
        collector: Whose policy made the real data.
        statistics: Summaries.
        randomizer: Of the collector's environment; it has its source back afterwards.
        theta: Parameters to simulate, shape ``(N, D)``.
        trajectories: Number n of trajectories per pair: as many as the robot ran.
        key: What the simulations are for: same key, same summaries (for a direct collector).
        prepare: Gives a batch its ``"mask"``.
        keep: Number of batches to return.
        progress: Whether to show a progress bar.

    Returns:
        Summaries of shape ``(N, L)``; and the batches.

    Raises:
        PhysicsError: The batches were not simulated at ``theta``.
    """
    source = randomizer.source
    rows = theta.repeat_interleave(trajectories, 0)
    found: list[Tensor] = []
    kept: list[TensorDictBase] = []
    waiting: list[TensorDictBase] = []  # rows of a parameter vector that is not complete yet
    done, index = 0, 0
    bar = tqdm(total=len(theta), desc="simulate", disable=not progress, leave=False, unit="pair")
    try:
        while done < len(rows):
            randomizer.source = Grid(rows[done:])
            with isolated(*key, index):
                collector.set_seed(seed_from(*key, index, "env") % 2**31)
                collector.reset()
                batch = next_batch(collector)
            batch = batch.reshape(-1, batch.shape[-1])
            _check_held(batch.get(randomizer.key, None), rows[done:])
            if index < keep:
                kept.append(batch.clone())
            new: Any = prepare(batch)[: len(rows) - done]
            new = new.select(*statistics.in_keys, "mask")
            done, index = done + len(new), index + 1
            ready: Any = concatenate([*waiting, new.clone()])
            whole = len(ready) // trajectories
            waiting = [ready[whole * trajectories :]]
            if whole:
                groups = ready[: whole * trajectories].unflatten(0, (whole, trajectories))
                found.append(statistics.together(groups))
            bar.update(done // trajectories - bar.n)
    finally:
        randomizer.source = source
        bar.close()
    return torch.cat(found), kept


def _check_held(theta: Tensor | None, rows: Tensor) -> None:
    """Compare the parameters recorded at the start of each row with those asked for."""
    held = torch.empty(0, rows.shape[-1]) if theta is None else theta[:, 0].cpu()
    asked = rows[torch.arange(len(held)) % len(rows)]
    if theta is None or not torch.allclose(held, asked, rtol=1e-6, atol=1e-12):
        raise PhysicsError(
            message(
                f"simulations at the parameters asked for, {rows[0].tolist()} first",
                "none recorded" if theta is None else f"{held[0].tolist()} first",
                hint="the collector's own randomizer, in this process, and not pinned",
            )
        )


def simulate(
    env: EnvBase,
    policy: TensorDictModuleBase | None,
    statistics: SummaryStatistics,
    randomizer: DomainRandomizer,
    *,
    pairs: int,
    max_steps: int,
    trajectories: int = 1,
    seed: int = 0,
    progress: bool = True,
) -> TensorDictBase:
    """Simulate pairs ``{"theta", "summary"}`` of batch size ``[pairs]``.

    Args:
        env: With ``randomizer`` among its transforms.
        policy: That made the real data; ``None`` for uniformly random actions.
        statistics: Summaries.
        randomizer: Draws the parameters: its source is where they come from.
        pairs: Number of pairs wanted.
        max_steps: Steps after which a trajectory is cut.
        trajectories: Number of trajectories per pair, which are summarised together.
        seed: Same seed, same pairs.
        progress: Whether to show a progress bar.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
        >>> from torchrl_bayessim.summaries import linear_dynamics
        >>> from torchrl_bayessim.transforms import ApplyPhysics
        >>> randomizer = DomainRandomizer(BoxPrior({"length": (0.1, 2.0)}))
        >>> physics = ApplyPhysics(AttributePhysics("length"))
        >>> env = TransformedEnv(CartPoleEnv(64), Compose(physics, randomizer))
        >>> simulate(env, None, SummaryStatistics(linear_dynamics), randomizer, pairs=100,
        ...          max_steps=30, progress=False)["summary"].shape
        torch.Size([100, 28])
    """
    counts = {"pairs": pairs, "max_steps": max_steps, "trajectories": trajectories}
    for name, value in counts.items():
        if value < 1:
            raise ValueError(message(f"{name} to be positive", value))
    collector = make_collector(env, policy, steps=max_steps)
    theta = draw(randomizer.source, pairs, key=(seed, "theta"))  # pyright: ignore[reportArgumentType]
    try:
        summaries, _ = collect_summaries(
            collector,
            statistics,
            randomizer,
            theta,
            trajectories=trajectories,
            key=(seed,),
            progress=progress,
        )
    finally:
        collector.shutdown(close_env=False)
    return TensorDict({"theta": theta, "summary": summaries}, batch_size=[pairs])
