r"""Do positions and velocities of a log agree with each other, and with what sensors can show?

For every channel with both, :math:`\int v\,dt` over a stretch of rows must be the change of
position. What does not agree is sensing or timing, never dynamics, whatever the robot does: the
checks hold through impacts. Thresholds are multiples of robust scales of the same record.
"""

from __future__ import annotations

__all__ = [
    "check_channels",
    "lattice_step",
    "meaning",
    "motions",
    "over",
    "stretch",
    "white_noise",
]

from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from .columns import joint_names
from .finding import Finding, runs
from .glitches import beyond_all
from .record import Record, plausible, unwrapped, wraps
from .system import System

Array = NDArray[np.float64]
_CLEAR = 30.0  # times the noise that a motion must be for what it says to count
_LIKE = 0.7  # correlation with a velocity that jumps within a step, as at a joint's limit
_WRONG = 4.0  # times as fast: no sensor's error, but another unit, whatever it is
_RATIOS = {  # change of position by integrated velocity: what that means
    57.3: "positions are in degrees, velocities in radians",
    1 / 57.3: "velocities are in degrees, positions in radians",
    2 * np.pi / 60: "velocities are in revolutions per minute",
    2 * np.pi: "velocities are in revolutions",
    1e3: "velocities per millisecond, or positions in thousandths",
    1e-3: "velocities in thousandths",
}


class Motion(NamedTuple):
    """One coordinate: its columns, positions (without turns of 2π) and velocities if measured."""

    name: str
    position: Array
    velocity: Array | None
    hinge: bool
    range: tuple[float, float] | None


def motions(record: Record, system: System) -> list[Motion]:
    """Return the measured coordinates of a record, rotations in space left out."""
    model, columns = system.task.model, system.columns
    found = []
    for j, joint in enumerate(joint_names(model)):
        names, speeds = columns.qpos.get(joint, ()), columns.qvel.get(joint, ())
        plain = len(names) if len(names) == 1 else len(names) - 4
        hinge = model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
        for i in range(max(plain, 0)):
            position = record.qpos[:, model.jnt_qposadr[j] + i]
            velocity = record.qvel[:, model.jnt_dofadr[j] + i] if speeds else None
            limits = tuple(model.jnt_range[j]) if hinge and model.jnt_limited[j] else None
            found.append(Motion(names[i], position, velocity, bool(hinge), limits))
    return found


def check_channels(record: Record, system: System) -> Iterator[Finding]:
    """Yield what is wrong with the positions and velocities of a record."""
    good = np.isfinite(record.time) & (np.diff(record.time, prepend=-np.inf) > 0)
    for motion in motions(record, system):
        known = good & plausible(motion.position)
        if motion.velocity is not None:
            known &= plausible(motion.velocity)
        rows = np.flatnonzero(known)
        if len(rows) < 10 or np.median(np.diff(record.time[rows])) <= 0:
            continue  # a clock that goes back and on again tells no speeds
        speed = None if motion.velocity is None else motion.velocity[rows]
        seen = motion._replace(position=motion.position[rows], velocity=speed)
        for kind, marked, text, severity in _findings(seen, record.time[rows]):
            parts = tuple((int(rows[a]), int(rows[b])) for a, b in runs(marked))
            yield Finding(
                kind=kind,
                file=record.name,
                rows=(parts[0][0], parts[-1][1]),
                message=f"{motion.name}: {text}",
                severity=severity,
                parts=parts,
            )


Found = tuple[str, NDArray[np.bool_], str, str]


def _findings(motion: Motion, time: Array) -> Iterator[Found]:
    everywhere = np.ones(len(time), dtype=bool)
    limits = motion.range
    if limits is not None:
        reach = np.abs(motion.position - np.mean(limits)).max() / (np.diff(limits)[0] / 2)
        inside = np.abs(np.deg2rad(motion.position) - np.mean(limits)).max()
        if reach > 5 and inside < np.diff(limits)[0]:
            yield "degrees", everywhere, "far beyond the joint's range, degrees?", "error"
            return
        if reach > 1.5:
            yield "range", everywhere, "beyond the range of the joint in the model", "warning"
    if motion.hinge:
        turns = wraps(motion.position)
        if turns.any():
            marked = np.append(turns, False)
            yield "wrap", marked, f"{turns.sum()} jump(s) of a turn, undone", "warning"
            motion = motion._replace(position=unwrapped(motion.position))
    if (wrong := beyond_all(motion.position)).any():
        text = f"{wrong.sum()} row(s) far beyond all others, out and back at once"
        yield "glitch", wrong, text, "error"
        mended = np.interp(time, time[~wrong], motion.position[~wrong])
        motion = motion._replace(position=mended)
    yield from _repeats(motion, time)
    if motion.velocity is None:
        yield from _glitches(motion.position)
    elif np.ptp(motion.position) == 0 and np.ptp(motion.velocity) > 0:
        steps = np.diff(time)
        travelled = np.ptp(np.cumsum(steps * motion.velocity[1:]))
        if travelled > 10 * motion.velocity.std() * np.median(steps):
            yield "frozen", everywhere, "never changes while its velocity does", "error"
    else:
        yield from _agreement(motion, motion.velocity, time)


