r"""From records at their own times to logs at the control step.

Between two rows positions follow the cubic that meets both positions and velocities (Hermite),
rotations the same in the tangent space of the first row; velocities are interpolated linearly; the
action of a step is the average over it of the actions held. A record that already is on the grid,
to within a fiftieth of a step, is taken as it is. Jumps of hinges by a turn are undone. A record is
split where rows are left out or not finite, and at gaps, across which nothing is invented.
"""

from __future__ import annotations

__all__ = ["resample"]

from collections.abc import Iterable, Iterator

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import message
from .columns import joint_names
from .log import Log
from .record import Record, unwrapped, usable_rows
from .system import System
from .velocity import Windows, angular_velocity, velocity

Array = NDArray[np.float64]
_GAP = 5.0  # steps without a row after which a record is split
_COARSEST = 10.0  # control steps that rows may usually be apart, to be interpolated
_ROTATIONS = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_BALL): 0}


def resample(
    record: Record, system: System, *, leave_out: Iterable[tuple[int, int]] = ()
) -> list[Log]:
    """Return a record at the control step, one log for each part without gaps.

    Args:
        record: What was logged.
        system: The robot.
        leave_out: First and last rows of parts that are not to be used.

    Returns:
        Logs of at least two rows; where velocities are estimated, without the rows at both ends
        whose window is one-sided.

    Raises:
        ValueError: The time does not increase, or no part is left.
    """
    parts = list(_parts(record, system, leave_out))
    logs = [log for rows in parts if (log := _resampled(record, rows, system, len(parts) > 1))]
    if not logs:
        expected = f"rows of {record.name} that can be used, at least two in succession"
        raise ValueError(message(expected, f"{len(record)} rows, none of them"))
    return logs


def _parts(record: Record, system: System, leave_out: Iterable[tuple[int, int]]) -> Iterator[slice]:
    """Yield slices of consecutive usable rows."""
    good = np.isfinite(record.time) & usable_rows(record, system)
    for first, last in leave_out:
        good[first : last + 1] = False
    steps = np.diff(record.time)
    backward = good[1:] & good[:-1] & (steps <= 0)
    if backward.any():
        row = int(np.flatnonzero(backward)[0]) + 1
        got = f"{record.time[row]:g} s after {record.time[row - 1]:g} s in row {row}"
        raise ValueError(message(f"increasing time in {record.name}", got))
    usual = np.median(steps[good[1:] & good[:-1]]) if (good[1:] & good[:-1]).any() else 0.0
    dt = system.control_dt
    together = good[1:] & good[:-1] & (steps <= _GAP * min(max(usual, dt), _COARSEST * dt))
    edges = np.flatnonzero(~together) + 1
    for begin, end in zip([0, *edges], [*edges, len(record)], strict=True):
        if end - begin > 1:
            yield slice(int(begin), int(end))


def _resampled(record: Record, rows: slice, system: System, split: bool) -> Log | None:  # noqa: FBT001
    model = system.task.model
    time, qpos, ctrl = record.time[rows], record.qpos[rows].copy(), record.ctrl[rows]
    for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE):
        qpos[:, model.jnt_qposadr[j]] = unwrapped(qpos[:, model.jnt_qposadr[j]])
    qvel, gain, margin = _velocities(time, qpos, record.qvel[rows], system)
    if qvel is None or len(time) - 2 * margin < 2:
        return None
    unknown = np.isnan(qpos).all(0)
    qpos[:, unknown] = model.qpos0[unknown]
    start, end = time[margin], time[len(time) - 1 - margin]
    dt = system.control_dt
    grid = start + dt * np.arange(int((end - start) / dt + 0.02) + 1)
    inner = slice(margin, len(time) - margin)
    if len(grid) < 2:
        return None
    if len(grid) == len(time[inner]) and np.abs(grid - time[inner]).max() <= 0.02 * dt:
        states = qpos[inner], qvel[inner]
        held = ctrl[inner]
    else:
        states = _interpolated(model, time, qpos, qvel, grid=grid)
        held = _averaged(time, ctrl, grid, dt)
    first, last = rows.start + margin, rows.stop - 1 - margin
    index = list(system.channel_index)
    measured = torch.zeros(2 * model.nv, dtype=torch.bool)
    measured[index] = True
    return Log(
        name=f"{record.name} rows {first} to {last}" if split else record.name,
        time=torch.from_numpy(grid),
        qpos=torch.from_numpy(states[0].copy()),
        qvel=torch.from_numpy(states[1].copy()),
        ctrl=torch.from_numpy(held.copy()),
        velocity_gain=torch.from_numpy(gain),
        measured=measured,
        first_row=first,
    )


