"""Compiled loops that call MuJoCo's C functions directly, without the interpreter and its lock.

One thread owns one ``mjModel`` and one ``mjData``. Before it steps environment ``i`` it writes the
model entries in which environments differ (``table[i]``, at the thread's ``addresses``) and the
state of environment ``i``; after stepping it reads state and outputs back. All that an environment
owns is thus a row of ``table`` and a row of ``state``. The state includes the solver's warm start
and the mocap bodies, so the numbers are those of a private model and data, bit for bit.

Threads draw environments from a shared counter, so a slow environment delays nobody.

The arguments of the kernels, as `Stepper` builds them:

* ``worker``: ``(thread, blocks, addresses, jacobian)``, what one thread owns: addresses in the
  order of `OWNED`; address and size of each output array; addresses of the columns of ``table``;
  scratch space ``(6, nv)``;
* ``batch``: ``(table, sharing, state, signature)``, one row per environment, but of the table one
  per ``sharing`` environments; ``signature`` says what a state holds, and with a weld it ends in
  the last known pose of the body that follows the mocap body;
* ``drive``: ``(relative, weld, pinned, site_ids, contact_forces)``, see `Drive`;
* ``queue``: one integer, zero at the start, shared by the threads; ``rows``: the environments;
* ``outputs``: where to write what was read;
* ``status``: where to write what became of each environment: 0, or `DIVERGED` (too large a number,
  by MuJoCo's own tests), `OVERFLOW` (contacts or constraints did not fit in the model's memory) or
  `FAILED` (MuJoCo gave a fatal error, see `fatal_errors`).
"""
# ruff: noqa: ANN001, ANN201, ANN202, PLR0917 - numba infers types and takes no keywords

from __future__ import annotations

__all__ = [
    "DIVERGED",
    "FAILED",
    "OVERFLOW",
    "OWNED",
    "advance",
    "assign",
    "begin",
    "override",
    "refresh",
]

import math

import mujoco

from .libmujoco import (
    compiled,
    doubles,
    integers,
    mj_com_pos,
    mj_forward,
    mj_get_state,
    mj_jac_site,
    mj_kinematics,
    mj_reset,
    mj_rne,
    mj_set_const,
    mj_set_state,
    mj_step,
    take,
)

OWNED = ("fault", "model", "data", "warning", "qpos", "qvel", "ctrl")
OWNED += ("mocap_pos", "mocap_quat", "xpos", "xquat", "qacc")
DIVERGED, OVERFLOW, FAILED = 1, 2, 3

_FAULT, _MODEL, _DATA, _WARNING, _QPOS, _QVEL, _CTRL = range(7)
_MOCAP_POS, _MOCAP_QUAT, _XPOS, _XQUAT, _QACC = range(7, 12)
_WARNINGS = int(mujoco.mjtWarning.mjNWARNING)
_LARGEST = mujoco.mjMAXVAL
_STRIDE = 2  # an mjWarningStat is two 32-bit integers: lastinfo, number
_CONTACTS_FULL = int(mujoco.mjtWarning.mjWARN_CONTACTFULL)
_CONSTRAINTS_FULL = int(mujoco.mjtWarning.mjWARN_CNSTRFULL)


@compiled
def _row(array, i):
    return doubles(array.ctypes.data + i * array.shape[1] * 8)


@compiled
def override(addresses, table, i):
    """Write row ``i`` of the table into a model."""
    for j in range(addresses.shape[0]):
        doubles(addresses[j])[0] = table[i, j]


@compiled
def assign(table, rows, theta, places, numbers):
    """Write the entries of ``rows``, a mask, that follow from parameters; see `Assignments`.

    If a value is not finite or too small, nothing is written, and its row and number are returned.
    """
    for write in (False, True):
        for i in range(rows.shape[0]):
            if rows[i]:
                for p in range(places.shape[0]):
                    value = theta[i, places[p, 0]]
                    base, scale, nominal, least = numbers[p]
                    new = nominal if math.isnan(value) else base * (value / scale)
                    if write:
                        table[i, places[p, 1]] = new
                    elif not (least <= new < math.inf) or new == -math.inf:
                        return i, p
    return -1, -1


@compiled
def _hush(thread):
    # MuJoCo prints and logs a warning only while its count is zero
    counts = integers(thread[_WARNING])
    for k in range(_WARNINGS):
        counts[k * _STRIDE] = 1


@compiled
def _trouble(thread):
    """What happened since `_hush`: MuJoCo resets the data, and all counts, where it diverges."""
    counts = integers(thread[_WARNING])
    code = 0
    for k in range(_WARNINGS):
        if counts[k * _STRIDE] != 1:
            if k not in (_CONTACTS_FULL, _CONSTRAINTS_FULL):
                return DIVERGED
            code = OVERFLOW
    return code


@compiled
def _bounded(address, size):
    """Whether all numbers are what MuJoCo takes for sane (``mj_checkVel``, ``mj_checkAcc``)."""
    numbers = doubles(address)
    sane = True
    for j in range(size):
        sane = sane and abs(numbers[j]) <= _LARGEST
    return sane


@compiled
def _collect(thread, blocks, site_ids, jacobian, output):
    """Copy arrays of mjData, then the velocities J(q) q̇ of sites, to ``output``."""
    at = 0
    for b in range(blocks.shape[0]):
        source = doubles(blocks[b, 0])
        for j in range(blocks[b, 1]):
            output[at + j] = source[j]
        at += blocks[b, 1]
    nv = jacobian.shape[1]
    qvel = doubles(thread[_QVEL])
    for s in range(site_ids.shape[0]):
        mj_jac_site(
            thread[_MODEL], thread[_DATA], _row(jacobian, 0), _row(jacobian, 3), site_ids[s]
        )
        for axis in range(6):
            total = 0.0
            for v in range(nv):
                total += jacobian[axis, v] * qvel[v]
            output[at + axis] = total
        at += 6


