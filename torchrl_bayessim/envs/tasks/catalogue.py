"""Tasks by the names under which Gymnasium and Gymnasium-Robotics register them."""

from __future__ import annotations

__all__ = ["TASKS", "known_task"]

from collections.abc import Callable

from ...errors import message
from ..task import Task
from . import locomotion

TASKS: dict[str, Callable[[], Task]] = {
    "Swimmer-v5": locomotion.swimmer,
    "Hopper-v5": locomotion.hopper,
    "Walker2d-v5": locomotion.walker2d,
    "HalfCheetah-v5": locomotion.half_cheetah,
    "Ant-v5": locomotion.ant,
    "Humanoid-v5": locomotion.humanoid,
}


def known_task(name: str) -> Task:
    """Return the task that Gymnasium registers as ``name``.

    Raises:
        ValueError: There is none; the message lists near names.
    """
    if name not in TASKS:
        hint = "pass a Task for a model of your own"
        raise ValueError(message("a known task", name, available=TASKS, hint=hint))
    return TASKS[name]()