def _velocities(
    time: Array, qpos: Array, qvel: Array, system: System
) -> tuple[Array | None, Array, int]:
    """Return velocities, estimated where needed, their gains, and the rows at ends to leave out."""
    model, columns = system.task.model, system.columns
    gain = np.zeros(model.nv)
    result = np.nan_to_num(qvel)
    margin, windows = 0, Windows(time)
    for j, joint in enumerate(joint_names(model)):
        if joint in columns.qvel or joint not in columns.qpos:
            continue
        if len(time) < 5:
            return None, gain, 0
        q, v = model.jnt_qposadr[j], model.jnt_dofadr[j]
        plain = _ROTATIONS.get(int(model.jnt_type[j]), 1)
        for i in range(plain):
            result[:, v + i], gain[v + i], half = velocity(windows, qpos[:, q + i])
            margin = max(margin, half)
        if int(model.jnt_type[j]) in _ROTATIONS:
            place = slice(v + plain, v + plain + 3)
            quaternions = qpos[:, q + plain : q + plain + 4]
            result[:, place], gain[place], half = angular_velocity(windows, quaternions)
            margin = max(margin, half)
    return result, gain, margin


def _interpolated(
    model: mujoco.MjModel, time: Array, qpos: Array, qvel: Array, *, grid: Array
) -> tuple[Array, Array]:
    """Return positions by Hermite's cubics, and velocities linearly, at the times of the grid."""
    k = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, len(time) - 2)
    length = (time[k + 1] - time[k])[:, None]
    s = np.clip((grid - time[k])[:, None] / length, 0.0, 1.0)
    velocities = (1 - s) * qvel[k] + s * qvel[k + 1]
    positions = np.empty((len(grid), model.nq))
    for j in range(model.njnt):
        kind = int(model.jnt_type[j])
        q, v, plain = model.jnt_qposadr[j], model.jnt_dofadr[j], _ROTATIONS.get(kind, 1)
        place, speed = slice(q, q + plain), slice(v, v + plain)
        change = qpos[k + 1][:, place] - qpos[k][:, place]
        step = _cubic(s, change, length * qvel[k][:, speed], length * qvel[k + 1][:, speed])
        positions[:, place] = qpos[k][:, place] + step
        if kind in _ROTATIONS:
            place, speed = slice(q + plain, q + plain + 4), slice(v + plain, v + plain + 3)
            before, after = (
                Rotation.from_quat(qpos[i][:, place], scalar_first=True) for i in (k, k + 1)
            )
            change = (before.inv() * after).as_rotvec()
            step = _cubic(s, change, length * qvel[k][:, speed], length * qvel[k + 1][:, speed])
            turned = before * Rotation.from_rotvec(step)
            quaternions = turned.as_quat(scalar_first=True)
            same = (quaternions * qpos[k][:, place]).sum(1, keepdims=True) >= 0
            positions[:, place] = np.where(same, quaternions, -quaternions)
    return positions, velocities


def _cubic(s: Array, change: Array, before: Array, after: Array) -> Array:
    """Return the cubic from 0 at ``s = 0`` to ``change`` at 1, with these slopes at the ends."""
    value = (3 * s**2 - 2 * s**3) * change
    return value + (s - 2 * s**2 + s**3) * before + (s**3 - s**2) * after


def _averaged(time: Array, ctrl: Array, grid: Array, dt: float) -> Array:
    """Return the average of what was held during each step; the last action is held on."""
    ends = np.append(time, time[-1] + 2 * dt)
    average = np.empty((len(grid), ctrl.shape[1]))
    for i, held in enumerate(ctrl.T):
        total = np.concatenate([[0.0], np.cumsum(held * np.diff(ends))])
        average[:, i] = (np.interp(grid + dt, ends, total) - np.interp(grid, ends, total)) / dt
    return average
