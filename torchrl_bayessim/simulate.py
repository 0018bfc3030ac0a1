r"""Pairs of parameters and summaries, through a TorchRL collector.

:math:`\theta` comes from a source, :math:`x \sim p(x \mid \theta)` from episodes under a
policy. The statistics depend on the policy, so the policy that made the real data is an argument
here; for recorded data, :class:`.replay_actions.ReplayActions` repeats the recorded actions.
"""

from __future__ import annotations

__all__ = [
    "check_parts",
    "collect_summaries",
    "make_collector",
    "next_batch",
    "simulate",
    "summaries_in_turn",
]

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase
from torchrl.modules.tensordict_module.exploration import RandomPolicy

from .counts import check_count
from .diverged import UndisturbedPolicy, check_policy
from .envs.mujoco import BatchedMujocoEnv
from .errors import PhysicsError, SimulationError, message
from .kinds import check_function, check_kind
from .pairs import counted, empty_pairs, fill_parameters, fill_summaries
from .randomness import isolated, seed_from
from .sources import Grid
from .summaries import SummaryStatistics
from .trajectories import concatenate, first_trajectories
from .transforms.domain_randomizer import DomainRandomizer
from .transforms.resets import simulator
from .whole_file import replacing_folder

if TYPE_CHECKING:
    from .ray_collectors import RayCollectors


def make_collector(env: EnvBase, policy: TensorDictModuleBase | None, *, steps: int) -> Collector:
    """Return a collector of batches of ``steps`` steps of each environment.

    The policy goes on where a simulation diverges: see :mod:`.diverged`.
    """
    acting: Callable[[TensorDictBase], TensorDictBase] | None = policy
    if isinstance(policy, TensorDictModuleBase):
        acting = UndisturbedPolicy(policy)
    elif policy is None and len(env.action_keys) == 1:
        # what the collector would take, which fills a tensordict of its own at every step
        acting = RandomPolicy(env.action_spec, action_key=env.action_key)
    with isolated("collector"):  # it tries out the policy
        return Collector(
            env,
            acting,
            frames_per_batch=max(1, env.batch_size.numel()) * steps,
            total_frames=-1,
            auto_register_policy_transforms=False,
        )


def check_parts(env: object, statistics: object, randomizer: object) -> None:
    """Refuse what pairs cannot be simulated with.

    Raises:
        TypeError: One is of another kind.
    """
    check_kind("a TorchRL environment", env, EnvBase)
    check_kind("SummaryStatistics", statistics, SummaryStatistics)
    check_kind("a DomainRandomizer", randomizer, DomainRandomizer)


def next_batch(
    collector: BaseCollector, *, meanwhile: Callable[[float], None] | None = None
) -> Any:
    """Return the collector's next batch.

    Args:
        collector: Collects.
        meanwhile: Called in this thread during every step that a batched environment simulates in
            others, with the share of the batch's steps that have begun; of another environment,
            once with 1 before the first step. It does not fail.

    Raises:
        SimulationError: The collector failed, for instance because a policy was given NaN.
    """
    try:
        with _working(collector, meanwhile):
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


def _working(
    collector: Any, meanwhile: Callable[[float], None] | None
) -> AbstractContextManager[None]:
    if meanwhile is None:
        return nullcontext()
    env = simulator(getattr(collector, "env", None))
    if not isinstance(env, BatchedMujocoEnv):
        meanwhile(1.0)
        return nullcontext()
    steps = collector.requested_frames_per_batch // env.batch_size.numel()
    begun = count(1)
    return env.meanwhile(lambda: meanwhile(next(begun) / steps))


