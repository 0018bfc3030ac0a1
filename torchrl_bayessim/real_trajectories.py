"""What a real system answered, and whether simulations compare with it."""

from __future__ import annotations

__all__ = [
    "check_columns",
    "check_cut",
    "check_real",
    "comparable",
    "first_not_finite",
    "simulated_columns",
]

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from .errors import message
from .summaries import SummaryStatistics
from .trajectories import first_trajectories, next_key

_LEAVES: dict[str, Any] = {"include_nested": True, "leaves_only": True}


def check_real(real: object, entries: Sequence[NestedKey]) -> None:
    """Refuse what are no trajectories ``[n, T]`` with a ``"mask"`` and finite ``entries``.

    Raises:
        TypeError: For what is not a TensorDict, or a mask that is not of booleans.
        ValueError: For another batch size, no trajectory, one without steps, a mask of another
            shape, a missing entry, or one that is not finite where the mask counts it.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bayessim.trajectories import pad
        >>> check_real(pad([TensorDict({"action": torch.ones(3, 1)}, [3])]), ["action"])
    """
    if not isinstance(real, TensorDictBase):
        got = type(real).__name__
        raise TypeError(message("trajectories [n, T] in a TensorDict", got, hint="pad(logs)"))
    size = tuple(real.batch_size)
    if len(size) != 2 or 0 in size:
        raise ValueError(message("trajectories [n, T] of at least one step each", size))
    mask = _present(real, "mask", hint="first_trajectories(batch) or pad(logs) add it")
    if mask.dtype != torch.bool:
        raise TypeError(message("booleans in 'mask'", str(mask.dtype), hint="mask > 0"))
    if mask.shape != real.batch_size:
        raise ValueError(message(f"a 'mask' of shape {size}", tuple(mask.shape)))
    if not mask.any(-1).all():
        row = int((~mask.any(-1)).nonzero()[0])
        got = f"none that counts in trajectory {row}"
        raise ValueError(message("trajectories [n, T] of at least one step each", got))
    for key in entries:
        _present(real, key, hint="rename_key_, or statistics that read what there is")
    lost = first_not_finite(real, entries)
    if lost is not None:
        name, row, step = lost
        got = f"NaN or infinity in trajectory {row} at step {step}"
        hint = "cut the trajectory there, or repair it"
        raise ValueError(message(f"finite values of {name!r}", got, hint=hint))


def _present(real: TensorDictBase, key: NestedKey, *, hint: str) -> Tensor:
    value = real.get(key, None)
    if value is None:
        found = [str(name) for name in real.keys(**_LEAVES)]
        expected = "real trajectories with an entry"
        raise ValueError(message(expected, str(key), available=sorted(found), hint=hint))
    return value


def first_not_finite(
    trajectories: TensorDictBase, entries: Sequence[NestedKey]
) -> tuple[NestedKey, int, int] | None:
    """Return the first entry, trajectory and step that counts and is not finite, if any is."""
    mask: Tensor = trajectories.get("mask")
    for entry in entries:
        finite = trajectories.get(entry).isfinite().reshape(*mask.shape, -1).all(-1)
        lost = (mask & ~finite).nonzero()
        if len(lost):
            row, step = lost[0].tolist()
            return entry, row, step
    return None


def check_columns(real: TensorDictBase, columns: Mapping[NestedKey, int]) -> None:
    """Refuse entries ``(n, T, size)`` of other sizes than the simulator's ``columns``.

    Entries without columns are left to the statistics, which say what actions must be.

    Raises:
        ValueError: There is one.
    """
    for key, size in columns.items():
        value = real.get(key)
        if value.ndim > 2 and value.shape[2:] != (size,):
            counted = value.shape[-1] if value.ndim == 3 else f"shape {tuple(value.shape[2:])}"
            hint = "" if value.is_floating_point() else "one-hot actions, if these are indices"
            expected = f"{size} columns of {key!r}, as the simulator has"
            raise ValueError(message(expected, f"{counted} from the robot", hint=hint))


