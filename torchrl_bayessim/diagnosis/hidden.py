"""Joints that nobody measured: what they did is estimated from what they did to the others.

A smoother carries the state along every log with the simulator; see `smoother`. Forces that the
simulator does not know push it: how strong they are is chosen by the likelihood of the
measurements, so that a simulator that lacks something is trusted less, and the estimates with it.
Where a log begins nothing is known of a hidden joint: several hypotheses over its range are
followed for a while, and the likeliest is kept.
"""

from __future__ import annotations

__all__ = ["Hidden", "hidden_joints"]

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import qmc

from ..errors import message
from ..logs.log import Log
from .prediction import Predictor
from .segments import Segments
from .smoother import Beliefs, Filtered, filtered, likeliest_share, smoothed, unknown_forces

Array = NDArray[np.float64]
_POSITION, _VELOCITY = 0.1, 0.5  # rad or m, and per second: a guess that is good
_MATTERS = 1.0  # mean squared change of what is measured, in units of its noise
_WIDEST = {int(mujoco.mjtJoint.mjJNT_HINGE): np.pi, int(mujoco.mjtJoint.mjJNT_SLIDE): 1.0}
_HYPOTHESES = 8  # of where the hidden joints were
_CLOSE = 0.4  # of the range of hypotheses: how far from the truth the nearest may be
_TRIAL = 80  # rows after which the likeliest hypothesis is kept
_CURVED = 0.5  # ratio of second to first differences
_USUAL = 1e-2  # while hypotheses are compared


@dataclass(frozen=True, eq=False)
class Hidden:
    """The joints that were not measured and matter.

    Attributes:
        names: Of the joints.
        dofs: Their degrees of freedom.
    """

    names: tuple[str, ...]
    dofs: tuple[int, ...]

    def __bool__(self) -> bool:
        return bool(self.dofs)

    def note(self, logs: Sequence[Log]) -> str:
        """Return in words that estimates stand for measurements, and how sure they are."""
        found = torch.cat([log.uncertainty for log in logs if log.uncertainty is not None])
        deviations = torch.diagonal(found, dim1=1, dim2=2).sqrt().median(0).values
        half = found.shape[1] // 2
        worst = max(float(deviations[dof]) for dof in self.dofs)
        fastest = max(float(deviations[half + dof]) for dof in self.dofs)
        return (
            f"{', '.join(self.names)} was not logged: what it did is estimated from the others, "
            f"within ±{worst:.2g} rad or m and ±{fastest:.2g} per second"
        )

    def estimated(
        self, predictor: Predictor, logs: Sequence[Log], *, theta: Array, noise: Array
    ) -> list[Log]:
        """Return the logs with estimates of the hidden joints, and how sure they are.

        Args:
            predictor: Simulates.
            logs: The logs.
            theta: Parameters, shape ``(D,)``.
            noise: Standard deviation of each channel's noise, shape ``(C,)``.

        Raises:
            ValueError: Simulations along a log diverge.
        """
        unit = unknown_forces(predictor)

        def run(some: Sequence[Log], first: Beliefs, shares: Any, **kept: Any) -> Filtered:
            forces = np.array(shares)[:, None, None] ** 2 * unit
            given = {"theta": theta, "forces": forces, "noise": noise, **kept}
            return filtered(predictor, some, first, **given)

        starts = [self._hypotheses(predictor, log, noise) for log in logs]
        several = [log for log in logs for _ in range(_HYPOTHESES)]
        trial = {"rows": _TRIAL, "keep": False}
        found = run(several, Beliefs.joined(starts), [_USUAL] * len(several), **trial)
        likeliest = found.likelihood.reshape(len(logs), -1).argmax(1)
        first = Beliefs.joined([_one(some, i) for some, i in zip(starts, likeliest, strict=True)])
        share = likeliest_share(predictor, logs, first, theta=theta, noise=noise, rows=_TRIAL)
        whole = run(logs, first, [share] * len(logs))
        states = smoothed(predictor, whole, [len(log) for log in logs])
        return [self._filled(predictor, log, states, i) for i, log in enumerate(logs)]

    def settled(
        self, predictor: Predictor, logs: Sequence[Log], *, theta: Array, noise: Array
    ) -> Hidden:
        """Return the same: every set of logs says what its own unknown forces are."""
        del predictor, logs, theta, noise
        return self

    def require_sure(self, curvature: float) -> None:
        """Raise where the estimates are too unsure for predictions from them to be linear.

        Args:
            curvature: Of the whitening of segments that start from them.

        Raises:
            ValueError: They are.
        """
        if curvature > _CURVED:
            names = ", ".join(self.names)
            expected = f"measurements that say what {names} did (predictions start there)"
            hint = f"log the position of {names}, or take it out of the model if it stands still"
            raise ValueError(message(expected, "ones that leave it open", hint=hint))

    def _hypotheses(self, predictor: Predictor, log: Log, noise: Array) -> Beliefs:
        """Return what may be believed before a log's first row."""
        system = predictor.system
        model, size = system.task.model, predictor.tangent.size
        centre, half = _ranges(model, self.dofs)
        draws = qmc.Halton(len(self.dofs), scramble=False).random(_HYPOTHESES) * 2 - 1
        dofs = list(self.dofs)
        known = predictor.tangent.difference(_initial(model)[None], log.qpos[:1].numpy())[0, dofs]
        step = np.zeros((_HYPOTHESES, size))
        step[1:, dofs] = np.nan_to_num(centre + draws[1:] * half - known)
        qpos = predictor.tangent.displace(log.qpos[:1].numpy(), step)
        variance = np.zeros(2 * size)
        variance[list(system.channel_index)] = noise**2
        moving = variance[:size] > 0
        gain = 3.0 * log.velocity_gain.numpy() * np.sqrt(variance[:size])
        speeds = np.maximum(variance[size:], np.where(moving, gain, 0.0) ** 2)
        variance[size:] = np.where(moving & (speeds == 0), 1.0, speeds)
        for dof, width in zip(self.dofs, half, strict=True):
            variance[dof] = max(variance[dof], (_CLOSE * width) ** 2)
            variance[size + dof] = variance[size + dof] or 1.0
        qvel = np.repeat(log.qvel[:1].numpy(), _HYPOTHESES, 0)
        return Beliefs(qpos, qvel, np.repeat(np.diag(variance)[None], _HYPOTHESES, 0))

    def _filled(self, predictor: Predictor, log: Log, states: Sequence[Beliefs], i: int) -> Log:
        size, rows = predictor.tangent.size, len(log)
        asked = [d for d in (*self.dofs, *(size + d for d in self.dofs))
                 if d not in predictor.system.channel_index]  # fmt: skip
        qpos = np.stack([state.qpos[i] for state in states[:rows]])
        qvel = np.stack([state.qvel[i] for state in states[:rows]])
        covariance = np.stack([state.covariance[i] for state in states[:rows]])
        if not (np.isfinite(qpos).all() and np.isfinite(covariance).all()):
            expected = f"simulations that lead to what {', '.join(self.names)} did"
            raise ValueError(message(expected, f"diverging ones along {log.name}", hint="log them"))
        step = predictor.tangent.difference(log.qpos.numpy(), qpos)
        wanted = np.isin(np.arange(2 * size), asked)
        step = np.where(wanted[:size], step, 0.0)
        uncertainty = covariance * (wanted[:, None] & wanted)
        return replace(
            log,
            qpos=torch.from_numpy(predictor.tangent.displace(log.qpos.numpy(), step)),
            qvel=torch.from_numpy(np.where(wanted[size:], qvel, log.qvel.numpy())),
            uncertainty=torch.from_numpy(uncertainty),
            smoothed=True,
        )