def summaries_in_turn(
    collector: BaseCollector,
    statistics: SummaryStatistics,
    randomizer: DomainRandomizer,
    theta: Tensor,
    *,
    trajectories: int = 1,
    key: tuple[int | str, ...],
    prepare: Callable[[TensorDictBase], TensorDictBase] = first_trajectories,
    first: int = 0,
) -> Iterator[tuple[Tensor, TensorDictBase]]:
    """Yield, batch after batch, the summaries that it completes, ``(n, L)``, and the batch.

    What a batch holds depends on ``key``, on its number and on its parameters, and on nothing that
    was simulated before: batches may be simulated anywhere, in any order.

    Args:
        collector: See :func:`collect_summaries`, as for all others.
        statistics: Summaries.
        randomizer: Has its source back afterwards.
        theta: Parameters to simulate, shape ``(N, D)``; memory-mapped ones are read in parts.
        trajectories: Number n of trajectories per pair.
        key: What the simulations are for.
        prepare: Gives a batch its ``"mask"``.
        first: Number of the first batch.
    """
    source = randomizer.source
    count = len(theta) * trajectories
    width = getattr(collector, "n_env", count)
    waiting: list[TensorDictBase] = []  # rows of a parameter vector that is not complete yet
    done, index = 0, first
    try:
        while done < count:
            rows = _rows(theta, trajectories, done, min(count, done + width))
            randomizer.source = Grid(rows)
            with isolated(*key, index):
                collector.set_seed(seed_from(*key, index, "env") % 2**31)
                collector.reset()
                batch = next_batch(collector)
            batch = batch.reshape(-1, batch.shape[-1])
            _check_held(batch.get(randomizer.key, None), rows)
            new: Any = prepare(batch)[: count - done]
            new = new.select(*statistics.in_keys, "mask")
            done, index = done + len(new), index + 1
            ready: Any = concatenate([*waiting, new.clone()])
            whole = len(ready) // trajectories
            waiting = [ready[whole * trajectories :]]
            if whole:
                groups = ready[: whole * trajectories].unflatten(0, (whole, trajectories))
                yield statistics.together(groups), batch
            else:
                yield torch.empty(0), batch
    finally:
        randomizer.source = source


def collect_summaries(
    collector: BaseCollector,
    statistics: SummaryStatistics,
    randomizer: DomainRandomizer,
    theta: Tensor,
    *,
    trajectories: int = 1,
    key: tuple[int | str, ...],
    prepare: Callable[[TensorDictBase], TensorDictBase] = first_trajectories,
    first: int = 0,
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
        first: Number of the first batch, for a part of what a key is for.
        keep: Number of batches to return.
        progress: Whether to show a progress bar.

    Returns:
        Summaries of shape ``(N, L)``; and the batches.

    Raises:
        PhysicsError: The batches were not simulated at ``theta``.
    """
    found: list[Tensor] = []
    kept: list[TensorDictBase] = []
    options: dict[str, Any] = {"trajectories": trajectories, "key": key, "prepare": prepare}
    turns = summaries_in_turn(collector, statistics, randomizer, theta, first=first, **options)
    for summaries, batch in counted(turns, len(theta), progress=progress):
        if len(kept) < keep:
            kept.append(batch.clone())
        if len(summaries):
            found.append(summaries)
    return torch.cat(found), kept


def _rows(theta: Tensor, trajectories: int, start: int, stop: int) -> Tensor:
    """Return the parameters of trajectories ``start`` to ``stop``, without reading the others."""
    first, last = start // trajectories, -(-stop // trajectories)
    rows = theta[first:last].repeat_interleave(trajectories, 0)
    return rows[start - first * trajectories : stop - first * trajectories]


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
    folder: str | Path | None = None,
    collectors: RayCollectors | None = None,
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
        folder: Where the pairs are to lie as a memory-mapped TensorDict, which is returned. A part
            at a time is in memory then, in :func:`.inference.fit.fit` too. It must not exist, and
            does when all pairs are in it; later ``TensorDict.load_memmap(folder)`` has them.
        collectors: On Ray, to simulate there: the same pairs.
        progress: Whether to show a progress bar.

    Raises:
        TypeError: A count is no whole number; there is no environment, policy, statistics or
            randomizer where one should be.
        ValueError: A count is not positive, or the collectors have other environments.
        FileExistsError: There is such a folder.

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
    check_parts(env, statistics, randomizer)
    check_policy(policy)
    counts = {"pairs": pairs, "max_steps": max_steps, "trajectories": trajectories}
    for name, value in counts.items():
        check_count(name, value)
    if collectors is not None:
        check_function("RayCollectors", getattr(collectors, "check", None))
        collectors.check(env, trajectory=max_steps)
    asked: dict[str, Any] = {"trajectories": trajectories, "key": (seed,)}
    with nullcontext() if folder is None else replacing_folder(folder) as beside:
        found = empty_pairs(pairs, beside)
        theta = fill_parameters(found, randomizer.source, key=(seed, "theta"))  # pyright: ignore[reportArgumentType]
        if collectors is not None:
            asked["steps"] = max_steps
            turns = collectors.summaries_in_turn(policy, statistics, theta, **asked)
            fill_summaries(found, turns, progress=progress)
        else:
            collector = make_collector(env, policy, steps=max_steps)
            try:
                turns = summaries_in_turn(collector, statistics, randomizer, theta, **asked)
                fill_summaries(found, turns, progress=progress)
            finally:
                collector.shutdown(close_env=False)
    return found if folder is None else TensorDict.load_memmap(folder)
