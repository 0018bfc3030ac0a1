"""A command that is held over parts of a control step, where a simulation is stepped in parts.

What a command is relative to, the position of a joint or the pose of a welded body, is that of the
control step's beginning, however many parts follow.
"""

from __future__ import annotations

__all__ = ["HeldCommand"]

import numpy as np
from numpy.typing import NDArray

from .stepper import Stepper

Array = NDArray[np.float64]


class HeldCommand:
    """Holds the commands of a control step over its parts.

    Args:
        stepper: The simulations, at the beginning of the control step.
        rows: Which of them.
    """

    def __init__(self, stepper: Stepper, rows: NDArray[np.int64]) -> None:
        self._stepper, self._rows = stepper, rows
        relative = stepper.relative
        self._moved = np.flatnonzero(relative >= 0)
        self._joints = relative[self._moved]
        self._begun = stepper["qpos"][np.ix_(rows, self._joints)]
        self._pose = stepper["weld_pose"][rows] if stepper.welded else None

    def controls(self, commands: Array) -> Array:
        """Return the controls that commands ``(R, C)`` of the beginning make, ``(R, nu)``."""
        controls = commands[:, : len(self._stepper.relative)].copy()
        controls[:, self._moved] += self._begun
        return controls

    def again(self, commands: Array) -> Array:
        """Return what to command in the coming part, so that ``(R, C)`` of the beginning go on."""
        if self._pose is not None:
            self._stepper["weld_pose"][self._rows] = self._pose
        if not len(self._moved):
            return commands
        since = self._begun - self._stepper["qpos"][np.ix_(self._rows, self._joints)]
        held = commands.copy()
        held[:, self._moved] += since
        return held