def hidden_joints(predictor: Predictor, segments: Segments, theta: Array, noise: Array) -> Hidden:
    """Return the joints whose positions were not measured although they move what was.

    Args:
        predictor: Simulates.
        segments: Some.
        theta: Parameters, shape ``(D,)``.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
    """
    size, model = predictor.tangent.size, predictor.system.task.model
    hidden = [d for d in range(size) if d not in predictor.system.channel_index]
    if not hidden:
        return Hidden((), ())
    offsets = np.zeros((1 + 2 * len(hidden), 2 * size))
    for i, dof in enumerate(hidden):
        offsets[1 + 2 * i, dof], offsets[2 + 2 * i, size + dof] = _POSITION, _VELOCITY
    thetas = np.repeat(theta[None], len(offsets), 0)
    residual = predictor.residuals(segments, thetas, None, offsets) / noise
    change = np.nan_to_num(((residual[1:] - residual[:1]) ** 2).mean((1, 2, 3)), nan=np.inf)
    seen = change.reshape(-1, 2).max(1) > _MATTERS
    dofs = [dof for dof, matters in zip(hidden, seen, strict=True) if matters]
    names = dict.fromkeys(model.joint(model.dof_jntid[dof]).name for dof in dofs)
    return Hidden(tuple(names), tuple(dofs))


def _ranges(model: mujoco.MjModel, dofs: Sequence[int]) -> tuple[Array, Array]:
    """Return centre and half range of hinges and slides; of other joints no centre, and 0.5."""
    centre, half = np.full(len(dofs), np.nan), np.full(len(dofs), 0.5)
    for i, dof in enumerate(dofs):
        joint = model.dof_jntid[dof]
        widest = _WIDEST.get(int(model.jnt_type[joint]))
        if widest is not None:
            low, high = -widest, widest
            if model.jnt_limited[joint]:
                low, high = np.clip(model.jnt_range[joint], low, high)
            centre[i], half[i] = (low + high) / 2, (high - low) / 2
    return centre, half


def _initial(model: mujoco.MjModel) -> Array:
    return np.array(model.qpos0, dtype=np.float64)


def _one(beliefs: Beliefs, i: int) -> Beliefs:
    part = slice(i, i + 1)
    return Beliefs(beliefs.qpos[part], beliefs.qvel[part], beliefs.covariance[part])
