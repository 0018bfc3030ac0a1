"""One trajectory as it was logged: at its own times, in the simulator's quantities."""

from __future__ import annotations

__all__ = ["Record", "plausible", "record_of", "unwrapped", "usable_rows", "wraps"]

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import message
from .columns import joint_names
from .system import System
from .tables import Table

Array = NDArray[np.float64]
_LATEST = 1e20  # s, beyond nanoseconds since 1970


@dataclass(frozen=True, kw_only=True, eq=False)
class Record:
    """Rows of a log; what was not measured is NaN throughout.

    Attributes:
        name: The file's name.
        time: Seconds since the first row, shape ``(T,)``; NaN where it is no time.
        qpos: Shape ``(T, nq)``; quaternions are normalised and do not change sign between rows.
        qvel: Shape ``(T, nv)``.
        ctrl: The action held from each row on, shape ``(T, A)``.
    """

    name: str
    time: Array
    qpos: Array
    qvel: Array
    ctrl: Array

    def __len__(self) -> int:
        return len(self.time)


def record_of(table: Table, system: System) -> Record:
    """Return a table's columns in the simulator's quantities.

    Raises:
        ValueError: There are no rows, or a quaternion is far from a unit quaternion.
    """
    model, columns = system.task.model, system.columns
    length = len(next(iter(table.columns.values())))
    if not length:
        raise ValueError(message(f"rows in {table.name}", 0))
    qpos = np.full((length, model.nq), np.nan)
    qvel = np.full((length, model.nv), np.nan)
    ctrl = np.full((length, len(system.task.action_names)), np.nan)
    for j, joint in enumerate(joint_names(model)):
        for i, name in enumerate(columns.qpos.get(joint, ())):
            qpos[:, model.jnt_qposadr[j] + i] = table.columns[name]
        for i, name in enumerate(columns.qvel.get(joint, ())):
            qvel[:, model.jnt_dofadr[j] + i] = table.columns[name]
        if len(columns.qpos.get(joint, ())) > 1:
            place = slice(qpos_end := model.jnt_qposadr[j] + len(columns.qpos[joint]) - 4, None)
            quaternions = qpos[:, place][:, :4]
            qpos[:, qpos_end : qpos_end + 4] = _continuous(quaternions, table.name, joint)
    for i, actuator in enumerate(system.task.action_names):
        ctrl[:, i] = table.columns[columns.ctrl[actuator]]
    if columns.time is None:
        time = system.control_dt * np.arange(length, dtype=np.float64)
    else:
        time = table.columns[columns.time]
        time = np.where(np.abs(time) < _LATEST, time, np.nan)
        known = time[np.isfinite(time)]
        time = time - known[:1].sum()  # since the run began, as effects that grow with it mean it
    return Record(name=table.name, time=time, qpos=qpos, qvel=qvel, ctrl=ctrl)


def plausible(values: Array) -> NDArray[np.bool_]:
    """Return which values are numbers that a robot can have: finite, and below 1e8."""
    return (values > -1e8) & (values < 1e8)


def usable_rows(record: Record, system: System) -> NDArray[np.bool_]:
    """Return which rows have all values that the system's columns promise, shape ``(T,)``."""
    model, columns = system.task.model, system.columns
    good = np.asarray(plausible(record.ctrl).all(1))
    for j, joint in enumerate(joint_names(model)):
        q, v = model.jnt_qposadr[j], model.jnt_dofadr[j]
        good &= plausible(record.qpos[:, q : q + len(columns.qpos.get(joint, ()))]).all(1)
        good &= plausible(record.qvel[:, v : v + len(columns.qvel.get(joint, ()))]).all(1)
    return good


def _continuous(quaternions: Array, file: str, joint: str) -> Array:
    """Return unit quaternions, each in the half space of the one before."""
    norm = np.linalg.norm(quaternions, axis=1, keepdims=True)
    wrong = np.flatnonzero(np.abs(norm[:, 0] - 1) > 0.1)
    if len(wrong):
        expected = f"unit quaternions w, x, y, z of {joint!r} in {file}"
        got = f"norm {norm[wrong[0], 0]:.3g} in row {wrong[0]}"
        raise ValueError(message(expected, got))
    unit = quaternions / norm
    turns = np.nan_to_num((unit[1:] * unit[:-1]).sum(1), nan=1.0)
    signs = np.cumprod(np.concatenate([[1.0], np.where(turns < 0, -1.0, 1.0)]))
    return unit * signs[:, None]


def wraps(angle: Array) -> NDArray[np.bool_]:
    """Return after which rows an angle jumps by a turn, which no motion does, shape ``(T - 1,)``.

    Where it changes by more than half a turn before or after as well, other than back, it is no
    jump: rows are too far apart, or the angle is in degrees.

    Example:
        >>> wraps(np.array([3.0, 3.1, -3.1, -3.0])).tolist()
        [False, True, False]
        >>> wraps(np.array([0.0, 5.0, 11.0, 17.0])).tolist()
        [False, False, False]
    """
    change = np.diff(angle)
    turn = np.abs(np.abs(change) - 2 * np.pi) < 1.5
    beside = np.concatenate([[0.0], change, [0.0]])
    alone = [
        (np.abs(other) < np.pi) | (np.abs(change + other) < np.pi) | np.isnan(other)
        for other in (beside[:-2], beside[2:])
    ]
    return turn & alone[0] & alone[1]


def unwrapped(angle: Array) -> Array:
    """Return an angle without jumps of a turn.

    Example:
        >>> unwrapped(np.array([3.0, 3.1, -3.1, -3.0])).round(3).tolist()
        [3.0, 3.1, 3.183, 3.283]
    """
    turns = np.where(wraps(angle), np.sign(np.diff(angle)), 0.0)
    return angle - 2 * np.pi * np.concatenate([[0.0], np.cumsum(turns)])
