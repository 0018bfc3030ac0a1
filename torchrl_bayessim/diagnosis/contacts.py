"""Where the robot touches something: how deep it is there, a simulator knows better than a sensor.

What a body rests on it neither enters nor leaves, while its measured height does both, by as much
as the sensor is noisy. From there a simulation falls, or is thrown: one-sided, so that the noise of
the start errs in one direction, and whatever averages it seems to be what the simulator lacks.

So a filter goes along every log with the simulator (see `smoother`), pushed by unknown forces, the
stronger the less the simulator is right. Of what it says only the depth of contacts and its rate
are taken, all else is what was measured. With ``d`` from the measured to the filtered state, ``J``
the contacts' normals in joint space and ``R`` the covariance of the noise, the start is moved by
the likeliest step that has the depth::

    Π d,    Π = R Jᵀ (J R Jᵀ)⁺ J,

for velocities likewise. What noise ``e`` and the filter's covariance ``P`` leave of errors there is
``(I - Π) e``, and ``Π P Πᵀ``.

A simulator that is far off, or so chaotic that its parameters are, makes a filter worse than a
sensor: it is believed where most segments are likelier with its starts.
"""

from __future__ import annotations

__all__ = ["likelier", "one_sided", "resting", "settled", "touches"]

import copy
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..logs.log import Log
from ..logs.touching import Touching
from .prediction import Predictor
from .segments import Segments, cut_for_fits, of_velocities
from .smoother import Beliefs, filtered, likeliest_share, unknown_forces
from .whitening import start_deviations, whitening

Array = NDArray[np.float64]
_NEAR = 2.0  # standard deviations of the depth within which a body touches
_STEPS, _FEW, _MANY = 10, 12, 60  # of a segment; segments on which noise is tried, and starts
_BENT = 1.0  # ratio of second to first differences
_TRIAL = 80  # rows that say how strong unknown forces are


def one_sided(predictor: Predictor, logs: Sequence[Log], *, theta: Array, noise: Array) -> bool:
    """Return whether contacts make of the noise of starts what no linear view of it holds for.

    Arguments are those of `settled`.
    """
    if not predictor.colliding:
        return False
    return whitening(predictor, _pieces(logs, _FEW), theta, noise).curvature > _BENT


def touches(predictor: Predictor, qpos: Array) -> bool:
    """Return whether anything touches anything in one of the positions ``(*, nq)``."""
    if not predictor.colliding:
        return False
    model = predictor.system.task.model
    data = mujoco.MjData(model)
    for one in qpos.reshape(-1, model.nq):
        _meet(model, data, one)
        if data.ncon:
            return True
    return False


