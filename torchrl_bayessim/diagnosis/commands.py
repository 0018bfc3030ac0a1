"""What reaches the actuators: recorded commands, and what effects on commands make of them."""

from __future__ import annotations

__all__ = ["commanded"]

import numpy as np
import torch
from numpy.typing import NDArray

from ..effects.robot import Robot
from ..effects.sequence import command_sequence, in_stages
from .segments import Segments
from .strengths import Strengths

Array = NDArray[np.float64]


def commanded(
    robot: Robot, segments: Segments, strengths: Strengths, count: int, *, seed: int = 0
) -> tuple[Array, NDArray[np.int64]]:
    """Return the distinct command sequences, ``(B, W, A)``, and which each row follows.

    From the beginning of the windows to the end of the horizon. Random effects are drawn from
    ``seed``.
    """
    size, upto = len(segments), segments.history + segments.horizon
    plain = segments.ctrl[:, :upto]
    kinds = [(effect, strengths[effect]) for effect in in_stages(strengths)]
    changed = np.zeros(count, dtype=bool)
    for _, values in kinds:
        changed |= values.any(1)
    which = np.flatnonzero(changed)
    number = np.zeros(count, dtype=np.int64)
    number[which] = 1 + np.arange(len(which))
    sequence = (number[:, None] * size + np.arange(size)).reshape(-1)
    if not len(which):
        return np.ascontiguousarray(plain), sequence
    time = torch.from_numpy(segments.time[:, :upto])
    current = torch.from_numpy(plain).expand(len(which), *plain.shape).clone()
    for effect, values in kinds:
        on = values[which].any(1)
        if on.any():
            strength = torch.from_numpy(values[which][on])[:, None]
            current[torch.from_numpy(on)] = command_sequence(
                effect, current[torch.from_numpy(on)], strength, robot, time=time, seed=seed
            )
    distinct = np.concatenate([plain[None], current.numpy()])
    return np.ascontiguousarray(distinct.reshape(-1, *plain.shape[1:])), sequence
