r"""Do logged actions push the way that joints accelerate, and does nothing else push?

A factor :math:`\gamma` of the actuators far from 1 (see `inverse_dynamics`) means an action of
another sign or unit, and only a force that no actuator could exert stands out of the rest. Where
the regression is uncertain, nothing is found. A log whose actions are in another order is named by
`swaps`, one whose motion or actions are in other units than in the rest by `units`, and says
nothing here.
"""

from __future__ import annotations

__all__ = ["check_forces"]

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from .columns import joint_names
from .finding import Finding, runs
from .inverse_dynamics import Dynamics, Fit, Terms, actuated_joints, dynamics, fit_terms, is_servo
from .log import Log
from .record import Record
from .swaps import check_swaps
from .system import System
from .units import check_units

Array = NDArray[np.float64]
_WINDOW = 0.1  # s
_EFFORT = 5  # times the largest force there is, in half of the rows


def check_forces(
    records: Sequence[Record], logs: Sequence[Sequence[Log]], system: System
) -> Iterator[Finding]:
    """Yield what is wrong with the actions, given each record's logs."""
    model = system.task.model
    if model.nu == 0 or model.na > 0 or system.task.drive.relative or system.task.converts:
        return
    half = max(2, round(_WINDOW / system.control_dt / 2))
    moved = [
        dynamics(model, record, log, half)
        for record, parts in zip(records, logs, strict=True)
        for log in parts
        if len(log) >= 8 * half and bool(log.measured[: model.nv].all())
    ]
    swapped = list(check_swaps(moved, system, half))
    yield from swapped
    if any(not finding.file for finding in swapped):
        return
    moved = _without(moved, swapped)
    # a servo says what its unit is: that of its commands
    unlike = list(_check_commands(moved, model))
    yield from unlike
    moved = _without(moved, [finding for finding in unlike if finding.severity == "error"])
    odd = list(check_units(moved, system, half))
    yield from odd
    moved = _without(moved, odd)
    for joint, dof in actuated_joints(model):
        name = joint_names(model)[joint]
        fits = [
            (one.record, one.log, one.terms(dof), one.free, fit)
            for one in moved
            if (fit := fit_terms(one.terms(dof), half=half))
        ]
        if not _servos(model, joint):
            yield from _actions(name, [fit for *_, fit in fits])
            yield from _effort(name, [terms for _, _, terms, *_ in fits])
        if not fits:
            continue
        spread = float(np.median([fit.spread for *_, fit in fits]))
        found = []
        for record, log, terms, free, fit in fits:
            largest = 2 * float(np.abs(terms[1]).max())
            stretches = _pushed(fit.residual, largest, spread, free=free)
            found += [_push(record, log, name, rows=rows) for rows in stretches]
        if len({f.file for f in found}) <= max(1, len(records) // 4):
            yield from found


def _without(moved: Sequence[Dynamics], found: Sequence[Finding]) -> list[Dynamics]:
    named = {finding.file for finding in found}
    return [one for one in moved if one.record.name not in named]


def _pushed(
    residual: Array, largest: float, spread: float, *, free: NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """Return stretches of forces beyond ``largest``, far out of the rest."""
    beyond, odd = np.zeros(len(free), dtype=bool), np.zeros(len(free), dtype=bool)
    beyond[free] = np.abs(residual) > largest + 4 * spread
    odd[free] = np.abs(residual) > 3 * spread
    if beyond.mean() > 0.15:  # not an event: the model is another
        return []
    return [(a, b) for a, b in runs(odd) if beyond[a : b + 1].any()]


def _push(record: Record, log: Log, joint: str, *, rows: tuple[int, int]) -> Finding:
    begin, end = (float(log.time[row]) for row in rows)
    first, last = (int(np.nanargmin(np.abs(record.time - time))) for time in (begin, end))
    text = (
        f"between {begin:.2f} and {end:.2f} s {joint} is pushed by more than twice the largest "
        "force of its actuators: an impact, a hand, or lost samples"
    )
    return Finding(
        kind="push",
        file=record.name,
        rows=(first, last),
        message=text,
        severity="error",
    )


def _actions(joint: str, fits: Sequence[Fit]) -> Iterator[Finding]:
    """Combine what all logs say of the actions at a joint."""
    if not fits:
        return
    slopes = np.array([fit.slope for fit in fits])
    weight = np.array([fit.error for fit in fits]) ** -2.0
    slope = float(np.average(slopes, weights=weight))
    spread = np.sqrt(np.average((slopes - slope) ** 2, weights=weight))
    error = max(float(weight.sum() ** -0.5), float(spread))
    if slope < -0.2 and slope < -5 * error:
        text = f"the actions push {joint} against the way that it accelerates: opposite sign?"
        yield Finding(kind="action_sign", file="", rows=(0, 0), message=text, severity="error")
    elif slope + 5 * error < 0.03 or slope - 5 * error > 10:
        text = f"the actions at {joint} act {slope:.2g} times as much as in the model: units?"
        yield Finding(kind="action_scale", file="", rows=(0, 0), message=text)


def _effort(joint: str, fits: Sequence[Terms]) -> Iterator[Finding]:
    """Find motion that takes far more force than there is, friction and parameters aside."""
    ratios = []
    for needed, actuated, bias, _ in fits:
        most = np.abs(actuated).max() + np.abs(bias).max()
        ratios.append(np.median(np.abs(needed - bias)) / (most + 1e-12))
    if ratios and (times := float(np.median(ratios))) > _EFFORT:
        text = f"{joint} moves as with {times:.2g} times the force of its actuators: units?"
        yield Finding(kind="effort", file="", rows=(0, 0), message=text)


def _servos(model: mujoco.MjModel, joint: int) -> list[int]:
    return [i for i in range(model.nu) if is_servo(model, i, joint)]


def _check_commands(moved: Sequence[Dynamics], model: mujoco.MjModel) -> Iterator[Finding]:
    """Find servos whose joint does not follow what is asked of it."""
    usable = [(one.record, one.log) for one in moved]
    for joint, _ in actuated_joints(model):
        name = joint_names(model)[joint]
        for actuator in _servos(model, joint)[:1]:
            yield from _commands(name, joint, actuator, usable=usable, model=model)


def _commands(
    joint: str,
    number: int,
    actuator: int,
    *,
    usable: Sequence[tuple[Record, Log]],
    model: mujoco.MjModel,
) -> Iterator[Finding]:
    """Find commands of positions that the joint follows in another direction or unit."""
    scale = model.actuator_gear[actuator, 0]
    for record, log in usable:
        position = log.qpos[:, model.jnt_qposadr[number]].numpy()
        command = log.ctrl[:, actuator].numpy() / scale
        if min(position.std(), command.std()) == 0:
            continue
        correlation = np.corrcoef(position, command)[0, 1]
        ratio = command.std() / position.std()
        degrees = abs(abs(np.log(ratio)) - np.log(np.rad2deg(1.0))) < 0.3
        place = {"file": record.name, "rows": (0, len(record) - 1), "severity": "error"}
        if correlation < -0.9:
            text = f"{joint} moves against its commands: opposite sign?"
            if _beyond_resonance(log, number, actuator, model):
                place["severity"] = "warning"
                text = f"{joint} moves against its commands: too fast for it, or of opposite sign?"
            yield Finding(kind="action_sign", message=text, **place)
        elif correlation > 0.9 and degrees and ratio > 1:
            text = f"commands of {joint} are {ratio:.3g} times its motion: in degrees?"
            yield Finding(kind="action_scale", message=text, **place)
        elif correlation > 0.9 and degrees:
            text = f"{joint} moves {1 / ratio:.3g} times as far as its commands: in degrees?"
            yield Finding(kind="motion_scale", message=text, **place)


def _beyond_resonance(log: Log, joint: int, actuator: int, model: mujoco.MjModel) -> bool:
    """Return whether commands change so fast that an undamped servo answers against them.

    ``ω = rms(du/dt) / sd(u)``, against half of ``√(k / M)`` to leave room for other masses.
    """
    command, dof = log.ctrl[:, actuator].numpy(), int(model.jnt_dofadr[joint])
    rate = np.sqrt(np.mean(np.gradient(command, log.time.numpy()) ** 2)) / command.std()
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = log.qpos[0].numpy()
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    stiffness = -model.actuator_biasprm[actuator, 1] * model.actuator_gear[actuator, 0] ** 2
    return bool(rate > 0.5 * np.sqrt(max(float(stiffness), 0.0) / inertia[dof, dof]))
