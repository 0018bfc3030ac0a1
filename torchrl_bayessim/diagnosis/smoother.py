r"""What the state was at every row of a log, from what was measured of it: a filter and a smoother.

States follow the simulator with unknown forces of white noise, and the measured coordinates are
seen with noise:

.. math::  x_{t+1} = f(x_t, u_t) + w_t, \qquad y_t = H x_t + v_t.

How strong the forces are, innovations :math:`e` with covariance :math:`S` say by Student's density
:math:`-\frac{1}{2} \log |S| - \frac{\nu + n}{2} \log(1 + e^\top S^{-1} e / \nu)`: a contact that
comes unexpectedly is no strong force in all other rows.

The divided-difference filter (Nørgaard, Poulsen & Ravn 2000) carries mean and covariance
:math:`P = S S^\top` forward; in place of derivatives it simulates one standard deviation to both
sides of every direction, :math:`d_j = (f(x + s_j) - f(x - s_j)) / 2`, so that
:math:`P_{t+1|t} = \sum_j d_j d_j^\top + Q`. The smoother (Rauch, Tung & Striebel 1965) goes back
with the gain :math:`G_t = (\sum_j s_j d_j^\top) P_{t+1|t}^{-1}`. Many logs, under many
hypotheses, are one batch.
"""

from __future__ import annotations

__all__ = ["Beliefs", "Filtered", "filtered", "likeliest_share", "smoothed", "unknown_forces"]

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..logs.log import Log
from .prediction import Predictor
from .records import Record

Array = NDArray[np.float64]
_SHARES = (1e-3, 3e-3, 1e-2, 3e-2, 1e-1)  # of the largest force of a joint, in one second
_TINY = 1e-10  # of the variance: keeps covariances positive definite
_LOST = 1e6  # squared innovation, in units of its variance, of a simulation that diverged
_FREEDOM = 4.0  # of Student's density


@dataclass(frozen=True, eq=False)
class Beliefs:
    """Mean and covariance of ``N`` states.

    Attributes:
        qpos: Positions, shape ``(N, nq)``.
        qvel: Velocities, shape ``(N, nv)``.
        covariance: In the tangent space, shape ``(N, 2 nv, 2 nv)``; zero where nothing is asked.
    """

    qpos: Array
    qvel: Array
    covariance: Array

    @classmethod
    def joined(cls, parts: Sequence[Beliefs]) -> Beliefs:
        """Return several side by side."""
        names = "qpos", "qvel", "covariance"
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class Filtered:
    """What a filter says of every row, and what the smoother goes back with.

    Attributes:
        likelihood: Log density of each log's measurements, less a constant, shape ``(N,)``.
        beliefs: After each row's measurement, length ``T``.
        predicted: Before it, by row; of the first row what was given.
        gains: Of the smoother, from each row to the one before.
        surprises: Squared innovation of each row in units of its variance, 1 on average, ``(N,)``.
    """

    likelihood: Array
    beliefs: list[Beliefs] = field(default_factory=list)
    predicted: list[Beliefs] = field(default_factory=list)
    gains: list[Array] = field(default_factory=list)
    surprises: list[Array] = field(default_factory=list)


def filtered(
    predictor: Predictor,
    logs: Sequence[Log],
    first: Beliefs,
    *,
    theta: Array,
    forces: Array,
    noise: Array,
    rows: int | None = None,
    keep: bool = True,
) -> Filtered:
    """Run the filter along logs.

    Args:
        predictor: Simulates.
        logs: One per belief.
        first: Before the first measurement; coordinates without variance keep their values.
        theta: Parameters, shape ``(D,)``.
        forces: Covariance of what unknown forces add within a control step, ``(N, 2 nv, 2 nv)``.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
        rows: At most so many.
        keep: Whether to keep what the smoother needs, and not only the likelihood.
    """
    length = min(rows or 10**9, max(len(log) for log in logs))
    asked = np.diagonal(first.covariance, axis1=1, axis2=2) > 0
    forces = forces * (asked[:, :, None] & asked[:, None, :])
    dynamics = _Dynamics(predictor, Record(logs, length), theta, forces, noise)
    result = Filtered(np.zeros(len(logs)))
    belief = first
    for t in range(length):
        if keep:
            result.predicted.append(belief)
        belief, density, surprise = dynamics.measured(belief, t)
        result.likelihood[:] += np.where(dynamics.record.alive[:, t], density, 0.0)
        if keep:
            result.beliefs.append(belief)
            result.surprises.append(surprise)
        if t + 1 < length:
            belief, gain = dynamics.moved(belief, t)
            if keep:
                result.gains.append(gain)
    return result


