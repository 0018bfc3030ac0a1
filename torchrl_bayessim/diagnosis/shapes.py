"""Frequency and phase of periodic forces, and the step of commands, read off the missing force.

A periodic disturbance ``s sin(2πft + φ)`` and cogging ``s sin(kq + φ)`` each have two numbers
beside their strength, which no screen at fixed values can find. Over a few steps a missing force is
nearly constant, so its course is estimated first, one value per short segment and joint, and the
best sine over time and over position is fitted to it: to the force that is missing beside those of
other joints, and to the one that alone would explain most (see `missing_force`). Segments begin at
every half of their length, or nearly, so that a fast sine is not taken for a slow one which is the
same in every segment. So is fitted what rounding the recorded commands would have taken away or
added, since signatures of two steps that differ a little have nothing in common.
"""

from __future__ import annotations

__all__ = ["SHAPED", "at_step", "shaped", "with_shapes"]

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..effects.action import ActionQuantization
from ..effects.disturbance import Cogging, PeriodicDisturbance
from ..effects.effect import Effect
from ..effects.robot import Robot
from ..effects.units import slides
from ..logs.log import Log
from .missing_force import Forces, missing_forces
from .objective import Objective, Point, Unit, parameters_at, units_of
from .prediction import Predictor
from .screening import LEVELS
from .segments import cut
from .splits import stretch
from .whitening import whitening

Array = NDArray[np.float64]
SHAPED = (PeriodicDisturbance.name, Cogging.name, ActionQuantization.name)
_STEPS, _FEWEST_STEPS = 6, 3  # control steps over which a force is taken to be constant
_SECONDS = 0.12  # the same, where that many are not too few
_BEFORE = 8  # control steps that effects remember
_MOST = 400  # segments
_SLOWEST = 0.5  # cycles per log: slower ones are trends
_FASTEST = 0.75  # cycles per segment, of which the mean is a third of the largest force
_FEWEST, _NUMBERS = 2.0, 25.0  # cogs per turn; one is gravity's
_SAME = 1.5  # steps between rates that are tried: the same one
_TURNED = 0.01  # rad, of a phase that is another one
_CLEAR = 0.1  # share of the force's variance that a sine or a step must explain
_ALIKE = 0.1  # of the median variance of forces
_FINEST, _GRID = 0.02, 600  # of the largest step that is plausible; steps tried


def shaped(
    predictor: Predictor, logs: Sequence[Log], *, point: Point, noise: Array, pushes: Sequence[Unit]
) -> list[Unit]:
    """Return periodic disturbances, cogging, and rounded commands, where they stand out.

    Args:
        predictor: Simulates.
        logs: The training logs.
        point: What is in the model already.
        noise: Standard deviation of each channel's noise.
        pushes: A constant force at each joint.
    """
    history = _BEFORE if point.strengths else 1
    system = predictor.system
    steps = int(np.clip(round(_SECONDS / system.control_dt), _FEWEST_STEPS, _STEPS))
    logs = [log for log in logs if len(log) > max(2 * steps, history + steps)]
    if not pushes or not logs:
        return []
    ways, time, qpos, ctrl = _missing(
        predictor, logs, point=point, noise=noise, pushes=pushes, history=history, steps=steps
    )
    span = float(np.mean([len(log) for log in logs])) * system.control_dt
    fastest = _FASTEST / (steps * system.control_dt)
    frequencies = np.arange(_SLOWEST / span, fastest, 0.125 / span)
    units: list[Unit] = []
    for i, push in enumerate(pushes):
        joint = push.joint(system.robot)
        positions = qpos[..., system.robot.qpos_index[joint]]
        numbers = (_waves if slides(system.robot, joint) else _numbers)(positions)
        found: list[Effect] = []
        for force, weight in ways:
            seen = force[:, i], weight[:, i]
            found += _waving(*seen, time, frequencies, there=found)
            found += _cogging(*seen, positions, numbers, there=found)
        units += [u for u in units_of(found, system.robot) if u.where == push.where]
    return units + _rounded(*ways[0], ctrl, pushes=pushes, robot=system.robot)


