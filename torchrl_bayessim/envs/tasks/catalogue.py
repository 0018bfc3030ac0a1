"""Tasks by the names under which Gymnasium and Gymnasium-Robotics register them."""

from __future__ import annotations

__all__ = ["TASKS", "as_task", "known_task"]

from collections.abc import Callable
from functools import partial

from ...errors import message
from ..task import Task
from . import arms, fetch, locomotion, pendulums

TASKS: dict[str, Callable[[], Task]] = {
    "InvertedPendulum-v5": pendulums.inverted_pendulum,
    "InvertedDoublePendulum-v5": pendulums.inverted_double_pendulum,
    "Reacher-v5": arms.reacher,
    "Pusher-v5": arms.pusher,
    "Swimmer-v5": locomotion.swimmer,
    "Hopper-v5": locomotion.hopper,
    "Walker2d-v5": locomotion.walker2d,
    "HalfCheetah-v5": locomotion.half_cheetah,
    "Ant-v5": locomotion.ant,
    "Humanoid-v5": locomotion.humanoid,
    "FetchReach-v4": fetch.reach,
    "FetchPush-v4": fetch.push,
    "FetchSlide-v4": fetch.slide,
    "FetchPickAndPlace-v4": fetch.pick_and_place,
    "FetchReachDense-v4": partial(fetch.reach, dense=True),
    "FetchPushDense-v4": partial(fetch.push, dense=True),
    "FetchSlideDense-v4": partial(fetch.slide, dense=True),
    "FetchPickAndPlaceDense-v4": partial(fetch.pick_and_place, dense=True),
}


def known_task(name: str) -> Task:
    """Return the task that Gymnasium registers as ``name``.

    Example:
        >>> known_task("Hopper-v5").frame_skip
        4

    Raises:
        ValueError: There is none; the message lists near names.
    """
    if name not in TASKS:
        hint = "Task(model=mujoco.MjModel.from_xml_path(…), frame_skip=…) for a model of your own"
        raise ValueError(message("a known task", name, available=TASKS, hint=hint))
    return TASKS[name]()


def as_task(task: object) -> Task:
    """Return a task as it is, or the one of this name.

    Raises:
        TypeError: It is neither, such as a bare model.
        ValueError: There is no task of this name.
    """
    if isinstance(task, str):
        return known_task(task)
    if not isinstance(task, Task):
        hint = "Task(model=..., frame_skip=...) for a model of your own"
        raise TypeError(message("a task or the name of one", type(task).__name__, hint=hint))
    return task