def _agreement(motion: Motion, velocity: Array, time: Array) -> Iterator[Found]:
    """Compare the change of position with integrated velocity."""
    everywhere = np.ones(len(time), dtype=bool)
    steps, change = np.diff(time), np.diff(motion.position)
    travelled = steps * (velocity[1:] + velocity[:-1]) / 2
    span = stretch(steps, len(time))
    moved, integrated = over(change, span), over(travelled, span)
    if min(moved.std(), integrated.std()) > 0:
        correlation = float(np.corrcoef(moved, integrated)[0, 1])
        ratio = moved.std() / integrated.std()
        if correlation < -0.9:
            yield "velocity_sign", everywhere, "its velocity has the opposite sign", "error"
            return
        if correlation > 0.9 and not 0.85 < ratio < 1.18:
            known = meaning(ratio)
            text = known or f"changes {ratio:.3g} times as fast as its velocity"
            wrong = known or not 1 / _WRONG < ratio < _WRONG
            yield "velocity_scale", everywhere, text, "error" if wrong else "warning"
            return
        if correlation > 0.9:
            yield from _lag(change, travelled, span, steps)
    if text := _mismatch(motion, velocity, (moved, integrated), steps):
        yield "velocity_mismatch", everywhere, text, "error"
        return
    yield from _outliers(motion, change - travelled, velocity, steps)


def _mismatch(
    motion: Motion, velocity: Array, over: tuple[Array, Array], steps: Array
) -> str | None:
    """Say how a velocity is another quantity, where motion and velocity are far above noise."""
    (moved, integrated), span = over, len(steps) - len(over[0]) + 1
    dt = np.median(steps)
    told = moved.std() / (white_noise(motion.position) + lattice_step(motion.position) + 1e-12)
    if told > _CLEAR and np.ptp(velocity) == 0:
        return "moves while its velocity never changes"
    noise = dt * (white_noise(velocity) * span**0.5 + lattice_step(velocity) * span) + 1e-12
    if min(told, integrated.std() / noise) < _CLEAR:
        return None
    usual = np.abs(moved) < 6 * np.median(np.abs(moved)) + 1e-12  # without jumps
    usual &= np.abs(integrated) < 6 * np.median(np.abs(integrated)) + 1e-12
    for rows in usual, np.ones(len(moved), dtype=bool):
        if rows.sum() < 10 or min(moved[rows].std(), integrated[rows].std()) == 0:
            continue
        ratio = moved[rows].std() / integrated[rows].std()
        if _likeness(moved, integrated, rows) > _LIKE and 1 / 3 < ratio < 3:
            return None
    return "does not move as its velocity says: are columns swapped?"


def white_noise(values: Array) -> float:
    """Return the standard deviation of white noise on values, from their third differences."""
    return float(1.4826 * np.median(np.abs(np.diff(values, 3, axis=0))) / np.sqrt(20))