def _rounded(
    force: Array, weight: Array, ctrl: Array, *, pushes: Sequence[Unit], robot: Robot
) -> list[Unit]:
    """Return rounded commands of those drives of which a step stands out."""
    found = []
    for unit in units_of([ActionQuantization()], robot):
        joint, actuator = unit.joint(robot), unit.direction.index(1.0)
        column = next((i for i, p in enumerate(pushes) if p.joint(robot) == joint), None)
        if joint < 0 or column is None or unit.where == "all":
            continue
        step = _rounding(force[:, column], weight[:, column], ctrl[..., actuator], most=unit.high)
        if step is not None:
            found.append(at_step(unit, step))
    return found


def _waving(
    force: Array, weight: Array, time: Array, frequencies: Array, *, there: Sequence[Effect]
) -> list[Effect]:
    """Return the periodic disturbance that stands out, if it is another than those there are."""
    best = _sine(force, weight, 2 * np.pi * time, frequencies)
    others = [e.frequency for e in there if isinstance(e, PeriodicDisturbance)]
    if best is None or _known(best[0], others, frequencies):
        return []
    return [PeriodicDisturbance(frequency=best[0], phase=best[1])]


def _cogging(
    force: Array, weight: Array, positions: Array, numbers: Array, *, there: Sequence[Effect]
) -> list[Effect]:
    """Return the cogging that stands out, beside a constant or as part of a wave, if it is new."""
    others = [e.number for e in there if isinstance(e, Cogging)]
    middle = _middle(positions)
    best = _sine(force, weight, middle, numbers)
    if best is None or _known(best[0], others, numbers):
        return []
    found: list[Effect] = [Cogging(number=best[0], phase=best[1])]
    if best[0] * np.ptp(positions) < 2 * np.pi:
        part = _sine(force, weight, middle, numbers, offset=False)
        new = part is not None and (part[0] != best[0] or abs(part[1] - best[1]) > _TURNED)
        found += [Cogging(number=part[0], phase=part[1])] if part is not None and new else []
    return found


def _middle(rows: Array) -> Array:
    """Return what rows ``(S, T)`` of segments hold in the middle of their ``T`` steps, ``(S,)``.

    Example:
        >>> rows = np.arange(4.0)[None]
        >>> float(_middle(rows)[0]), float(_middle(rows[:, :3])[0])
        (2.0, 1.5)
    """
    half = rows.shape[1] // 2
    return 0.5 * (rows[:, half] + rows[:, half + rows.shape[1] % 2])


def _known(rate: float, others: Sequence[float], rates: Array) -> bool:
    """Return whether a rate is one of others, or next to it among those that are tried."""
    apart = float(rates[1] - rates[0]) if len(rates) > 1 else 0.0
    return any(abs(rate - other) <= _SAME * apart for other in others)


def at_step(unit: Unit, step: float) -> Unit:
    """Return rounded commands of which the screen's higher level is the step itself."""
    return replace(unit, high=step / LEVELS[-1])


