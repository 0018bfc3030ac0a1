"""Where the recipes' loops simulate: in this process, or on Ray."""

from __future__ import annotations

from functools import partial
from typing import Any

from tasks import Task

from torchrl_bayessim.errors import message
from torchrl_bayessim.ray_collectors import RayCollectors
from torchrl_bayessim.transforms import DomainRandomizer

COLLECTORS = ("direct", "ray")


def collectors(
    kind: str, task: Task, policy: Any, *, seed: int, workers: int
) -> RayCollectors | None:
    """Return collectors of a task's environments on Ray, or None for those of this process."""
    if kind not in COLLECTORS:
        raise ValueError(message("a collector", kind, available=COLLECTORS))
    if kind == "direct":
        return None
    sizes = {"environments": task.environments, "steps": task.horizon}
    return RayCollectors(partial(make, task, seed), policy, workers=workers, **sizes)


def make(task: Task, seed: int, environments: int) -> Any:
    """Return environments that train, with a randomizer of their own."""
    return task.make(environments, seed=seed, randomizer=DomainRandomizer(task.prior, seed=seed))
