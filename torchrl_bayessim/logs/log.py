"""One trajectory at the control step: what a simulation can be started from and compared with."""

from __future__ import annotations

__all__ = ["Log"]

from dataclasses import dataclass

from torch import Tensor

from .touching import Touching


@dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    """Row ``t`` is the state at time ``t`` and the action held from ``t`` on.

    Attributes:
        name: The file's name, with its rows where the file was split.
        time: Seconds, shape ``(T,)``, in steps of the system's ``control_dt``.
        qpos: Shape ``(T, nq)``; the model's initial position where it was not measured.
        qvel: Shape ``(T, nv)``; estimated from positions where it was not measured.
        ctrl: Shape ``(T, nu)``.
        velocity_gain: The standard deviation of an estimated velocity per unit of position noise,
            1/s; 0 where the velocity was measured, shape ``(nv,)``.
        velocity_error: Typical error of an estimated velocity where the robot moves too fast for
            the sampling, shape ``(nv,)``; nothing where nobody has looked.
        measured: Which of the ``2 nv`` tangent coordinates were measured, boolean.
        first_row: The row of the file (from 0, without the header) where it begins; 0 means that
            the beginning of the trajectory is known.
        uncertainty: Covariance of the errors of what was estimated and not measured, in the tangent
            space, ``(T, 2 nv, 2 nv)``; nothing where all that matters was measured.
        smoothed: Whether estimates know of later rows, too, and not of earlier ones alone.
        touching: What contacts say of each state; nothing where nothing touches.

    All tensors of numbers are in double precision.
    """

    name: str
    time: Tensor
    qpos: Tensor
    qvel: Tensor
    ctrl: Tensor
    velocity_gain: Tensor
    measured: Tensor
    first_row: int = 0
    velocity_error: Tensor | None = None
    uncertainty: Tensor | None = None
    smoothed: bool = False
    touching: Touching | None = None

    def __len__(self) -> int:
        return len(self.time)