def _meet(model: mujoco.MjModel, data: mujoco.MjData, qpos: Array) -> None:
    """Put the robot into a position, and find what touches there."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)


def likelier(
    predictor: Predictor,
    logs: Sequence[Log],
    starts: Sequence[Log],
    *,
    theta: Array,
    noise: Array,
) -> bool:
    """Return whether more than half of all segments are likelier with other starts.

    Args:
        predictor: Simulates.
        logs: The logs.
        starts: The same with the steps to states that contacts allow.
        theta: Parameters, shape ``(D,)``.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
    """
    found = []
    for some in (logs, starts):
        pieces = _pieces(some, _MANY)
        white = whitening(predictor, pieces, theta, noise)
        found.append(white.log_likelihood(predictor.residuals(pieces, theta[None]))[0])
    return float(np.mean(found[1] > found[0])) > 0.5


def resting(predictor: Predictor, logs: Sequence[Log], *, noise: Array) -> NDArray[np.bool_]:
    """Return of which coordinates of the state contacts mostly say most, shape ``(2 nv,)``.

    Half of the variance of their noise, in half of the rows.

    Args:
        predictor: Simulates.
        logs: The logs.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
    """
    nothing = np.zeros(2 * predictor.tangent.size)
    if not predictor.colliding:
        return nothing > 0
    touch = _Touch.of(predictor, logs, noise)
    known = [
        nothing if some is None else np.diag(touch.kept(some))
        for log in logs
        for some in touch.along(log)
    ]
    return np.mean(np.stack(known) > 0.5, axis=0) > 0.5


def _pieces(logs: Sequence[Log], most: int) -> Segments:
    steps = min(_STEPS, max(len(log) for log in logs) - 1)
    return cut_for_fits(logs, steps, history=steps, most=most)


def settled(predictor: Predictor, logs: Sequence[Log], *, theta: Array, noise: Array) -> list[Log]:
    """Return the logs with the steps to states that contacts allow.

    Args:
        predictor: Simulates.
        logs: The logs.
        theta: Parameters, shape ``(D,)``.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
    """
    if not predictor.colliding or any(log.uncertainty is not None for log in logs):
        return list(logs)
    touch = _Touch.of(predictor, logs, noise)
    normals = [touch.along(log) for log in logs]
    if not any(some is not None for one in normals for some in one):
        return list(logs)
    first = Beliefs(
        np.stack([log.qpos[0].numpy() for log in logs]),
        np.stack([log.qvel[0].numpy() for log in logs]),
        np.repeat(np.diag(touch.deviations.ravel() ** 2)[None], len(logs), 0),
    )
    share = likeliest_share(predictor, logs, first, theta=theta, noise=noise, rows=_TRIAL)
    forces = np.repeat(share**2 * unknown_forces(predictor)[None], len(logs), 0)
    states = filtered(predictor, logs, first, theta=theta, forces=forces, noise=noise).beliefs
    return [
        _moved(touch, log, states[: len(log)], i, normals=normals[i]) for i, log in enumerate(logs)
    ]


def _moved(
    touch: _Touch, log: Log, states: Sequence[Beliefs], i: int, *, normals: Sequence[Array | None]
) -> Log:
    """Return log ``i`` with the steps to what a filter says of its contacts."""
    size = 2 * touch.tangent.size
    step, free = np.zeros((len(log), size)), np.repeat(np.eye(size)[None], len(log), 0)
    error = np.zeros((len(log), size, size))
    for t, (state, some) in enumerate(zip(states, normals, strict=True)):
        turned = touch.tangent.difference(log.qpos[t].numpy(), state.qpos[i])
        apart = np.r_[turned, state.qvel[i] - log.qvel[t].numpy()]
        if some is not None and np.isfinite(apart).all():
            kept = touch.kept(some)
            step[t], free[t] = kept @ apart, np.eye(size) - kept
            error[t] = kept @ state.covariance[i] @ kept.T
    return replace(log, touching=Touching(step, free, error))


class _Touch:
    """What a robot touches, as measured.

    Args:
        predictor: Knows the model.
        deviations: Standard deviations of measured states, shape ``(2 nv,)``.

    Attributes:
        tangent: The tangent space of its positions.
        deviations: The same, positions and velocities, ``(2, nv)``.
    """

    def __init__(self, predictor: Predictor, deviations: Array) -> None:
        self.tangent, self.deviations = predictor.tangent, deviations.reshape(2, -1)
        self._model = copy.copy(predictor.system.task.model)
        # what is found so far apart; an angle counts as at one metre
        self._model.geom_margin += _NEAR * float(np.linalg.norm(self.deviations[0]))
        self._data = mujoco.MjData(self._model)

    @classmethod
    def of(cls, predictor: Predictor, logs: Sequence[Log], noise: Array) -> _Touch:
        """Return that of measured logs."""
        return cls(predictor, start_deviations(predictor.system, noise, *of_velocities(logs)))

    def along(self, log: Log) -> list[Array | None]:
        """Return the normals of contacts in joint space at every row, ``(c, nv)`` each."""
        return [self._normals(qpos) for qpos in log.qpos.numpy()]

    def _normals(self, qpos: Array) -> Array | None:
        model, data = self._model, self._data
        _meet(model, data, qpos)
        found = []
        for c in range(data.ncon):
            contact = data.contact[c]
            if min(contact.geom1, contact.geom2) >= 0:
                normal = self._normal(contact)
                spread = float(np.linalg.norm(normal * self.deviations[0]))
                if contact.dist < _NEAR * spread:
                    found.append(normal)
        return np.stack(found) if found else None

    def _normal(self, contact: mujoco.MjContact) -> Array:
        model, data = self._model, self._data
        result, moves = np.zeros(model.nv), np.zeros((3, model.nv))
        for geom, sign in ((contact.geom1, -1.0), (contact.geom2, 1.0)):
            mujoco.mj_jac(model, data, moves, None, contact.pos, int(model.geom_bodyid[geom]))
            result += sign * (contact.frame[:3] @ moves)
        return result

    def kept(self, normals: Array) -> Array:
        """Return ``Π`` of positions and velocities, ``(2 nv, 2 nv)``."""
        size = normals.shape[1]
        result = np.zeros((2 * size, 2 * size))
        for half, deviation in enumerate(self.deviations):
            part = slice(half * size, (half + 1) * size)
            scaled = normals * deviation
            inside = np.linalg.pinv(scaled, rcond=1e-6) @ scaled
            inverse = np.where(deviation > 0, 1 / np.maximum(deviation, 1e-300), 0.0)
            result[part, part] = deviation[:, None] * inside * inverse
        return result
