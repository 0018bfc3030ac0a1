r"""Do logged actions push the way that joints accelerate, and does nothing else push?

Over windows of a tenth of a second, the generalised force that the motion takes,
:math:`y = M(q)\,\ddot q + c(q, \dot q)`, is compared with what actuators exert in the model,
:math:`\tau`, by robust regression at each actuated joint,

.. math:: y = \gamma\,\tau + \beta\,c + f\,\operatorname{sgn}\dot q + b\,\dot q + o .

The terms besides :math:`\tau` take up what parameters and friction may differ by, so that
:math:`\gamma` far from 1 means an action of another sign or unit, and only a force that no actuator
could exert stands out of the rest. Rows near contacts or limits say nothing and are left out; where
the regression is uncertain, nothing is found.
"""

from __future__ import annotations

__all__ = ["check_forces"]

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from .columns import joint_names
from .finding import Finding, runs
from .log import Log
from .record import Record
from .system import System

Array = NDArray[np.float64]
Terms = tuple[Array, ...]
_WINDOW = 0.1  # s
_EFFORT = 5  # times the largest force there is, in half of the rows
_CONTACT = 3  # windows from a contact or limit within which nothing is said


class Fit(NamedTuple):
    """What is left of the force, its robust scale, and the factor of the actuators with its sd."""

    residual: Array
    spread: float
    slope: float
    error: float


def check_forces(
    records: Sequence[Record], logs: Sequence[Sequence[Log]], system: System
) -> Iterator[Finding]:
    """Yield what is wrong with the actions, given each record's logs."""
    model = system.task.model
    if model.nu == 0 or model.na > 0 or system.task.drive.relative:
        return
    half = max(2, round(_WINDOW / system.control_dt / 2))
    usable = [
        (record, log)
        for record, parts in zip(records, logs, strict=True)
        for log in parts
        if len(log) >= 8 * half and bool(log.measured[: model.nv].all())
    ]
    moved = [(record, log, *_forces(model, log, half)) for record, log in usable]
    for joint, dof in _actuated(model):
        name = joint_names(model)[joint]
        fits = [
            (record, log, terms, free, fit)
            for record, log, forces, free in moved
            if (fit := _fit(terms := tuple(f[free, dof] for f in forces), half=half))
        ]
        servos = [i for i in range(model.nu) if _is_servo(model, i, joint)]
        if servos:
            yield from _commands(name, joint, servos[0], usable=usable, model=model)
        else:
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


def _actuated(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Return the scalar joints that an actuator moves, with their degrees of freedom."""
    joints = set()
    for i in range(model.nu):
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT:
            joints.add(int(model.actuator_trnid[i, 0]))
    scalar = int(mujoco.mjtJoint.mjJNT_SLIDE)
    return [(j, int(model.jnt_dofadr[j])) for j in sorted(joints) if model.jnt_type[j] >= scalar]


def _forces(
    model: mujoco.MjModel, log: Log, half: int
) -> tuple[tuple[Array, ...], NDArray[np.bool_]]:
    """Return the forces needed, exerted and of bias, velocities; and which rows are free."""
    qpos, qvel, ctrl = log.qpos.numpy(), log.qvel.numpy(), log.ctrl.numpy()
    dt = float(log.time[1] - log.time[0])
    offset = dt * np.arange(-half, half + 1)
    slope = correlate1d(qvel, offset / (offset**2).sum(), axis=0)
    data = mujoco.MjData(model)
    needed, actuated, bias = (np.zeros((len(log), model.nv)) for _ in range(3))
    free = np.ones(len(log), dtype=bool)
    barred = {int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)}
    for t in range(len(log)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[t], qvel[t], ctrl[t]
        mujoco.mj_forward(model, data)
        actuated[t], bias[t] = data.qfrc_actuator, data.qfrc_bias
        free[t] = data.ncon == 0 and not barred & set(data.efc_type.tolist())
        mujoco.mj_mulM(model, data, needed[t], slope[t])
        needed[t] += data.qfrc_bias
    window = np.ones(2 * half + 1) / (2 * half + 1)
    # an action holds until the next row, so what acts around a row began half a step before
    actuated = correlate1d((actuated + np.roll(actuated, 1, axis=0)) / 2, window, axis=0)
    spread = np.ones(2 * _CONTACT * half + 1)
    free = np.convolve(~free, spread, mode="same") < 0.5
    free[: 2 * half] = free[len(free) - 2 * half :] = False
    bias, speed = correlate1d(bias, window, axis=0), correlate1d(qvel, window, axis=0)
    return (needed, actuated, bias, speed), free


def _fit(terms: Terms, *, half: int) -> Fit | None:
    """Fit rows that move by Huber's weights, drawn to the model by a prior of half of each term."""
    needed, actuated, bias, speed = terms
    if len(needed) < 20 * half:
        return None
    slow = 0.1 * np.sqrt(np.mean(speed**2)) + 1e-9
    moving = np.abs(speed) > slow  # friction may hold a joint at rest against its actuators
    if moving.sum() < 20 * half or actuated[moving].std() == 0:
        return None
    columns = np.stack([actuated, bias, np.tanh(speed / slow), speed, np.ones(len(speed))], 1)
    largest = np.abs(actuated).max()
    prior = 0.5 * np.array([1.0, 1.0, largest, largest / (np.abs(speed).max() + 1e-9), largest])
    target = needed - actuated - bias
    weight, spread = moving.astype(float), float(needed.std()) + 1e-12
    residual = target
    for _ in range(20):
        solution, _ = _solve(columns, target, weight / (spread**2 * (2 * half + 1)), prior)
        residual = target - columns @ solution
        spread = float(1.4826 * np.median(np.abs(residual[moving]))) + 1e-12
        weight = moving * np.minimum(1.0, 1.5 * spread / np.maximum(np.abs(residual), 1e-12))
    prior[0] = 1e6  # what the data alone say of the actions
    solution, error = _solve(columns, target, weight / (spread**2 * (2 * half + 1)), prior)
    return Fit(residual, spread, 1 + float(solution[0]), float(error[0]))


def _solve(columns: Array, target: Array, weight: Array, prior: Array) -> tuple[Array, Array]:
    """Return the coefficients of least squares around 0, and their standard deviations.

    Residuals of overlapping windows are alike, so a window's rows count as one.
    """
    inverse = np.linalg.inv((columns.T * weight) @ columns + np.diag(prior**-2))
    return inverse @ (columns.T @ (weight * target)), np.sqrt(np.diag(inverse))


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


def _is_servo(model: mujoco.MjModel, actuator: int, joint: int) -> bool:
    moves = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
    return bool(
        moves
        and model.actuator_trnid[actuator, 0] == joint
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_biasprm[actuator, 1] < 0
    )


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
        place = {"file": record.name, "rows": (0, len(record) - 1), "severity": "error"}
        if correlation < -0.9:
            text = f"{joint} moves against its commands: opposite sign?"
            yield Finding(kind="action_sign", message=text, **place)
        elif correlation > 0.9 and abs(np.log(ratio / np.rad2deg(1.0))) < 0.3:
            text = f"commands of {joint} are {ratio:.3g} times its motion: in degrees?"
            yield Finding(kind="action_scale", message=text, **place)
