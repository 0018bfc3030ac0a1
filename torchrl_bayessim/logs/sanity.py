"""A sanity gate before any diagnosis: can these logs be believed?

A finding of severity ``error`` says that a part of the logs contradicts itself or cannot be used,
and `usable_logs` leaves that part out; a ``warning`` says what to know. What a simulator may get
wrong (friction, gains, delays, noise) is no error here: that is what a diagnosis is for.
"""

from __future__ import annotations

__all__ = ["check", "refuse_spoilt", "usable_logs"]

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np

from ..errors import message
from .finding import Finding
from .forces import check_forces
from .kinematics import check_channels, lattice_step, motions
from .log import Log
from .record import Record, plausible, usable_rows
from .resampling import resample
from .rotations import check_rotations
from .system import System
from .timestamps import check_time
from .units import check_offsets

# errors that happen to a robot whose logs are as they should be: an impact within a control step
# is a jump, and who swings freely has no actions. What they name is left out
_HONEST = {"push", "position_jump", "velocity_spike", "no_actions"}
_NO_COMMAND = 30.0  # times the range to which the model clips
_MALFORMED = {"missing", "action_scale", "effort", "no_motion"}  # warnings of which that is not so


def check(records: Sequence[Record], system: System, *, horizon: int = 10) -> list[Finding]:
    """Return what is wrong or odd with logs, errors first.

    Args:
        records: Trajectories as they were logged.
        system: The robot.
        horizon: Control steps that a log must have at least.

    Raises:
        ValueError: There is no log.

    Example:
        >>> from torchrl_bayessim.envs.tasks.catalogue import known_task
        >>> system = System(task=known_task("InvertedPendulum-v5"))
        >>> time = 0.04 * np.arange(50)
        >>> turning = np.stack([0 * time, np.rad2deg(time)], 1)
        >>> record = Record(name="log.csv", time=time, qpos=turning, qvel=np.ones((50, 2)),
        ...                 ctrl=np.ones((50, 1)))
        >>> finding = check([record], system)[0]
        >>> finding.kind, finding.severity, finding.rows
        ('degrees', 'error', (0, 49))
    """
    if not records:
        raise ValueError(message("at least one log", "none"))
    found: list[Finding] = []
    for record in records:
        found += check_time(record, system.control_dt)
        found += check_channels(record, system)
        found += check_rotations(record, system)
        found += _missing(record, system)
    found += _copies(records)
    found += check_offsets(records, system)
    found += _resolution(records, system)
    found += _actions(records, system)
    logs = [_logs(record, system, found) for record in records]
    found += check_forces(records, logs, system)
    for record, parts in zip(records, logs, strict=True):
        longest = max((len(log) for log in parts), default=0)
        if longest <= horizon:
            text = f"{longest} control steps in succession can be used, {horizon + 1} are needed"
            found.append(_whole("short", record, text, severity="error"))
    if len(records) == 1:
        text = "a single trajectory: nothing can be tested on another one"
        found.append(_general("single_trajectory", text))
    return sorted(found, key=lambda finding: finding.severity != "error")


def refuse_spoilt(findings: Sequence[Finding]) -> None:
    """Refuse logs that are malformed: errors that cannot happen to a robot, and missing values.

    Raises:
        ValueError: There are such findings; it names all of them, those of a kind together.
    """
    spoilt = [
        finding
        for finding in findings
        if finding.kind in _MALFORMED
        or (finding.severity == "error" and finding.kind not in _HONEST)
    ]
    texts = []
    # what is too short may be so because of the others
    spoilt.sort(key=lambda one: (one.kind == "short", one.kind))
    for kind, alike in groupby(spoilt, lambda one: one.kind):
        first, *rest = alike
        files = list(dict.fromkeys(one.file for one in rest if one.file != first.file))
        more = f"; {len(files) - 4} more files" if len(files) > 4 else ""
        also = f"; so {', '.join(files[:4])}{more}" if files else ""
        place = f"{first.file} rows {first.rows[0]} to {first.rows[1]}: " if first.file else ""
        texts.append(f"{place}{first.message} ({kind}{also})")
    if texts:
        hint = "mend them, leave them out, or go on without what is named: spoilt=leave_out"
        raise ValueError(message("logs that can be used", " | ".join(texts), hint=hint))


