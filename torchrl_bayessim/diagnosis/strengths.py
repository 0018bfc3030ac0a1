"""How strongly effects act in each candidate of a batch."""

from __future__ import annotations

__all__ = ["Strengths", "with_late_commands"]

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..effects.action import ActionDelay
from ..effects.effect import Effect
from ..effects.robot import Robot
from ..effects.sensors import SensorDelay

Strengths = Mapping[Effect, NDArray[np.float64]]
"""Strengths of the candidates, by effect: shape ``(P, N)`` for the effect's ``N`` targets."""


def with_late_commands(strengths: Strengths, robot: Robot) -> Strengths:
    """Return the same with delays of all channels alike as delays of all commands.

    No log can tell the one from the other. But a record that is moved as a whole needs no
    interpolation, which would average noise away, and so seem to explain it.

    Example:
        >>> late = {SensorDelay(): np.array([[0.02, 0.02], [0.02, 0.0]])}
        >>> robot = Robot(dt=0.01, actuators=("motor",))
        >>> {e.name: s.tolist() for e, s in with_late_commands(late, robot).items()}
        {'sensor_delay': [[0.0, 0.0], [0.02, 0.0]], 'action_delay': [[0.02], [0.0]]}

    Args:
        strengths: Of all effects.
        robot: Whose.
    """
    sensors, commands = SensorDelay(), ActionDelay(inside=robot.fast).on(robot)
    late, actuators = strengths.get(sensors), len(robot.actuators)
    if late is None or not actuators:
        return strengths
    alike = late[:, :1] * (late == late[:, :1]).all(1, keepdims=True)
    return {
        **strengths,
        sensors: late - alike,
        commands: strengths.get(commands, np.zeros((len(late), actuators))) + alike,
    }