def smoothed(predictor: Predictor, run: Filtered, lengths: Sequence[int]) -> list[Beliefs]:
    """Return what is believed of every row after all measurements of its log, length ``T``.

    Args:
        predictor: Knows the tangent space.
        run: Of the filter.
        lengths: Of the logs.
    """
    last = np.array(lengths) - 1
    later = run.beliefs[-1]
    result = [later]
    for t in range(len(run.beliefs) - 2, -1, -1):
        now, expected, gain = run.beliefs[t], run.predicted[t + 1], run.gains[t]
        known = (t < last)[:, None] * 1.0
        step = known * np.einsum("nij,nj->ni", gain, _apart(predictor, expected, later))
        excess = later.covariance - expected.covariance
        covariance = now.covariance + known[..., None] * (gain @ excess @ gain.swapaxes(1, 2))
        later = _displaced(predictor, now, step, _symmetric(covariance))
        result.append(later)
    return result[::-1]


def likeliest_share(
    predictor: Predictor,
    logs: Sequence[Log],
    first: Beliefs,
    *,
    theta: Array,
    noise: Array,
    rows: int,
) -> float:
    """Return which share of `unknown_forces` makes the measurements likeliest.

    Args:
        predictor: Simulates.
        logs: One per belief.
        first: Before the first measurement.
        theta: Parameters, shape ``(D,)``.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
        rows: At most so many of each log.
    """
    count = len(_SHARES)
    shares = np.repeat(_SHARES, len(logs))[:, None, None]
    found = filtered(
        predictor,
        list(logs) * count,
        Beliefs.joined([first] * count),
        theta=theta,
        forces=shares**2 * unknown_forces(predictor),
        noise=noise,
        rows=rows,
        keep=False,
    )
    return _SHARES[int(found.likelihood.reshape(count, -1).sum(1).argmax())]


def unknown_forces(predictor: Predictor) -> Array:
    """Return what white forces of unit strength add to the state, ``(2 nv, 2 nv)``.

    Unit strength changes a joint's momentum in one second by what its largest force would.
    """
    model, robot = predictor.system.task.model, predictor.system.robot
    data = mujoco.MjData(model)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    force = np.sqrt(np.diag(inertia)) * 4.0
    force[list(robot.dof_index)] = robot.force_scale.numpy()
    pushed = np.linalg.solve(inertia, np.diag(force))
    white = pushed @ pushed.T
    dt = predictor.system.control_dt
    return np.block([[dt**3 / 3 * white, dt**2 / 2 * white], [dt**2 / 2 * white, dt * white]])


