"""What states are made of; start states and choices of environments as they come from users."""

from __future__ import annotations

__all__ = [
    "check_counts",
    "check_own",
    "check_settings",
    "chosen_rows",
    "components_of",
    "finite_rows",
    "names_of",
]

import difflib
from collections.abc import Iterable

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..errors import message
from ..kinds import check_keys

_COMPONENTS = (
    "time",
    "qpos",
    "qvel",
    "act",
    "history",
    "warmstart",
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "eq_active",
    "mocap_pos",
    "mocap_quat",
    "userdata",
    "plugin",
)


def components_of(model: mujoco.MjModel, *, welded: bool) -> dict[str, slice]:
    """Return where each component is in a state."""
    sizes = {name: mujoco.mj_stateSize(model, 1 << i) for i, name in enumerate(_COMPONENTS)}
    if welded:
        sizes["weld_pose"] = 7
    ends = np.cumsum(list(sizes.values())).tolist()
    return {
        name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)
    }


def finite_rows(name: str, value: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return one row of finite numbers for each environment, in double precision.

    Example:
        >>> finite_rows("qvel", [[1, 2]], (1, 2))
        array([[1., 2.]])

    Raises:
        ValueError: ``value`` has not this shape (nothing is broadcast), or is not finite numbers.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError):  # NumPy's and torch's, of what are no numbers
        expected = f"finite numbers of shape {shape} for {name}"
        raise ValueError(message(expected, type(value).__name__)) from None
    if array.shape != shape or not np.isfinite(array).all():
        got = "others" if array.shape == shape else array.shape
        raise ValueError(message(f"finite numbers of shape {shape} for {name}", got))
    return array


def chosen_rows(mask: ArrayLike | None, count: int) -> NDArray[np.int64]:
    """Return which of ``count`` environments a boolean mask chooses; without one, all.

    Example:
        >>> chosen_rows([True, False, True], 3)
        array([0, 2])

    Raises:
        ValueError: The mask is not boolean, or has not shape ``(count,)``.
    """
    if mask is None:
        return np.arange(count)
    try:
        array = np.asarray(mask)
    except (TypeError, ValueError, RuntimeError):
        array = np.asarray(None)
    if array.shape != (count,) or array.dtype != bool:
        expected = f"a boolean mask of shape ({count},)"
        raise ValueError(message(expected, f"{array.dtype} of shape {array.shape}"))
    return np.flatnonzero(array)


def check_counts(**counts: object) -> None:
    """Refuse counts that are not positive integers; None stands for a default.

    Example:
        >>> check_counts(num_envs=np.int64(4), threads=None)

    Raises:
        ValueError: One of them is not.
    """
    for name, value in counts.items():
        if value is None:
            continue
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
            raise ValueError(message(f"{name} to be a positive integer", value))


def check_settings(dtype: torch.dtype, seed: object) -> None:
    """Refuse what observations cannot be in, and what is no seed; None stands for a default.

    Raises:
        ValueError: ``dtype`` is not floating, or ``seed`` no integer.
    """
    if not isinstance(dtype, torch.dtype) or not dtype.is_floating_point:
        expected = "a floating dtype, of observations and rewards"
        raise ValueError(message(expected, dtype, available=["torch.float32", "torch.float64"]))
    if seed is not None and not isinstance(seed, int | np.integer):
        raise ValueError(message("an integer as seed", seed))


def check_own(name: str, components: Iterable[str]) -> None:
    """Refuse a name of a task's own that was probably meant to be a component of the state.

    Example:
        >>> check_own("goal", ["qpos", "qvel"])

    Raises:
        KeyError: It is nearly one.
    """
    known = list(components)
    if difflib.get_close_matches(name, known, cutoff=0.7):
        expected = "a component of the state, or a name of your own that is unlike all of them"
        raise KeyError(message(expected, name, available=known))


def names_of(outputs: Iterable[str]) -> tuple[str, ...]:
    """Return names as a tuple.

    Raises:
        TypeError: ``outputs`` is no sequence of names, or one string, whose letters are none.
    """
    check_keys("outputs", outputs)
    return tuple(outputs)
