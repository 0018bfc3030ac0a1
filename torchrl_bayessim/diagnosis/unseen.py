"""Joints that nobody measured: where a segment starts, they would have to be guessed."""

from __future__ import annotations

__all__ = ["require_seen"]

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import message
from .prediction import Predictor
from .segments import Segments

_POSITION, _VELOCITY = 0.1, 0.5  # rad or m, and per second: a guess that is good
_MATTERS = 1.0  # mean squared change of what is measured, in units of its noise


def require_seen(
    predictor: Predictor, segments: Segments, theta: NDArray[np.float64], noise: NDArray[np.float64]
) -> None:
    """Raise where a joint that was not measured moves what was.

    Args:
        predictor: Simulates.
        segments: Some.
        theta: Parameters, shape ``(D,)``.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.

    Raises:
        ValueError: A joint's position was not logged, and a small error of it would be seen.
    """
    size, model = predictor.tangent.size, predictor.system.task.model
    hidden = [d for d in range(size) if d not in predictor.system.channel_index]
    if not hidden:
        return
    offsets = np.zeros((1 + 2 * len(hidden), 2 * size))
    for i, dof in enumerate(hidden):
        offsets[1 + 2 * i, dof], offsets[2 + 2 * i, size + dof] = _POSITION, _VELOCITY
    thetas = np.repeat(theta[None], len(offsets), 0)
    residual = predictor.residuals(segments, thetas, None, offsets) / noise
    change = np.nan_to_num(((residual[1:] - residual[:1]) ** 2).mean((1, 2, 3)), nan=np.inf)
    seen = change.reshape(-1, 2).max(1) > _MATTERS
    names = _names(model, [dof for dof, matters in zip(hidden, seen, strict=True) if matters])
    if names:
        expected = "positions of all joints that move what is measured (predictions start there)"
        hint = "log them, or take joints that stand still out of the model"
        raise ValueError(message(expected, f"none of {', '.join(names)}", hint=hint))


def _names(model: mujoco.MjModel, dofs: Sequence[int]) -> list[str]:
    return list(dict.fromkeys(model.joint(model.dof_jntid[dof]).name for dof in dofs))