def usable_logs(
    records: Sequence[Record], system: System, findings: Sequence[Finding]
) -> list[Log]:
    """Return logs at the control step, without the parts that findings call an error.

    Raises:
        ValueError: Nothing is left.
    """
    general = [f for f in findings if f.severity == "error" and not f.file]
    logs = [] if general else [log for r in records for log in _logs(r, system, findings)]
    if not logs:
        errors = [str(f) for f in findings if f.severity == "error"]
        raise ValueError(message("logs that can be used", "; ".join(errors) or "none"))
    return logs


def _logs(record: Record, system: System, findings: Sequence[Finding]) -> list[Log]:
    errors = [f for f in findings if f.severity == "error" and f.file == record.name]
    try:
        return resample(record, system, leave_out=[part for f in errors for part in f.parts])
    except ValueError:  # nothing is left, and the findings say why
        return []


def _whole(kind: str, record: Record, text: str, *, severity: str = "warning") -> Finding:
    rows = 0, len(record) - 1
    return Finding(kind=kind, file=record.name, rows=rows, message=text, severity=severity)


def _general(kind: str, text: str, *, severity: str = "warning") -> Finding:
    return Finding(kind=kind, file="", rows=(0, 0), message=text, severity=severity)


def _missing(record: Record, system: System) -> Iterator[Finding]:
    """Find rows with values that are missing."""
    rows = np.flatnonzero(~usable_rows(record, system))
    if len(rows):
        text = f"{len(rows)} row(s) with values that are missing or beyond 1e8"
        place = int(rows[0]), int(rows[-1])
        yield Finding(kind="missing", file=record.name, rows=place, message=text)


def _copies(records: Sequence[Record]) -> Iterator[Finding]:
    for i, later in enumerate(records):
        for earlier in records[:i]:
            if len(earlier) == len(later) and all(
                np.array_equal(getattr(earlier, name), getattr(later, name), equal_nan=True)
                for name in ("qpos", "qvel", "ctrl")
            ):
                yield _whole("copy", later, f"a copy of {earlier.name}", severity="error")
                break


def _resolution(records: Sequence[Record], system: System) -> Iterator[Finding]:
    """Find channels that never change, or only by multiples of a step that is not small."""
    steps: dict[str, list[tuple[float, float]]] = {}
    for record in records:
        for motion in motions(record, system):
            for name, values in ("", motion.position), (" velocity", motion.velocity):
                if values is not None and plausible(values).all():
                    pair = lattice_step(values), float(np.ptp(values))
                    steps.setdefault(f"{motion.name}{name}", []).append(pair)
    if steps and not any(span for pairs in steps.values() for _, span in pairs):
        yield _general("no_motion", "no position or velocity changes in any log: nothing moves")
    for name, pairs in steps.items():
        step, span = np.median(pairs, axis=0)
        if max(span for _, span in pairs) == 0:
            yield _general("constant_channel", f"{name} never changes")
        if step > 2e-4 * span > 0:
            text = f"{name} has a resolution of {step:.3g}, {step / span:.2%} of its span"
            yield _general("resolution", text)


def _actions(records: Sequence[Record], system: System) -> Iterator[Finding]:
    for i, name in enumerate(system.task.action_names):
        every = [r.ctrl[:, i][plausible(r.ctrl[:, i])] for r in records]
        values = [v for v in every if len(v)]
        constant = [r for r, v in zip(records, every, strict=True) if len(v) and np.ptp(v) == 0]
        text = f"the action {name} never changes"
        if len(constant) == len(values):
            yield _general("constant_action", text)
        else:
            yield from (_whole("constant_action", record, text) for record in constant)
        low, high = (float(end[i]) for end in system.task.action_bounds)
        largest = max((np.abs(v).max() for v in values), default=0.0)
        if np.isfinite(high) and largest > 1.5 * max(-low, high):
            text = f"the action {name} reaches {largest:.3g}, and the model clips it to {high:.3g}"
            # no controller asks for as much; of a part that is odd, other checks know more
            wrong = np.median(np.abs(np.concatenate(values))) > _NO_COMMAND * max(-low, high)
            hint = ": in other units?" if wrong else ""
            severity = "error" if wrong else "warning"
            yield _general("action_range", text + hint, severity=severity)
