"""Velocities that were not measured, where the robot moves too fast to tell them from positions.

A leg that swings forth and back within three rows has no slope that a polynomial through them could
find; the simulator knows which swings lead from one row to the next. So a filter (see `smoother`)
carries the state along every log, the positions measured and the velocities asked for, with unknown
forces as strong as makes the positions likeliest: a simulator that lacks something is trusted less.
No smoother goes back: it would fit velocities to the rows that are to be predicted from them, by
the simulator that is in question, and hide what that lacks. Only how sure they are knows a little
of what follows: how well the simulator foresees the next two rows.
"""

from __future__ import annotations

__all__ = ["FastMotion", "fast_motion"]

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..logs.log import Log
from .prediction import Predictor
from .segments import of_velocities
from .smoother import Beliefs, filtered, likeliest_share, unknown_forces
from .whitening import start_deviations

Array = NDArray[np.float64]
_FAST = 0.05  # error of an estimated velocity, as a part of how much it varies
_MOST = 0.5  # of the velocities that are estimated
_STATE = "qpos", "qvel"
_NEAR = 4  # rows that say how well the simulator follows the robot there
_TRIAL = 80  # rows of each log on which the unknown forces' strength is chosen


@dataclass(frozen=True, eq=False)
class FastMotion:
    """The degrees of freedom whose velocities a filter has to tell.

    Attributes:
        dofs: Those.
        rate: Rows of the logs, 1/s.
        share: Of `unknown_forces`; chosen anew for each set of logs where there is none.
    """

    dofs: tuple[int, ...]
    rate: float
    share: float | None = None

    def __bool__(self) -> bool:
        return bool(self.dofs)

    def note(self, logs: Sequence[Log]) -> str:
        """Return in words that velocities are the simulator's guess, and how sure they are."""
        found = torch.cat([log.uncertainty for log in logs if log.uncertainty is not None])
        half = found.shape[1] // 2
        deviations = torch.diagonal(found, dim1=1, dim2=2).sqrt().median(0).values[half:]
        worst = max(float(deviations[dof]) for dof in self.dofs)
        return (
            f"the robot is too fast for {self.rate:.3g} rows a second to tell velocities that were "
            "not logged: they are estimated with the simulator from the positions, within "
            f"±{worst:.2g} per second, and strengths come out too small if much is wrong"
        )

    def require_sure(self, curvature: float) -> None:
        """Accept any curvature: what follows from unsure velocities is as wide, and tells less."""

    def settled(
        self, predictor: Predictor, logs: Sequence[Log], *, theta: Array, noise: Array
    ) -> FastMotion:
        """Return the same with unknown forces as these logs say; see `estimated`."""
        first = self._first(predictor, logs, noise)
        share = likeliest_share(predictor, logs, first, theta=theta, noise=noise, rows=_TRIAL)
        return replace(self, share=share)

    def estimated(
        self, predictor: Predictor, logs: Sequence[Log], *, theta: Array, noise: Array
    ) -> list[Log]:
        """Return the logs with estimates of the velocities, and how sure they are.

        As they are where the simulator knows less of most velocities than that they vary; that is
        not asked of logs whose unknown forces others said.

        Args:
            predictor: Simulates.
            logs: The logs.
            theta: Parameters, shape ``(D,)``.
            noise: Standard deviation of each channel's noise, shape ``(C,)``.
        """
        first, share = self._first(predictor, logs, noise), self.share
        if share is None:
            share = likeliest_share(predictor, logs, first, theta=theta, noise=noise, rows=_TRIAL)
        forces = np.repeat(share**2 * unknown_forces(predictor)[None], len(logs), 0)
        run = filtered(predictor, logs, first, theta=theta, forces=forces, noise=noise)
        surprises = np.stack(run.surprises, -1)
        found = [self._filled(log, run.beliefs, i, surprises[i]) for i, log in enumerate(logs)]
        return found if self._sure(found, run.beliefs) else list(logs)

    def _first(self, predictor: Predictor, logs: Sequence[Log], noise: Array) -> Beliefs:
        """Return what may be believed before the first rows: what a polynomial says, widely."""
        gain, _ = of_velocities(logs)
        deviations = start_deviations(predictor.system, noise, gain, (gain > 0) * _varying(logs))
        covariance = np.repeat(np.diag(deviations**2)[None], len(logs), 0)
        qpos, qvel = (np.stack([getattr(log, n)[0].numpy() for log in logs]) for n in _STATE)
        return Beliefs(qpos, qvel, covariance)

    def _filled(self, log: Log, states: Sequence[Beliefs], i: int, surprise: Array) -> Log:
        """Return a log with its estimates, the less sure the more surprising the rows nearby."""
        rows = states[: len(log)]
        qvel, gain, error = log.qvel.clone(), log.velocity_gain.clone(), log.velocity_error
        error = torch.zeros_like(gain) if error is None else error.clone()
        dofs = list(self.dofs)
        qvel[:, dofs] = torch.from_numpy(np.stack([state.qvel[i] for state in rows])[:, dofs])
        gain[dofs] = error[dofs] = 0.0
        asked = np.zeros(2 * len(gain), dtype=bool)
        asked[[len(gain) + dof for dof in dofs]] = True
        covariance = np.stack([state.covariance[i] for state in rows]) * (asked[:, None] & asked)
        covariance *= np.maximum(_nearby(surprise[: len(log)]), 1.0)[:, None, None]
        return replace(
            log,
            qvel=qvel,
            velocity_gain=gain,
            velocity_error=error,
            uncertainty=torch.from_numpy(covariance),
        )

    def _sure(self, logs: Sequence[Log], states: Sequence[Beliefs]) -> bool:
        """Return whether most velocities are known better than that they vary."""
        dofs = list(self.dofs)
        size = states[0].qvel.shape[1]
        each = [
            np.stack([np.diag(state.covariance[i])[size:] for state in states[: len(log)]])
            for i, log in enumerate(logs)
        ]
        known, varying = np.median(np.concatenate(each), 0)[dofs], _varying(logs)[dofs]
        if not (np.isfinite(known).all() and np.isfinite(varying).all()):
            return False
        return self.share is not None or bool((known < varying**2).mean() > _MOST)


def fast_motion(predictor: Predictor, logs: Sequence[Log]) -> FastMotion:
    """Return the velocities that polynomials cannot tell; none if they can tell most.

    Args:
        predictor: Simulates.
        logs: With the errors that polynomials make, as `with_velocity_errors` gives: of hinges and
            slides.
    """
    gain, error = of_velocities(logs)
    told = [dof for dof in predictor.system.robot.dof_index if gain[dof] > 0]
    fast = error[told] > _FAST * _varying(logs)[told]
    dofs = np.flatnonzero(gain > 0) if fast.sum() > _MOST * len(told) else []
    return FastMotion(tuple(int(dof) for dof in dofs), 1.0 / predictor.system.control_dt)


def _nearby(surprise: Array) -> Array:
    """Return the mean of each row, the one before and the two after, ``(T,)``."""
    padded = np.pad(surprise, (1, 2), mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, _NEAR).mean(-1)


def _varying(logs: Sequence[Log]) -> Array:
    """Return the standard deviation of each velocity, ``(nv,)``."""
    return np.concatenate([log.qvel.numpy() for log in logs]).std(0)
