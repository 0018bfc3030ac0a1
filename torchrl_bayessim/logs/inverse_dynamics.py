r"""What force the motion of a log takes, and what its actuators exert in the model.

Over windows of a tenth of a second, the generalised force that the motion takes,
:math:`y = M(q)\,\ddot q + c(q, \dot q)`, is compared with what actuators exert in the model,
:math:`\tau`, by robust regression at each actuated joint,

.. math:: y = \gamma\,\tau + \beta\,c + f\,\operatorname{sgn}\dot q + b\,\dot q + o .

The terms besides :math:`\tau` take up what parameters and friction may differ by. Rows near
contacts or limits say nothing and are left out.
"""

from __future__ import annotations

__all__ = [
    "Dynamics",
    "Fit",
    "Terms",
    "actuated_joints",
    "dynamics",
    "fit_terms",
    "held",
    "is_servo",
    "moves",
    "regressors",
]

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from .log import Log
from .record import Record
from .room import room

Array = NDArray[np.float64]
Terms = tuple[Array, ...]
_CONTACT = 3  # windows from a contact or limit within which nothing is said


class Dynamics(NamedTuple):
    """A log and its forces: needed, exerted, of bias, and velocities, each ``(T, nv)``.

    ``free`` marks the rows away from contacts and limits.
    """

    record: Record
    log: Log
    forces: Terms
    free: NDArray[np.bool_]

    def terms(self, dof: int) -> Terms:
        """Return the forces at a degree of freedom, in the free rows."""
        return tuple(force[self.free, dof] for force in self.forces)


class Fit(NamedTuple):
    """What is left of the force, its robust scale, and the factor of the actuators with its sd.

    ``added`` are the coefficients of `regressors` beyond the model's own terms.
    """

    residual: Array
    spread: float
    slope: float
    error: float
    added: Array


def actuated_joints(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Return the scalar joints that an actuator moves, with their degrees of freedom."""
    joints = set()
    for i in range(model.nu):
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT:
            joints.add(int(model.actuator_trnid[i, 0]))
    scalar = int(mujoco.mjtJoint.mjJNT_SLIDE)
    return [(j, int(model.jnt_dofadr[j])) for j in sorted(joints) if model.jnt_type[j] >= scalar]


def dynamics(model: mujoco.MjModel, record: Record, log: Log, half: int) -> Dynamics:
    """Return the forces of a log, averaged over windows of ``2 half + 1`` rows."""
    qpos, qvel, ctrl = log.qpos.numpy(), log.qvel.numpy(), log.ctrl.numpy()
    dt = float(log.time[1] - log.time[0])
    offset = dt * np.arange(-half, half + 1)
    slope = correlate1d(qvel, offset / (offset**2).sum(), axis=0)
    data = mujoco.MjData(model)
    needed, actuated, bias = (np.zeros((len(log), model.nv)) for _ in range(3))
    free = np.ones(len(log), dtype=bool)
    barred = {int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)}
    q, v, u = data.qpos, data.qvel, data.ctrl  # each access makes an array anew
    driven, biased = data.qfrc_actuator, data.qfrc_bias
    with room("the model"):
        for t in range(len(log)):
            q[:], v[:], u[:] = qpos[t], qvel[t], ctrl[t]
            mujoco.mj_forward(model, data)
            actuated[t], bias[t] = driven, biased
            limits = data.nefc and barred & set(data.efc_type.tolist())
            free[t] = data.ncon == 0 and not limits
            mujoco.mj_mulM(model, data, needed[t], slope[t])
    needed += bias
    actuated = held(actuated, half)
    spread = np.ones(2 * _CONTACT * half + 1)
    free = np.convolve(~free, spread, mode="same") < 0.5
    free[: 2 * half] = free[len(free) - 2 * half :] = False
    bias, speed = (_averaged(each, half) for each in (bias, qvel))
    return Dynamics(record, log, (needed, actuated, bias, speed), free)


def held(actions: Array, half: int) -> Array:
    """Return actions, or their forces, averaged over windows.

    An action holds until the next row, so what acts around a row began half a step before.
    """
    return _averaged((actions + np.roll(actions, 1, axis=0)) / 2, half)


def _averaged(values: Array, half: int) -> Array:
    return correlate1d(values, np.ones(2 * half + 1) / (2 * half + 1), axis=0)


def fit_terms(terms: Terms, *, half: int) -> Fit | None:
    """Fit rows that move by Huber's weights, drawn to the model by a prior of half of each term."""
    needed, actuated, bias, speed = terms
    if len(needed) < 20 * half:
        return None
    moving = moves(speed)
    if moving.sum() < 20 * half or actuated[moving].std() == 0:
        return None
    columns = regressors(terms)
    largest = np.abs(actuated).max()
    prior = 0.5 * np.array([1.0, 1.0, largest, largest / (np.abs(speed).max() + 1e-9), largest])
    target = needed - actuated - bias
    weight, spread = moving.astype(float), float(needed.std()) + 1e-12
    residual, added = target, np.zeros(columns.shape[1])
    for _ in range(20):
        added, _ = _solve(columns, target, weight / (spread**2 * (2 * half + 1)), prior)
        residual = target - columns @ added
        spread = float(1.4826 * np.median(np.abs(residual[moving]))) + 1e-12
        weight = moving * np.minimum(1.0, 1.5 * spread / np.maximum(np.abs(residual), 1e-12))
    prior[0] = 1e6  # what the data alone say of the actions
    solution, error = _solve(columns, target, weight / (spread**2 * (2 * half + 1)), prior)
    return Fit(residual, spread, 1 + float(solution[0]), float(error[0]), added)


def moves(speed: Array) -> NDArray[np.bool_]:
    """Return where a joint moves: at rest, friction may hold it against its actuators."""
    return np.abs(speed) > _slow(speed)


def regressors(terms: Terms) -> Array:
    """Return what is fitted to the force that the model leaves, ``(T, 5)``."""
    _, actuated, bias, speed = terms
    friction = np.tanh(speed / _slow(speed))
    return np.stack([actuated, bias, friction, speed, np.ones(len(speed))], 1)


def _slow(speed: Array) -> float:
    return float(0.1 * np.sqrt(np.mean(speed**2)) + 1e-9)


def _solve(columns: Array, target: Array, weight: Array, prior: Array) -> tuple[Array, Array]:
    """Return the coefficients of least squares around 0, and their standard deviations.

    Residuals of overlapping windows are alike, so a window's rows count as one.
    """
    inverse = np.linalg.inv((columns.T * weight) @ columns + np.diag(prior**-2))
    return inverse @ (columns.T @ (weight * target)), np.sqrt(np.diag(inverse))


def is_servo(model: mujoco.MjModel, actuator: int, joint: int) -> bool:
    """Return whether an actuator holds a joint at the position that it is told."""
    drives = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
    return bool(
        drives
        and model.actuator_trnid[actuator, 0] == joint
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_biasprm[actuator, 1] < 0
    )