def _likeness(first: Array, second: Array, rows: NDArray[np.bool_]) -> float:
    """Return the largest correlation in rows of two series up to ten rows apart."""
    reach = min(10, len(first) // 10)
    found = [0.0]
    for lag in range(-reach, reach + 1):
        inner = rows & np.roll(rows, lag)
        inner[:reach] = inner[len(inner) - reach :] = False
        pair = first[inner], np.roll(second, lag)[inner]
        if inner.sum() > 2 and min(pair[0].std(), pair[1].std()) > 0:
            found.append(abs(float(np.corrcoef(*pair)[0, 1])))
    return max(found)


def stretch(steps: Array, rows: int) -> int:
    """Return over how many steps motion and velocity are compared: a tenth of a second, or so."""
    return int(np.clip(np.ceil(0.1 / np.median(steps)), 3, max(3, rows // 8)))


def meaning(ratio: float) -> str:
    """Return what a ratio of motion to integrated velocity means, nothing if it is no unit's."""
    return next((text for r, text in _RATIOS.items() if abs(np.log(ratio / r)) < 0.15), "")


def over(values: Array, span: int) -> Array:
    """Return sums over ``span`` steps in succession, shape ``(T - span + 1, *)``."""
    total = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    return total[span:] - total[:-span]


def _lag(change: Array, travelled: Array, span: int, steps: Array) -> Iterator[Found]:
    """Find the delay of velocities against positions, where it explains what does not agree."""
    reach = min(10, len(change) // 10)
    lags = np.arange(-reach, reach + 1)
    inner = slice(reach, len(change) - reach)
    errors = [
        np.median(np.abs(over(change[inner] - np.roll(travelled, -lag)[inner], span)))
        for lag in lags
    ]
    best = int(np.argmin(errors))
    if lags[best] != 0 and errors[best] < 0.4 * errors[reach]:
        late = lags[best] * np.median(steps)
        text = f"its velocity lags by about {1e3 * late:.0f} ms"
        yield "velocity_lag", np.ones(len(change) + 1, dtype=bool), text, "warning"


def _outliers(motion: Motion, error: Array, velocity: Array, steps: Array) -> Iterator[Found]:
    """Find jumps of position and spikes of velocity that the other one does not share."""
    change = np.diff(motion.position)
    scale = 1.4826 * np.median(np.abs(error - np.median(error)))
    floor = 0.05 * np.sqrt(np.mean(velocity**2)) * steps + 3 * lattice_step(motion.position)
    near = maximum_filter1d(np.maximum(np.abs(velocity[1:]), np.abs(velocity[:-1])), 3)
    # beside a repeated sample a step catches up: the repetition is reported, not the step
    odd = maximum_filter1d((change == 0).astype(int), 5) == 0
    jumps = odd & (np.abs(change) > 2.5 * near * steps + 10 * scale + floor)
    rare = 0.02 * len(steps) + 1
    if jumps.any():
        marked = np.append(jumps, False) | np.append(False, jumps)
        text = f"{jumps.sum()} jump(s) that its velocity does not show"
        yield "position_jump", marked, text, "error" if jumps.sum() <= rare else "warning"
    signs = np.sign(error[1:]) == np.sign(error[:-1])
    both = np.minimum(np.abs(error[1:]), np.abs(error[:-1])) > 8 * scale + floor[1:]
    rise, fall = np.diff(velocity)[:-1], -np.diff(velocity)[1:]
    alone = np.minimum(rise * np.sign(rise), fall * np.sign(rise)) > 2 * np.abs(rise - fall)
    spikes = signs & both & alone & ~jumps[1:] & ~jumps[:-1] & odd[1:] & odd[:-1]
    if spikes.any():
        marked = np.concatenate([[False], spikes, [False]])
        text = f"{spikes.sum()} spike(s) of its velocity that it does not follow"
        yield "velocity_spike", marked, text, "error" if spikes.sum() <= rare else "warning"


def _glitches(position: Array) -> Iterator[Found]:
    """Find single rows far off both neighbours, which agree with each other."""
    bend = position[1:-1] - (position[2:] + position[:-2]) / 2
    scale = 1.4826 * np.median(np.abs(bend)) + lattice_step(position)
    beside = np.abs(position[2:] - position[:-2])
    marked = np.abs(bend) > 20 * scale + 2 * beside + 0.02 * position.std()
    if marked.any() and marked.sum() <= 0.02 * len(position) + 1:
        everywhere = np.concatenate([[False], marked, [False]])
        text = f"{marked.sum()} row(s) far from both neighbours"
        yield "position_jump", everywhere, text, "error"


def _repeats(motion: Motion, time: Array) -> Iterator[Found]:
    """Find samples that repeat, and stand still, while the joint moves."""
    change = np.diff(motion.position)
    still = change == 0
    step = lattice_step(motion.position)
    beside = np.minimum(
        np.abs(np.concatenate([[0.0], change[:-1]])), np.abs(np.append(change[1:], 0.0))
    )
    moving = still & (beside > 3 * step) & (beside > 0.2 * np.abs(change).mean())
    share = moving.sum() / max(1, (np.abs(change) > 3 * step).sum())
    if share > 0.01 and moving.sum() >= 5:
        text = f"repeats the row before in {share:.0%} of the rows while it moves"
        yield "repeated_samples", np.append(False, moving), text, "warning"
    if motion.velocity is None:
        return
    travelled = np.diff(time) * (motion.velocity[1:] + motion.velocity[:-1]) / 2
    error = change - travelled
    noise = 1.4826 * np.median(np.abs(error))
    frozen = np.zeros(len(time), dtype=bool)
    for first, last in runs(still):
        rows = last - first + 1
        far = abs(travelled[first : last + 1].sum())
        if rows >= 10 and far > 20 * noise + 5 * step + 0.05 * np.ptp(motion.position):
            frozen[first : last + 2] = True
    if frozen.any() and not frozen.all():
        yield "frozen", frozen, "stands still while its velocity says that it moves", "error"


def lattice_step(values: Array) -> float:
    """Return the step of which all differences are multiples, 0 where there is none.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> round(lattice_step(0.25 * np.round(rng.normal(size=400) * 8)), 6)
        0.25
        >>> lattice_step(rng.normal(size=400))
        0.0
    """
    levels = np.unique(values)
    if len(levels) < 3 or len(levels) > 0.8 * len(values):
        return 0.0
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * np.ptp(levels)]
    step = float(np.median(gaps[gaps < 1.5 * np.quantile(gaps, 0.1)]))
    return step if np.mean(np.abs(gaps / step - np.round(gaps / step)) < 0.1) > 0.95 else 0.0
