"""Trajectories: batches of episodes, each row one, from its reset to its end.

A batch of trajectories is a TensorDict of batch size ``[n, T]``, time last, with the entries of a
TorchRL rollout and a boolean ``"mask"`` of shape ``(n, T)`` that is True for the steps that count.
Rows may differ in length; what stands behind a row's end is never read.
"""

from __future__ import annotations

__all__ = ["concatenate", "first_trajectories", "next_key", "pad", "returns"]

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from .errors import message


def concatenate(batches: Sequence[TensorDictBase]) -> TensorDictBase:
    """Concatenate batches along their first dimension."""
    return TensorDict.cat(list(batches))  # pyright: ignore[reportReturnType]


def first_trajectories(batch: TensorDictBase) -> TensorDictBase:
    """Return the batch with a ``"mask"`` that keeps each row's first trajectory.

    A collector fills its rows: when an episode ends, the next one begins in the same row. The
    first episode of a row that began with a reset is complete or cut at ``T``, whatever its length,
    so short episodes are not over-represented, as they would be among all complete ones.

    Args:
        batch: Batch size ``[*, T]``; every row must begin at a reset. Not changed.

    Example:
        >>> done = torch.tensor([[0, 0, 0], [0, 1, 0]], dtype=torch.bool).unsqueeze(-1)
        >>> first_trajectories(TensorDict({"next": {"done": done}}, [2, 3]))["mask"]
        tensor([[ True,  True,  True],
                [ True,  True, False]])
    """
    done = batch["next", "done"].reshape(batch.batch_size)
    ended_before = done.cumsum(-1) - done.long() > 0
    mask = ~ended_before
    own = batch.get(("collector", "mask"), None)
    if own is not None:
        mask = mask & own.reshape(mask.shape)
    return batch.copy().set("mask", mask)


def pad(trajectories: Sequence[TensorDictBase]) -> TensorDictBase:
    """Stack trajectories of batch sizes ``[T_i]`` to one of ``[n, max T_i]`` with a ``"mask"``.

    Raises:
        ValueError: For no trajectories, or an empty one.

    Example:
        >>> rows = [TensorDict({"action": torch.ones(t, 1)}, [t]) for t in (2, 3)]
        >>> pad(rows)["mask"].sum(-1)
        tensor([2, 3])
    """
    if not trajectories or any(len(row) == 0 for row in trajectories):
        raise ValueError(
            message(
                "at least one trajectory, each of at least one step",
                f"lengths {[len(row) for row in trajectories]}",
                hint="drop the empty logs",
            )
        )
    longest = max(len(row) for row in trajectories)
    rows = []
    for row in trajectories:
        # the last step is repeated: finite, of the right type, and masked
        first = next(iter(row.values(include_nested=True, leaves_only=True)), row)
        steps = torch.arange(longest, device=first.device)
        rows.append(row[steps.clamp_max(len(row) - 1)].set("mask", steps < len(row)))
    return TensorDict.stack(rows)  # pyright: ignore[reportReturnType]


def next_key(key: NestedKey) -> NestedKey:
    """Return where a rollout keeps the same entry one step later.

    Example:
        >>> next_key("observation"), next_key(("arm", "angle"))
        (('next', 'observation'), ('next', 'arm', 'angle'))
    """
    return ("next", key) if isinstance(key, str) else ("next", *key)


def returns(trajectories: TensorDictBase) -> Tensor:
    """Return each trajectory's sum of rewards, shape ``(*)``.

    Example:
        >>> reward = torch.ones(1, 3, 1)
        >>> done = torch.tensor([[[False], [True], [False]]])
        >>> steps = TensorDict({"next": {"reward": reward, "done": done}}, [1, 3])
        >>> returns(first_trajectories(steps))
        tensor([2.])
    """
    mask = trajectories["mask"]
    reward = trajectories["next", "reward"].reshape(mask.shape)
    return torch.where(mask, reward, 0.0).sum(-1)
