"""A force effect on one environment, with its hidden state, called before every time step."""

from __future__ import annotations

__all__ = ["Push"]

from collections.abc import Callable

from torch import Tensor

from ..envs.task import Readings
from .effect import ForceEffect, Memory
from .forcing import Forcing
from .memory import renewed
from .robot import Robot


class Push:
    """Adds what the effect adds; see `additions`.

    Args:
        effect: The effect.
        robot: A robot with a model.
        strength: Returns the strengths now, shape ``(N,)`` or ``(*batch, N)``.

    Raises:
        ValueError: The robot has no model.
    """

    def __init__(self, effect: ForceEffect, robot: Robot, strength: Callable[[], Tensor]) -> None:
        self._effect, self._strength = effect, strength
        self._forcing = Forcing(robot)
        self._memory: Memory | None = None
        self._velocity: Tensor | None = None  # of the last call, for its shape

    @property
    def memory(self) -> Memory:
        """The hidden state, empty before the first call."""
        return {} if self._memory is None else self._memory

    def __call__(self, state: Readings) -> dict[str, Tensor]:
        """Return what is added in the coming time step."""
        active = [(self._effect, self._strength())]
        if self._memory is None:
            (self._memory,) = self._forcing.start(active, state)
        self._velocity = self._forcing.velocity(state)
        added, (self._memory,) = self._forcing(active, [self._memory], state)
        return added

    def begin(self, mask: Tensor) -> None:
        """Begin anew where ``mask``, boolean, shape ``batch``, is true."""
        if self._memory is not None and self._velocity is not None:
            self._memory = renewed(self._memory, self._effect.start(self._velocity), mask)