def _missing(
    predictor: Predictor,
    logs: Sequence[Log],
    *,
    point: Point,
    noise: Array,
    pushes: Sequence[Unit],
    history: int,
    steps: int,
) -> tuple[tuple[tuple[Array, Array], tuple[Array, Array]], Array, Array, Array]:
    """Return missing forces of short segments, together and alone, times, positions and commands.

    Of the forces, and how much each counts, ``(S, J)``; of the time in the middle ``(S,)``; of the
    others at every row of a segment, ``(S, T, *)``.
    """
    half = steps // 2
    shifted = [stretch(log, half, len(log)) for log in logs]
    shifted = [log for log in shifted if len(log) > history + steps]
    ways: list[tuple[Forces, Forces]] = []
    seen = []
    for some in [logs, shifted] if shifted else [logs]:
        pieces = cut(some, steps, history=history, most=_MOST // 2)
        prior = predictor.system.prior
        white = whitening(predictor, pieces, parameters_at(prior, point.z), noise)
        objective = Objective(predictor, prior, pieces, white)
        ways.append(missing_forces(objective, point, pushes))
        begin = pieces.history
        window = slice(begin, begin + steps)
        seen.append((pieces.time[:, window], pieces.qpos[:, window], pieces.ctrl[:, window]))
    time, qpos, ctrl = (np.concatenate(part) for part in zip(*seen, strict=True))
    together, alone = (_weighed(way) for way in zip(*ways, strict=True))
    return (together, alone), _middle(time), qpos, ctrl


def _weighed(parts: Sequence[Forces]) -> tuple[Array, Array]:
    """Return the forces of several sets of segments, and how much each counts."""
    forces, variances = (np.concatenate(part) for part in zip(*parts, strict=True))
    # what is wrong beside a constant force errs too, by no more where a force shows best
    weight = 1.0 / (variances + _ALIKE * np.median(variances, axis=0))
    return forces, weight / weight.mean(0)


def with_shapes(units: Sequence[Unit], found: Sequence[Unit]) -> list[Unit]:
    """Return the units, with those that were found in the place of their like."""
    better = {(unit.name, unit.where) for unit in found}
    return [u for u in units if (u.name, u.where) not in better] + [*found]


def _waves(positions: Array) -> Array:
    """Return rates over a slide's position, rad/m, of positions ``(S, T)`` of short segments.

    From half a period over all that it travels to half a period within a segment.
    """
    travel, within = float(np.ptp(positions)), float(np.median(np.ptp(positions, axis=1)))
    if within <= 0:
        return np.zeros(0)
    slowest = np.pi / travel
    return np.arange(slowest, np.pi / within, 0.25 * slowest)[:_GRID]


def _numbers(positions: Array) -> Array:
    """Return numbers per turn of a hinge, as close as its way tells them apart, at most one."""
    apart = min(1.0, 0.25 * np.pi / max(float(np.ptp(positions)), 1e-9))
    return np.arange(_FEWEST, _NUMBERS, max(apart, (_NUMBERS - _FEWEST) / _GRID))


def _rounding(force: Array, weight: Array, commands: Array, *, most: float) -> float | None:
    """Return the step to which commands ``(S, T)`` seem to be rounded, if one stands out."""
    root = np.sqrt(weight)
    target = root * _centred(_clipped(force), weight)
    best, choice = _CLEAR * float(target @ target), None
    for step in most * np.geomspace(_FINEST, 1.0, _GRID):
        error = (np.round(commands / step) * step - commands).mean(1)
        error = root * _centred(error, weight)
        along = float(error @ target)
        if along > 0 and along**2 > best * float(error @ error):
            best, choice = along**2 / float(error @ error), float(step)
    return choice


def _sine(
    force: Array, weight: Array, angle: Array, rates: Array, *, offset: bool = True
) -> tuple[float, float] | None:
    """Return rate and phase of the sine of the angle that explains most, if it stands out.

    Args:
        force: Shape ``(S,)``.
        weight: How much each counts, shape ``(S,)``.
        angle: Shape ``(S,)``.
        rates: Of the angle, those that are tried.
        offset: Whether the force has a constant beside the sine, which other effects may make. Of
            a wave that is longer than the way, the mean over that is a part of the sine.
    """
    root = np.sqrt(weight)
    target = _clipped(force)
    total = float((weight * _centred(target, weight) ** 2).sum())
    target = root * target
    best, choice = _CLEAR * total, None
    for rate in rates:
        columns = np.stack([np.sin(rate * angle), np.cos(rate * angle)], 1)
        if offset:
            columns = np.c_[columns, np.ones_like(angle)]
        columns = root[:, None] * columns
        solution, *_ = np.linalg.lstsq(columns, target, rcond=None)
        explained = total - float(((target - columns @ solution) ** 2).sum())
        if explained > best:
            best = explained
            choice = float(rate), math.atan2(solution[1], solution[0])
    return choice


def _centred(values: Array, weight: Array) -> Array:
    return values - np.average(values, weights=weight)


def _clipped(force: Array) -> Array:
    """Return the force without what short segments make of single rows."""
    center = np.median(force)
    bound = 4.0 * np.median(np.abs(force - center)) + 1e-12
    return np.clip(force, center - bound, center + bound)
