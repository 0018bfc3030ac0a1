"""Are the rows of a log where their times say?"""

from __future__ import annotations

__all__ = ["check_time"]

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .finding import Finding, runs
from .record import Record

_DAY = 86400.0  # seconds
_SET = 1e3  # times all other rows together, that a clock is ahead which was set, and no gap
_COARSE, _FASTEST = 20.0, 0.02  # control steps between rows, and share of one
_UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}


def check_time(record: Record, control_dt: float) -> Iterator[Finding]:
    """Yield what is wrong with the times of a record whose rows should be near a control step."""
    time, last = record.time, len(record) - 1
    unknown = ~np.isfinite(time)
    backward = _not_after(np.where(unknown, -np.inf, time)) & ~unknown
    repeated = backward & np.isin(time, time[~backward & ~unknown])
    yield from _rows(record, unknown, "not_finite_time", "the time is missing or no time")
    yield from _rows(record, repeated, "repeated_time", "a time that a row before has")
    yield from _rows(record, backward & ~repeated, "backward_time", "the time goes backwards")
    rows = np.flatnonzero(~unknown & ~backward)
    if len(rows) < 3:
        return
    steps = np.diff(time[rows])
    usual = float(np.median(steps))
    # beyond what a coarse log has, rows may be those of a logger faster than the control
    least = _FASTEST if usual > _COARSE * control_dt else 0.2
    for factor, name in _UNITS.items():
        if least < usual / (factor * control_dt) < 5:
            text = f"rows are {usual:g} s apart at a control step of {control_dt:g} s: {name}?"
            yield Finding(
                kind="time_unit", file=record.name, rows=(0, last), message=text, severity="error"
            )
            return
    if usual > 1.5 * control_dt:
        text = (
            f"rows are {usual:.4g} s apart, further than the control step of {control_dt:.4g} s: "
            "states between them are interpolated"
        )
        yield Finding(kind="coarse_time", file=record.name, rows=(0, last), message=text)
    actions = record.ctrl[rows]
    changes = int((actions[1:] != actions[:-1]).any(1).sum())
    often = (time[rows[-1]] - time[rows[0]]) / max(changes, 1)
    if usual < control_dt / 1.5 and often < control_dt / 1.5:
        text = (
            f"actions change every {often:.2g} s, more often than once in the control step of "
            f"{control_dt:.4g} s, and are averaged over it: is control_dt right?"
        )
        yield Finding(kind="fine_time", file=record.name, rows=(0, last), message=text)
    gaps = np.flatnonzero(steps > 2.5 * max(usual, control_dt))
    if len(gaps):
        longest = steps[gaps].max()
        text = f"{len(gaps)} gap(s) between rows, the longest of {longest:.3g} s"
        place = int(rows[gaps[0]]), int(rows[gaps[-1] + 1])
        yield Finding(kind="gap", file=record.name, rows=place, message=text)
    ahead = np.flatnonzero((steps > _DAY) & (steps > _SET * (steps.sum() - steps)))
    if len(ahead):
        marked = np.isin(np.arange(last + 1), [rows[ahead], rows[ahead + 1]])
        text = f"the time jumps by {steps[ahead[0]]:.3g} s: was the clock set?"
        yield from _rows(record, marked, "clock_set", text)
    jitter = np.abs(steps / usual - 1)
    if np.mean(jitter > 0.2) > 0.05:
        text = f"{np.mean(jitter > 0.2):.0%} of the steps differ from the usual by over a fifth"
        yield Finding(kind="jitter", file=record.name, rows=(0, last), message=text)


def _not_after(time: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which times are not after all those before."""
    before = np.maximum.accumulate(time)
    return np.concatenate([[False], time[1:] <= before[:-1]])


def _rows(record: Record, marked: NDArray[np.bool_], kind: str, text: str) -> Iterator[Finding]:
    if marked.any():
        parts = runs(marked)
        place = parts[0][0], parts[-1][1]
        count = f"{int(marked.sum())} row(s)"
        yield Finding(
            kind=kind,
            file=record.name,
            rows=place,
            message=f"{text}: {count}",
            severity="error",
            parts=parts,
        )
