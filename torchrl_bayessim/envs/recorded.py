"""Segments of logs and parameter vectors as they come from users, fit to be replayed or refused."""

from __future__ import annotations

__all__ = ["checked_actions", "copies", "substeps_of", "vectors"]

import math
from collections.abc import Mapping
from numbers import Real

from numpy.typing import ArrayLike
from tensordict import TensorDictBase
from torch import Tensor

from ..errors import message
from ..kinds import check_kind, real_numbers
from .task import Task


def copies(segments: Mapping[str, ArrayLike]) -> dict[str, Tensor]:
    """Return the components as tensors of our own: states in double, actions in their precision.

    Raises:
        TypeError: They are not given by name, or are no numbers.
    """
    check_kind("segments by component, a mapping", segments, Mapping, TensorDictBase)
    names = segments.keys()  # a tensordict's iterator goes through its rows
    given = {name: _numbers(name, segments[name]).detach().clone() for name in names}
    return {
        k: v if k == "action" and v.is_floating_point() else v.double() for k, v in given.items()
    }


def _numbers(name: str, value: ArrayLike) -> Tensor:
    return real_numbers(f"numbers in {name!r}", value)


def checked_actions(given: Mapping[str, Tensor], task: Task) -> Tensor:
    """Return the actions of segments that are fit to be replayed.

    Raises:
        ValueError: The segments disagree in number, lack what they need, or are not finite.
    """
    needed = {"qpos", "qvel", "action"}
    if not needed <= given.keys():
        raise ValueError(message("segments with qpos, qvel and action", sorted(given)))
    if task.drive.weld is not None and "weld_pose" not in given:
        expected = "segments with weld_pose, from which the next action steps"
        hint = f"xpos and xquat of data.body({task.drive.weld!r}), as recorded with qpos"
        raise ValueError(message(expected, sorted(given), hint=hint))
    action = given["action"]
    if action.ndim != 3 or not all(action.shape[:2]):
        expected = "actions of shape (S, T, A), S and T at least 1"
        raise ValueError(message(expected, tuple(action.shape)))
    for name, value in given.items():
        if value.shape[:1] != action.shape[:1] or not value.isfinite().all():
            expected = f"finite numbers for {len(action)} segments in {name!r}"
            raise ValueError(message(expected, tuple(value.shape)))
    return action


def substeps_of(task: Task, dt: float) -> int:
    """Return how many time steps of the model are ``dt`` seconds.

    Raises:
        TypeError: ``dt`` is no number.
        ValueError: ``dt`` is not a multiple of the time step, at least one.
    """
    if not isinstance(dt, Real):
        raise TypeError(message("dt in seconds", dt))
    timestep = task.model.opt.timestep
    count = round(dt / timestep) if math.isfinite(dt) else 0
    if count < 1 or not abs(count * timestep - dt) <= 1e-6 * dt:
        expected = f"dt to be a multiple of the model's time step, {timestep:g} s"
        hint = f"{max(1, count) * timestep:g}, or a model of another time step"
        raise ValueError(message(expected, dt, hint=hint))
    return count


def vectors(theta: ArrayLike, names: tuple[str, ...]) -> Tensor:
    """Return parameter vectors, shape ``(P, D)``, of the parameters ``names``.

    Example:
        >>> vectors([[1.0, 2.0]], ("mass", "friction"))
        tensor([[1., 2.]])

    Raises:
        ValueError: The shape is another, or a number is not finite: what NaN means is the adapter's
            affair, and in a fit it is a mistake.
    """
    values = real_numbers(f"parameter vectors of {names}", theta).detach().cpu()
    if values.ndim != 2 or values.shape != (len(values) or 1, len(names)):
        expected = f"theta of shape (P, {len(names)}), P at least 1, for the parameters {names}"
        hint = "theta[None] for a single vector" if values.shape == (len(names),) else ""
        raise ValueError(message(expected, tuple(values.shape), hint=hint))
    if not (finite := values.isfinite()).all():
        row, column = (~finite).nonzero()[0].tolist()
        expected = f"finite parameters, in row {row} of theta too"
        hint = "leave theta out for the physics in force"
        raise ValueError(message(expected, f"{names[column]} = {values[row, column]}", hint=hint))
    return values if values.is_floating_point() else values.double()
