"""The force that the nominal simulator misses from one row to the next, and what may explain it.

With ``a = (v' - v) / dt`` between two rows, inverse dynamics at the middle of the step say which
generalised force must have acted; what the command does not account for is the residual::

    τ = M(q) a + c(q, v) - B u

A cause is a column ``∂τ/∂s``, by formula or by a small change of the model. Columns have the
nominal simulator's accelerations: measured ones would have the noise on both sides.
"""

from __future__ import annotations

__all__ = ["Forces", "columns", "forces"]

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from withheld.robots import entry_value, write_entry

from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

from .whole_runs import Array

_SMALL = 1e-3  # of what a model's entry is changed by
_SOFT = 0.02  # rad/s or m/s


@dataclass(frozen=True, eq=False)
class Forces:
    """Rows of all runs, one per step, ``T`` in all; ``J`` joints.

    Attributes:
        q: Positions in the middle of the step, ``(T, nq)``.
        v: Velocities, ``(T, J)``.
        a: Accelerations of the nominal simulator, ``(T, J)``.
        u: Generalised forces of the actuators, ``(T, J)``.
        before: Those of the step before, and of the mean of three before, ``(2, T, J)``.
        time: Seconds, ``(T,)``.
        missing: Residual, ``(T, J)``.
    """

    q: Array
    v: Array
    a: Array
    u: Array
    before: Array
    time: Array
    missing: Array


def forces(system: System, logs: Sequence[Log]) -> Forces:
    """Return the steps of some runs."""
    model = system.task.model
    parts = [_of_run(model, log, system.control_dt) for log in logs]
    q, v, a, u, late, slow, time, missing = map(np.concatenate, zip(*parts, strict=True))
    return Forces(q, v, a, u, np.stack([late, slow]), time, missing)


def _of_run(model: mujoco.MjModel, log: Log, dt: float) -> tuple[Array, ...]:
    q, v, command = log.qpos.numpy(), log.qvel.numpy(), log.ctrl.numpy()
    k = np.arange(3, len(log) - 1)
    middle = (q[k] + q[k + 1]) / 2, (v[k] + v[k + 1]) / 2
    a, force = _driven(model, *middle, command[k])
    late = _driven(model, *middle, command[k - 1])[1]
    slow = _driven(model, *middle, (command[k - 1] + command[k - 2] + command[k - 3]) / 3)[1]
    missing = _needed(model, *middle, (v[k + 1] - v[k]) / dt) - force
    return *middle, a, force, late, slow, log.time.numpy()[k], missing


def _driven(model: mujoco.MjModel, q: Array, v: Array, command: Array) -> tuple[Array, Array]:
    """Return accelerations and the actuators' forces, ``(T, J)`` each."""
    data, rows = mujoco.MjData(model), []
    for state in zip(q, v, command, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = state
        mujoco.mj_forward(model, data)
        rows.append((data.qacc.copy(), data.qfrc_actuator.copy()))
    a, force = zip(*rows, strict=True)
    return np.array(a), np.array(force)


def _needed(model: mujoco.MjModel, q: Array, v: Array, a: Array) -> Array:
    """Return the forces of inverse dynamics, ``(T, J)``."""
    data, rows = mujoco.MjData(model), []
    for state in zip(q, v, a, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = state
        mujoco.mj_inverse(model, data)
        rows.append(data.qfrc_inverse.copy())
    return np.array(rows)


def columns(system: System, steps: Forces) -> dict[tuple[str, int], Array]:
    """Return columns ``(T, J)`` by cause and degree of freedom, -1 for parameters and tilts.

    Parameters go by the names of their entries. Dead time of sensors, noise and what depends on an
    unknown frequency is no column of forces.
    """
    model, found = system.task.model, {}
    names = () if system.prior is None else system.prior.names
    base = _needed(model, steps.q, steps.v, steps.a)

    def slope(change: Callable[[mujoco.MjModel], None]) -> Array:
        """Return what a small change of the robot's model adds to the residual."""
        other = copy.copy(model)
        change(other)
        mujoco.mj_setConst(other, mujoco.MjData(other))
        return (base - _needed(other, steps.q, steps.v, steps.a)) / _SMALL

    for name in names:
        value = entry_value(model, name)
        found[name, -1] = slope(lambda m, n=name, x=value: write_entry(m, n, x + _SMALL))
    found["gravity_tilt", -1] = slope(_tilted)
    for j in range(model.nv):
        body = int(model.jnt_bodyid[model.dof_jntid[j]])
        found["com_shift", j] = slope(lambda m, b=body: _moved(m, b))
        found["payload", j] = slope(lambda m, b=body: _heavier(m, b))
        moved = steps.q.copy()
        moved[:, model.jnt_qposadr[model.dof_jntid[j]]] += _SMALL
        bent = (_needed(model, moved, steps.v, steps.a) - base) / _SMALL
        found["sensor_bias", j] = -bent
        for name, values in _laws(steps, j).items():
            found[name, j] = np.outer(values, np.eye(model.nv)[j])
    return {place: column for place, column in found.items() if np.any(column)}


def _tilted(model: mujoco.MjModel) -> None:
    model.opt.gravity[0] += _SMALL * 9.81


def _moved(model: mujoco.MjModel, body: int) -> None:
    model.body_ipos[body, 0] += _SMALL


def _heavier(model: mujoco.MjModel, body: int) -> None:
    model.body_inertia[body] *= 1 + _SMALL
    model.body_mass[body] *= 1 + _SMALL


def _laws(steps: Forces, j: int) -> dict[str, Array]:
    """Return the laws of one joint, up to sign and strength, ``(T,)`` each."""
    v, u, top = steps.v[:, j], steps.u[:, j], np.abs(steps.u[:, j]).max() + 1e-12
    dry = np.tanh(v / _SOFT)
    laws = {
        "coulomb_friction": dry,
        "stribeck_friction": np.exp(-((v / 0.25) ** 2)) * dry,
        "viscous_friction": v,
        "quadratic_drag": v * np.abs(v),
        "load_dependent_friction": np.abs(u) * dry,
        "directional_friction": np.maximum(dry, 0.0),
        "parallel_spring": steps.q[:, j],
        "constant_force": np.ones_like(v),
        "armature": steps.a[:, j],
    }
    driven = {
        "action_gain": u,
        "saturation": np.sign(u) * np.maximum(np.abs(u) - 0.5 * top, 0.0),
        "dead_band": np.tanh(u / (0.05 * top)),
        "torque_speed_limit": np.maximum(u * v, 0.0) * np.sign(v),
        "battery_sag": u * steps.time,
        "action_delay": u - steps.before[0, :, j],
        "action_lag": u - steps.before[1, :, j],
    }
    return laws | (driven if top > 1e-9 else {})
