"""Commands that act late within a control step, where a robot is fast enough to feel it.

A joint whose damping stops it within a control step is, at the end of it, where the last part of
the command has moved it: what a command is on average says too little. So on such a robot
(`Robot.fast`) the lag and the delay of a drive act at every time step; averaged over a control step
they are those of `action`.
"""

from __future__ import annotations

__all__ = ["DriveDelay", "DriveLag"]

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor

from .effect import ForceEffect, Memory, Now, Reach
from .history import filled
from .laws import SECOND_LAG, lagged, within
from .robot import Robot

_LONGEST = 8  # control steps that a delay line remembers
_ROUNDING = 1e-6  # of a control step


class _OfDrives(ForceEffect):
    """What changes commands at every time step; targets are actuators."""

    unit, group, channel = "s", "timing", "actuation"
    stage = 10  # a delay before it: what is late goes through the rest

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the actuators' names."""
        return robot.actuators

    def joint(self, robot: Robot, target: int) -> int:
        """Return the joint that the actuator moves."""
        return robot.joint_of_actuator[target]


class DriveLag(_OfDrives):
    """The drive follows the command with a time constant, in seconds, 0 to 0.15.

    As `ActionLag` of a drive, with the mean over a time step in the place of that over a control
    step.

    Args:
        held: As of `ActionLag`, whose form this is: not.
        second: Share of a second filter, 0 to 0.5. A diagnosis fits it.
    """

    name = "action_lag"

    def __init__(self, *, held: Literal[False] = False, second: float = 0.0) -> None:
        self.held, self.second = held, second

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the share of the second filter."""
        del reach
        return SECOND_LAG

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.15 s."""
        return within(torch.ones_like(robot.command_scale), 0.0, 0.15)

    def start(self, velocity: Tensor) -> Memory:
        """Return no command yet, of any actuator."""
        unknown = velocity.new_full((*velocity.shape[:-1], 1), torch.nan)
        return {"first": unknown, "last": unknown} if self.second else {"last": unknown}

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the change of commands: what the drive has reached on average, less the command.

        See `laws.lagged`.
        """
        mean, after = lagged(
            now.command, memory, dt=now.timestep, time_constant=strength, second=self.second
        )
        return {"command": mean - now.command}, after


class DriveDelay(_OfDrives):
    """Commands act ``s`` seconds late, whatever part of a control step that is; 0 to 5, or 0.1 s.

    The command in force at the time ``t`` is the one that was sent at ``t − s``, and of a time step
    in which it changes the mean.

    Args:
        inside: As of `ActionDelay`, whose form this is: so it is.
    """

    name = "action_delay"
    stage = 2

    def __init__(self, *, inside: Literal[True] = True) -> None:
        self.inside = inside

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 5 control steps, at most 0.1 s."""
        return within(torch.ones_like(robot.command_scale), 0.0, min(5 * robot.dt, 0.1))

    def start(self, velocity: Tensor) -> Memory:
        """Return a delay line that remembers nothing, at the beginning of a control step."""
        batch = velocity.shape[:-1]
        line = velocity.new_full((*batch, 1, _LONGEST), torch.nan)
        return {"past": line, "since": velocity.new_zeros(*batch, 1)}

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the change of commands."""
        command, since, step = now.command.unsqueeze(-1), memory["since"], now.robot.dt
        line = torch.cat([command, filled(memory["past"], command)], -1)
        # what acts at the end of this time step was sent so long before this control step began
        ago = strength - since - now.timestep
        steps = (torch.ceil(ago / step - _ROUNDING)).clamp(0, _LONGEST)
        share = ((ago + now.timestep - steps * step) / now.timestep).clamp(0, 1)
        index = steps.expand_as(now.command).long().unsqueeze(-1)
        late, before = line.gather(-1, index), line.gather(-1, (index + 1).clamp(max=_LONGEST))
        late = (late + share.unsqueeze(-1) * (before - late))[..., 0]
        passed = since + now.timestep
        ends = passed > (1 - _ROUNDING) * step
        past = torch.where(ends.unsqueeze(-1), line[..., :-1], line[..., 1:])
        return {"command": late - now.command}, {"past": past, "since": passed * ~ends}