@compiled
def _command(thread, drive, command, state):
    """Write controls, some relative to a position, and step the mocap body from its weld."""
    relative, weld = drive[0], drive[1]
    qpos, ctrl = doubles(thread[_QPOS]), doubles(thread[_CTRL])
    nu = relative.shape[0]
    for j in range(nu):
        ctrl[j] = command[j] + qpos[relative[j]] if relative[j] >= 0 else command[j]
    if weld >= 0:
        position, quaternion = doubles(thread[_MOCAP_POS]), doubles(thread[_MOCAP_QUAT])
        for j in range(3):
            position[j] = state[j - 7] + command[nu + j]
        for j in range(4):
            quaternion[j] = state[j - 4] + command[nu + 3 + j]


@compiled
def _remember(thread, weld, state):
    """Keep the pose of the welded body, from which the next command steps the mocap body."""
    if weld >= 0:
        position, quaternion = doubles(thread[_XPOS]), doubles(thread[_XQUAT])
        for j in range(3):
            state[j - 7] = position[3 * weld + j]
        for j in range(4):
            state[j - 4] = quaternion[4 * weld + j]


@compiled
def _control_step(thread, drive, substeps):
    _, _, pinned, _, contact_forces = drive
    fault, m, d = thread[_FAULT], thread[_MODEL], thread[_DATA]
    for _ in range(substeps):
        code = FAILED if mj_step(fault, m, d) else _trouble(thread)
        if code:
            return code
    failed = 0
    if pinned.shape[0]:
        qpos = doubles(thread[_QPOS])
        for j in pinned:
            qpos[j] = 0.0
        failed = mj_kinematics(fault, m, d) or mj_com_pos(fault, m, d)
    if contact_forces and not failed:
        failed = mj_rne(fault, m, d)
    return FAILED if failed else 0


@compiled
def begin(worker, batch, drive, queue, rows, outputs, status):
    """Set the states of ``rows`` in clean data, and evaluate the outputs there.

    Outputs that are not finite become 0, and the environment `DIVERGED`.
    """
    thread, blocks, addresses, jacobian = worker
    table, sharing, state, signature = batch
    _, weld, _, site_ids, _ = drive
    m, d = thread[_MODEL], thread[_DATA]
    while True:
        k = take(queue.ctypes.data)
        if k >= rows.shape[0]:
            break
        i = rows[k]
        mj_reset(m, d)
        _hush(thread)
        override(addresses, table, i // sharing)
        mj_set_state(m, d, _row(state, i), signature)
        status[i] = FAILED if mj_forward(thread[_FAULT], m, d) else _trouble(thread)
        if status[i] == FAILED:
            mj_reset(m, d)
            continue
        mj_get_state(m, d, _row(state, i), signature)
        _remember(thread, weld, state[i])
        _collect(thread, blocks, site_ids, jacobian, outputs[i])
        nv = jacobian.shape[1]
        if not (_bounded(thread[_QVEL], nv) and _bounded(thread[_QACC], nv)):
            status[i] = DIVERGED
        for j in range(outputs.shape[1]):
            if not math.isfinite(outputs[i, j]):
                outputs[i, j] = 0.0
                status[i] = DIVERGED


@compiled
def advance(worker, batch, drive, queue, rows, outputs, status, commands, sequence, substeps):
    """Apply ``commands[sequence[i]]``, shape ``(T, C)``, to each ``i`` of ``rows``.

    Writes ``outputs[i]``, shape ``(T, M)``, and the new state. Where there is a ``status`` the
    state stays as it was, and the outputs are NaN from that control step on.
    """
    thread, blocks, addresses, jacobian = worker
    table, sharing, state, signature = batch
    _, weld, _, site_ids, _ = drive
    m, d = thread[_MODEL], thread[_DATA]
    pose = state[:0, 0]
    while True:
        k = take(queue.ctypes.data)
        if k >= rows.shape[0]:
            break
        i = rows[k]
        _hush(thread)
        override(addresses, table, i // sharing)
        mj_set_state(m, d, _row(state, i), signature)
        if weld >= 0:
            pose = state[i, -7:].copy()
        code = 0
        for t in range(commands.shape[1]):
            if code == 0:
                _command(thread, drive, commands[sequence[i], t], state[i])
                code = _control_step(thread, drive, substeps)
            if code:
                outputs[i, t] = math.nan
            else:
                _remember(thread, weld, state[i])
                _collect(thread, blocks, site_ids, jacobian, outputs[i, t])
        status[i] = code
        if code:
            mj_reset(m, d)
            if weld >= 0:
                state[i, -7:] = pose
        else:
            mj_get_state(m, d, _row(state, i), signature)


@compiled
def refresh(owned, rows, table, addresses, derived):
    """Let MuJoCo recompute the constants that depend on the overrides of ``rows``.

    ``owned`` are the addresses of a scratch fault, model and data, ``addresses`` those of the
    table's columns in that model, and ``derived`` the columns that hold the constants. Returns the
    first row for which MuJoCo cannot, or -1.
    """
    for i in rows:
        override(addresses, table, i)
        if mj_set_const(owned[0], owned[1], owned[2]):
            mj_reset(owned[1], owned[2])
            return i
        for j in derived:
            table[i, j] = doubles(addresses[j])[0]
    return -1