def simulated_columns(
    env: EnvBase, statistics: SummaryStatistics, *, replayed: bool
) -> dict[NestedKey, int]:
    """Return how many columns the entries that the statistics read have in the simulator.

    Args:
        env: The simulator.
        statistics: Summaries.
        replayed: Whether recorded actions are written for the simulator to read; others may be
            measured instead.

    Raises:
        ValueError: The simulator has no such entry.

    Example:
        >>> from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
        >>> from torchrl_bayessim.summaries import moments
        >>> simulated_columns(CartPoleEnv(3), SummaryStatistics(moments), replayed=True)
        {'observation': 4, ('next', 'observation'): 4, 'action': 2}
    """
    observations, actions = env.full_observation_spec, env.full_action_spec
    columns: dict[NestedKey, int] = {}
    for key, kind, specs in (
        (statistics.observation_key, "an observation", [observations]),
        (statistics.action_key, "an action", [actions] if replayed else [actions, observations]),
    ):
        found = [spec for spec in (known.get(key, None) for known in specs) if spec is not None]
        if not found:
            names = [name for known in specs for name in known.keys(**_LEAVES)]
            expected = f"statistics of {kind} that the simulator has"
            hint = "the simulator's name, for which logs have rename_key_, or a RenameTransform"
            raise ValueError(message(expected, str(key), available=names, hint=hint))
        size = found[0].shape[len(env.batch_size) :]
        keys = [key] if kind == "an action" else [key, next_key(key)]
        columns |= dict.fromkeys(keys, size[0]) if len(size) == 1 else {}
    return columns


def comparable(real: TensorDictBase, *, horizon: int) -> TensorDictBase:
    """Cut real episodes where simulated ones are cut; refuse those that were cut before.

    Args:
        real: Trajectories ``[n, T]`` with a ``"mask"``.
        horizon: Steps after which simulated trajectories are cut.

    Raises:
        TypeError: See :func:`check_real`.
        ValueError: An episode neither ends nor lasts that long; or see :func:`check_real`.
    """
    ends: NestedKey = ("next", "done")
    check_real(real, [ends])
    real = real[:, :horizon]
    mask, done = real.get("mask"), real.get(ends)
    if done.dtype != torch.bool or done.numel() != mask.numel():
        got = f"{done.dtype} of shape {tuple(done.shape)}"
        raise ValueError(message(f"one boolean per step in {ends}", got))
    ended = (done.reshape(mask.shape) & mask).any(-1)
    length = mask.sum(-1)
    short = ~ended & (length < horizon)
    if short.any():
        raise ValueError(
            message(
                f"real episodes that end, or last the {horizon} steps of simulated ones",
                f"one cut after {int(length[short].min())}",
                hint="the same horizon for the robot and the simulation",
            )
        )
    return real


def check_cut(simulated: TensorDictBase, real: TensorDictBase) -> None:
    """Refuse simulations that a time limit cuts before the real episodes end.

    Args:
        simulated: A batch ``[N, T]`` whose rows begin with a reset.
        real: Trajectories ``[n, T]`` with a ``"mask"``, cut where simulated ones are.

    Raises:
        ValueError: There are some.
    """
    truncated = simulated.get(("next", "truncated"), None)
    if truncated is None:
        return
    mask: Tensor = first_trajectories(simulated).get("mask")
    limited = truncated & ~simulated.get(("next", "terminated"), torch.zeros_like(truncated))
    length, longest = mask.sum(-1), int(real.get("mask").sum(-1).max())
    cut = (limited.reshape(mask.shape) & mask).any(-1) & (length < longest)
    if cut.any():
        raise ValueError(
            message(
                f"simulated episodes that may last the {longest} steps of real ones",
                f"{int(cut.sum())} of {len(cut)} cut, after {int(length[cut].min())} steps or more",
                hint="a higher time limit in the simulator (StepCounter(max_steps=), TimeLimit), "
                "or a horizon that ends with it",
            )
        )