@dataclass(frozen=True, eq=False)
class _Dynamics:
    """How states follow one another, and what is seen of them."""

    predictor: Predictor
    record: Record
    theta: Array
    forces: Array
    noise: Array

    def measured(self, belief: Beliefs, t: int) -> tuple[Beliefs, Array, Array]:
        """Return the belief after row ``t``, the row's log density, and how surprising it was."""
        record, channels = self.record, self.predictor.sensing.channels
        position = self.predictor.tangent.difference(belief.qpos, record.qpos[:, t])
        both = np.concatenate([position, record.qvel[:, t] - belief.qvel], -1)
        innovation = np.nan_to_num(both[:, channels])
        seen = belief.covariance[:, channels]
        spread = seen[:, :, channels] + np.diag(self.noise**2)
        inverse = np.linalg.inv(spread)
        gain = seen.swapaxes(1, 2) @ inverse
        step = np.einsum("nij,nj->ni", gain, innovation)
        distance = np.einsum("ni,nij,nj->n", innovation, inverse, innovation)
        squares, size = np.minimum(distance, _LOST), innovation.shape[1]
        density = -0.5 * (_FREEDOM + size) * np.log1p(squares / _FREEDOM)
        density -= 0.5 * np.linalg.slogdet(spread)[1]
        # Joseph's form: unlike P - K H P it cannot lose its sign where sensors are very good
        kept = np.eye(seen.shape[2]) - gain @ np.eye(seen.shape[2])[channels]
        noise = (gain * self.noise**2) @ gain.swapaxes(1, 2)
        covariance = _symmetric(kept @ belief.covariance @ kept.swapaxes(1, 2) + noise)
        return _displaced(self.predictor, belief, step, covariance), density, squares / size

    def moved(self, belief: Beliefs, t: int) -> tuple[Beliefs, Array]:
        """Return the belief one control step later, and the smoother's gain."""
        asked = np.flatnonzero(belief.covariance.any((0, 2)))
        every = np.arange(len(belief.qpos))
        part = np.ix_(every, asked, asked)
        root = np.zeros((*belief.covariance.shape[:2], len(asked)))
        root[:, asked] = np.linalg.cholesky(_positive(belief.covariance[part]))
        middle, change = self._stepped(belief, root, t)
        fixed = np.ones(2 * self.predictor.tangent.size, dtype=bool)
        fixed[asked] = False
        change[:, fixed] = 0.0
        covariance = _symmetric(change @ change.swapaxes(1, 2) + self.forces)
        gain = np.zeros_like(covariance)
        inverse = np.linalg.inv(_positive(covariance[part]))
        gain[part] = root[:, asked] @ change[:, asked].swapaxes(1, 2) @ inverse
        back = np.where(fixed, _apart(self.predictor, middle, belief), 0.0)
        return _displaced(self.predictor, middle, back, covariance), gain

    def _stepped(self, belief: Beliefs, root: Array, t: int) -> tuple[Beliefs, Array]:
        """Return the mean one control step later, and what a step along each column becomes."""
        columns = np.moveaxis(root, -1, 0)
        offsets = np.concatenate([np.zeros_like(columns[:1]), columns, -columns])
        thetas = np.repeat(self.theta[None], len(offsets), 0)
        states = self.predictor.states(
            self.record.step(belief.qpos, belief.qvel, t), thetas, None, offsets
        )
        qpos, qvel = (part[:, :, 0] for part in states)
        fine = np.isfinite(np.concatenate([qpos, qvel], -1)).all((0, 2)).reshape(-1, 1)
        qpos, qvel = np.where(fine, qpos, belief.qpos), np.where(fine, qvel, belief.qvel)
        turned = self.predictor.tangent.difference(qpos[:1], qpos)
        away = np.concatenate([turned, qvel - qvel[:1]], -1)[1:]
        change = (away[: len(columns)] - away[len(columns) :]) / 2
        return Beliefs(qpos[0], qvel[0], belief.covariance), np.moveaxis(change, 0, -1)


def _apart(predictor: Predictor, a: Beliefs, b: Beliefs) -> Array:
    return np.concatenate([predictor.tangent.difference(a.qpos, b.qpos), b.qvel - a.qvel], -1)


def _displaced(predictor: Predictor, belief: Beliefs, step: Array, covariance: Array) -> Beliefs:
    half = predictor.tangent.size
    qpos = predictor.tangent.displace(belief.qpos, step[:, :half])
    return Beliefs(qpos, belief.qvel + step[:, half:], covariance)


def _symmetric(matrices: Array) -> Array:
    return (matrices + matrices.swapaxes(1, 2)) / 2


def _positive(matrices: Array) -> Array:
    """Return the same with variances a little larger, so that roots exist."""
    variances = np.einsum("nii->ni", matrices)
    return matrices + _TINY * np.einsum("ni,ij->nij", variances, np.eye(matrices.shape[1]))
