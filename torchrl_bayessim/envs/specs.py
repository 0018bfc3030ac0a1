"""The spaces of a task's actions, observations, rewards and flags."""

from __future__ import annotations

__all__ = ["action_spec", "specs"]

from collections.abc import Mapping

import torch
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from .task import Task


def specs(
    task: Task, observed: Mapping[str, Tensor], batch: torch.Size, *, truncates: bool
) -> dict[str, TensorSpec]:
    """Return the specs of an environment by their attributes, given one observation of it."""
    entries = {k: Unbounded(shape=v.shape, dtype=v.dtype) for k, v in observed.items()}
    one = torch.Size((*batch, 1))
    flag = Binary(1, shape=one, dtype=torch.bool)
    flags = ["done", "terminated"] + ["truncated"] * truncates
    dtype = next(iter(observed.values())).dtype
    return {
        "observation_spec": Composite({**entries, "diverged": flag}, shape=batch),
        "action_spec": action_spec(task, batch),
        "reward_spec": Unbounded(shape=one, dtype=dtype),
        "done_spec": Composite({name: flag.clone() for name in flags}, shape=batch),
    }


def action_spec(task: Task, batch: torch.Size) -> TensorSpec:
    """Return the task's bounds, or the actuators' ranges, for a batch of environments.

    Without bounds, and with an actuator whose range is not limited, actions are unbounded.

    Example:
        >>> from torchrl_bayessim.envs.tasks.catalogue import known_task
        >>> action_spec(known_task("Hopper-v5"), torch.Size([4])).shape
        torch.Size([4, 3])
    """
    model = task.model
    low, high = model.actuator_ctrlrange.T if task.bounds is None else task.bounds
    size = torch.Size((*batch, len(low)))
    if task.bounds is None and not model.actuator_ctrllimited.all():
        return Unbounded(shape=size, dtype=torch.float32)
    low, high = (torch.as_tensor(b).float().expand(size).clone() for b in (low, high))
    return Bounded(low=low, high=high, shape=size, dtype=torch.float32)
