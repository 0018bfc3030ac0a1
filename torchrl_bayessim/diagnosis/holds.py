"""Samples that were not renewed: seen in the record itself, and bridged before anything is fitted.

A noisy measurement never repeats to the last digit, so a value that does was held. Its share is the
strength of ``sensor_dropout``; its error, what the robot moved meanwhile, is nobody else's. Values
on a lattice, as encoders give them, repeat by themselves, and say nothing. Where noise is added to
what is held, measured velocities may tell (`holds_in_noise`).
"""

from __future__ import annotations

__all__ = ["Hold", "bridged"]

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..effects.robot import Robot
from ..logs.finding import runs
from ..logs.kinematics import lattice_step
from ..logs.log import Log
from ..logs.velocity import Windows, velocity
from .holds_in_noise import HeldSamples, held_in_noise, with_motion

_LEAST, _ROWS = 0.01, 10  # share of the rows, and rows, that are no accident
_MOST = 0.6  # share beyond which the channel is sampled more slowly
_MOVING = 0.2  # of the mean change: what a moving joint's neighbouring samples differ by
_EQUAL = 0.3  # of the variance by chance
_NOTE = (
    "{} of {} samples of {} are taken not to have been renewed, and put where measured velocities "
    "lead"
)
_LONGEST = 12  # rows: a sample that stands still for longer is of a robot that does


@dataclass(frozen=True)
class Hold:
    """A channel whose samples are sometimes not renewed.

    Attributes:
        channel: Its name.
        share: Of the rows that repeat the one before; of those in which the joint moved, where
            velocities tell.
        error: Standard deviation of the share.
    """

    channel: str
    share: float
    error: float


def bridged(logs: Sequence[Log], robot: Robot) -> tuple[list[Log], list[Hold], list[str]]:
    """Return the logs with held samples replaced, and the channels concerned.

    By straight lines, or where measured velocities lead, if those say that they are held. And an
    alarm for each that only is slower than the log: it is renewed in equal intervals.

    Args:
        logs: As recorded.
        robot: Its channels; those of hinges and slides are looked at.
    """
    found, alarms, result = [], [], list(logs)
    for number, channel in enumerate(robot.channels):
        joint, kind = robot.channel_joint[number], robot.channel_kind[number]
        if joint < 0 or kind not in {"position", "velocity"}:
            continue
        name = "qpos" if kind == "position" else "qvel"
        index = (robot.qpos_index if kind == "position" else robot.dof_index)[joint]
        dof = robot.dof_index[joint]
        columns = [getattr(log, name)[:, index].numpy() for log in result]
        held, led = _to_the_digit(columns), False
        if kind == "position" and not _enough(columns, held):
            in_noise = _in_noise(result, index, dof)
            held, led = (held, False) if in_noise is None else (in_noise, True)
        if not _enough(columns, held) or held.share > _MOST:
            continue
        if _regular(held.rows):
            way = "where its velocities lead" if led else "straight"
            alarms.append(
                f"{channel} is renewed every {1 / (1 - held.share):.2g} rows: between them it was "
                f"taken to go {way}"
            )
        else:
            error = float(np.sqrt(held.share * (1 - held.share) / held.count))
            found.append(Hold(channel, held.share, error))
            if led:
                rows = sum(int(h.sum()) for h in held.rows)
                alarms.append(_NOTE.format(rows, sum(map(len, held.rows)), channel))
        result = [
            _replaced(
                log, name, index, h, led=held.gain * log.qvel[:, dof].numpy() if led else None
            )
            if h.any()
            else log
            for log, h in zip(result, held.rows, strict=True)
        ]
        if kind == "position":
            result = [_slope(log, index, dof) for log in result]
    return result, found, alarms


def _enough(columns: Sequence[NDArray[np.float64]], held: HeldSamples) -> bool:
    """Return whether so many samples are held while a joint moves that it is no accident."""
    moving = sum(_moving(column, h) for column, h in zip(columns, held.rows, strict=True))
    return moving >= max(_ROWS, _LEAST * held.count)


def _regular(held: Sequence[NDArray[np.bool_]]) -> bool:
    """Return whether samples are renewed in intervals more equal than chance makes them.

    >>> every_other = np.arange(400) % 2 == 1
    >>> _regular([every_other]), _regular([np.random.default_rng(0).random(400) < 0.5])
    (True, False)
    """
    share = float(np.concatenate(held).mean())
    intervals = np.concatenate([np.diff(np.flatnonzero(~h)) for h in held])
    by_chance = share / (1 - share) ** 2  # of a geometric distribution
    return len(intervals) > 1 and float(intervals.var()) < _EQUAL * by_chance


def _held(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which samples repeat the one before, but for a few rows only."""
    held = np.zeros(len(values), dtype=bool)
    if len(values) < 3 or lattice_step(values) > 0:
        return held
    for first, last in runs(np.diff(values) == 0):
        held[first + 1 : last + 2] = last - first < _LONGEST
    return held


def _moving(values: NDArray[np.float64], held: NDArray[np.bool_]) -> int:
    """Return how many single samples are held between others that differ."""
    change = np.abs(np.diff(values))
    least = _MOVING * float(change.mean()) if len(change) else 0.0
    return int((held[1:-1] & (change[1:] > least) & (np.append(np.inf, change[:-2]) > least)).sum())


def _to_the_digit(columns: Sequence[NDArray[np.float64]]) -> HeldSamples:
    """Return which samples repeat the one before exactly."""
    rows = [_held(column) for column in columns]
    count = sum(len(h) - 1 for h in rows)
    return HeldSamples(rows, sum(int(h.sum()) for h in rows) / max(count, 1), count)


def _in_noise(logs: Sequence[Log], index: int, dof: int) -> HeldSamples | None:
    """Return which samples are held where noise was added to them, by measured velocities."""
    measured = all(bool(log.measured[log.qvel.shape[1] + dof]) for log in logs)
    angles = [log.qpos[:, index].numpy() for log in logs]
    on_lattice = any(lattice_step(one) > 0 for one in angles if len(one) > 2)
    if not measured or on_lattice or max(map(len, angles), default=0) < _ROWS:
        return None
    dt = float(np.median(np.concatenate([np.diff(log.time.numpy()) for log in logs])))
    return held_in_noise(angles, [log.qvel[:, dof].numpy() for log in logs], dt)


def _replaced(
    log: Log,
    name: str,
    index: int,
    held: NDArray[np.bool_],
    *,
    led: NDArray[np.float64] | None,
) -> Log:
    """Return a log with held samples on straight lines, or where velocities lead."""
    values, time = getattr(log, name).clone(), log.time.numpy()
    column = values[:, index].numpy()
    if led is None:
        column = np.interp(time, time[~held], column[~held])
    else:
        column = with_motion(column, led, held, time)
    values[:, index] = torch.from_numpy(column)
    return replace(log, **{name: values})


def _slope(log: Log, index: int, dof: int) -> Log:
    """Return the log with the velocity estimated anew, where it was estimated."""
    if not log.velocity_gain[dof]:
        return log
    speeds, gains = log.qvel.clone(), log.velocity_gain.clone()
    slope, gain, _ = velocity(Windows(log.time.numpy()), log.qpos[:, index].numpy())
    speeds[:, dof], gains[dof] = torch.from_numpy(slope), gain
    return replace(log, qvel=speeds, velocity_gain=gains)
