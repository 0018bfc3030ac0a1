"""What happens to a command before it acts: timing, distortion and loss, at every control step.

Strengths are per actuator, in seconds, in units of the command or as fractions. ``u`` is the
command, ``Δ`` the control step and ``u_max`` the robot's ``command_scale``.
"""

from __future__ import annotations

__all__ = [
    "ActionBias",
    "ActionDelay",
    "ActionGain",
    "ActionJitter",
    "ActionLag",
    "ActionQuantization",
    "BatterySag",
    "DeadBand",
    "PacketDrop",
    "Saturation",
]

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from .drive_timing import DriveDelay, DriveLag
from .effect import ActionEffect, Effect, Memory, Now, Reach
from .history import delayed, empty_line, filled, read_line
from .laws import SECOND_LAG, SECOND_LAG_OF_STEPS, bent, decay, lagged, quantized, within
from .robot import Robot
from .transmission import ServoDeadBand, ServoGain, servos

_LONGEST = 8  # control steps that a delay line remembers
_SOFT = 0.5  # of a bend: ``v / √(1 + (v / l)²)``
_SOFTER: Mapping[str, tuple[float, float, float]] = {"softness": (0.02, 0.1, 1.0)}


class ActionDelay(ActionEffect):
    """Commands act late: ``(1−f) u_{k−n} + f u_{k−n−1}`` with ``s = (n+f) Δ``.

    In seconds, 0 to 5 control steps or 0.1 s. From logs of commands and measurements alone it
    cannot be told from a delay of all sensors.

    Args:
        inside: Whether a command acts from a time within the control step on, and not as the mean
            of two; see `DriveDelay`.
    """

    name, unit, group = "action_delay", "s", "timing"
    stage = 2

    def __init__(self, *, inside: bool = False) -> None:
        self.inside = inside

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return the mean of two commands, and the one from a time within the step on."""
        del seconds
        return ActionDelay(), ActionDelay(inside=True)

    def on(self, robot: Robot) -> Effect:
        """Return the delay at every time step, of a robot that moves on within the step."""
        return DriveDelay() if self.inside and robot.fast else self

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the actuators' names, none if only a faster robot would tell the difference."""
        return () if self.inside else super().targets(robot)

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 5 control steps, at most 0.1 s."""
        return within(torch.ones_like(robot.command_scale), 0.0, min(5 * robot.dt, 0.1))

    def start(self, action: Tensor) -> Memory:
        """Return a delay line that remembers nothing."""
        return {"past": empty_line(action, _LONGEST)}

    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the command of ``s`` seconds ago."""
        late, past = read_line(memory["past"], action, strength / now.robot.dt)
        return late, {"past": past}

    def whole(self, actions: Tensor, strength: Tensor, now: Now) -> Tensor:
        """Return a whole sequence, delayed."""
        return delayed(actions, (strength / now.robot.dt).unsqueeze(-2).clamp(max=_LONGEST))


class ActionJitter(ActionEffect):
    """Commands act late by another time at each step, uniform between 0 and ``s`` seconds."""

    name, unit, group, random = "action_jitter", "s", "timing", True
    stage = 1

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 2 control steps."""
        return within(torch.ones_like(robot.command_scale), 0.0, 2 * robot.dt)

    def start(self, action: Tensor) -> Memory:
        """Return a delay line that remembers nothing."""
        return {"past": empty_line(action, _LONGEST)}

    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return a command of up to ``s`` seconds ago."""
        late, past = read_line(memory["past"], action, now.noise * strength / now.robot.dt)
        return late, {"past": past}

    def whole(self, actions: Tensor, strength: Tensor, now: Now) -> Tensor:
        """Return a whole sequence, delayed."""
        steps = now.noise * strength.unsqueeze(-2) / now.robot.dt
        return delayed(actions, steps.clamp(max=_LONGEST))


class ActionLag(ActionEffect):
    """The drive follows the command with a time constant: ``a ← u + e^{−Δ/s} (a − u)``.

    In seconds, 0 to 0.15; a first-order filter. The controller's acts once per control step, and
    what it has reached is held. A drive's goes on within the step, where its mean is
    ``u + (s/Δ) (1 − e^{−Δ/s}) (a − u)``.

    Of two such filters in a row, as of a motor's current and its controller, the first has
    ``(1 − r) s`` and the second ``r s``: ``s`` is how late a steady change arrives (`two_lags`).

    Args:
        held: Whether it is the controller's.
        second: ``r``, 0 to 0.5; 0 for one filter. A diagnosis fits it.
    """

    name, unit, group = "action_lag", "s", "timing"
    stage = 10

    def __init__(self, *, held: bool = True, second: float = 0.0) -> None:
        self.held, self.second = held, second

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return the controller's and the drive's."""
        del seconds
        return ActionLag(held=True), ActionLag(held=False)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the share of the second filter."""
        del reach
        return SECOND_LAG_OF_STEPS if self.held else SECOND_LAG

    def on(self, robot: Robot) -> Effect:
        """Return a drive's lag at every time step, of a robot that moves on within the step."""
        return self if self.held or not robot.fast else DriveLag(second=self.second)

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.15 s."""
        return within(torch.ones_like(robot.command_scale), 0.0, 0.15)

    def start(self, action: Tensor) -> Memory:
        """Return no command yet."""
        unknown = torch.full_like(action, torch.nan)
        return {"first": unknown, "last": unknown} if self.second else {"last": unknown}

    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return what the drive has reached, or its mean over the step."""
        dt = now.robot.dt
        if not self.held:
            return lagged(action, memory, dt=dt, time_constant=strength, second=self.second)
        behind = filled(memory["last"], action) - action
        if not self.second:
            reached = action + decay(dt, strength) * behind
            return reached, {"last": reached}
        # the second is given what the first has reached
        before = filled(memory["first"], action) - action
        first = decay(dt, (1 - self.second) * strength) * before
        last = first + decay(dt, self.second * strength) * (behind - first)
        return action + last, {"first": action + first, "last": action + last}


class DeadBand(ActionEffect):
    """Small commands do nothing and all lose ``s``: ``sgn(u) max(|u| − s, 0)``.

    In units of the command, 0 to 40 % of ``u_max``. A servo's band is around its target; see
    `ServoDeadBand`. What is lost of a command may bend into ``s`` as a soft `Saturation` does.

    Args:
        damped: Of servos: whether their damping is lost within the band too.
        softness: Of motors: of the bend; 0 for a corner. A diagnosis fits it.
    """

    name, unit, group, memoryless = "dead_band", "command", "dead zone", True
    stage = 7

    def __init__(self, *, damped: bool = True, softness: float = 0.0) -> None:
        self.damped, self.softness = damped, softness

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return the band with and without the damping, and a soft one."""
        del seconds
        return DeadBand(), DeadBand(damped=False), DeadBand(softness=_SOFT)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return a soft one's softness."""
        del reach
        return _SOFTER if self.softness else {}

    def on(self, robot: Robot) -> Effect:
        """Return the band of servos, where there is one."""
        if servos(robot) and not self.softness:
            return ServoDeadBand(damped=self.damped)
        return self

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the actuators' names, none if it is of servos only, or of motors and they are."""
        other = self.softness and servos(robot)
        return super().targets(robot) if self.damped and not other else ()

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.4 ``u_max``."""
        return within(robot.command_scale, 0.0, 0.4)

    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return what exceeds the band."""
        del now
        return action - bent(action, strength, self.softness), memory


class Saturation(ActionEffect):
    """Strong commands are cut: ``clip(u, ±(1 − s) u_max)``, where ``u_max`` bounds commands.

    A fraction, 0 to 0.9: what the largest command loses. A soft one, such as an iron core's, bends
    all along, ``u (1 + |u / l|ᵖ)^(−1/p)`` with ``p = 1 / softness``, where the largest command
    loses as much: ``(l / u_max)⁻ᵖ = (1 − s)⁻ᵖ − 1``.

    Args:
        softness: Of the bend; 0 for a corner. A diagnosis fits it.
    """

    name, unit, group, memoryless = "saturation", "fraction", "gain", True
    stage = 8
    limit = True

    def __init__(self, softness: float = 0.0) -> None:
        self.softness = softness

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return the hard and the soft one."""
        del seconds
        return Saturation(), Saturation(_SOFT)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return a soft one's softness."""
        del reach
        return _SOFTER if self.softness else {}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.9."""
        return within(torch.ones_like(robot.command_scale), 0.0, 0.9)

    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the command within its limit."""
        left, most = 1 - strength, now.robot.command_scale.to(action)
        if self.softness:
            power = 1 / self.softness
            left = (left**-power - 1).clamp(min=1e-12) ** -self.softness
        return torch.where(strength > 0, bent(action, left * most, self.softness), action), memory


class ActionGain(ActionEffect):
    """The drive is stronger or weaker than told: ``(1 + s (1 + b |u| / u_max)) u``.

    A fraction, −0.5 to 0.5. A servo goes to another place then; of one that is as strong or as soft
    as that see `ServoGain`.

    Args:
        bend: ``b``; 0 where large commands are as wrong as small ones. A diagnosis fits it.
        servo: Of servos: whether it is their force that is scaled.
        damped: Of these: whether their damping is, too.
    """

    name, unit, group, memoryless = "action_gain", "fraction", "gain", True
    stage = 5

    def __init__(self, bend: float = 0.0, *, servo: bool = False, damped: bool = True) -> None:
        self.bend, self.servo, self.damped = bend, servo, damped

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return the factor on commands, and that on the force of servos."""
        del seconds
        return ActionGain(), ActionGain(servo=True), ActionGain(servo=True, damped=False)

    def on(self, robot: Robot) -> Effect:
        """Return the gain of servos, where it is that."""
        return ServoGain(damped=self.damped) if self.servo and servos(robot) else self

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the actuators' names, none if it is of servos only."""
        return () if self.servo else super().targets(robot)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the bend."""
        del reach
        return {"bend": (0.05, -0.8, 0.8)}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return −0.5 and 0.5."""
        return within(torch.ones_like(robot.command_scale), -0.5, 0.5)

    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the scaled command."""
        if self.bend:
            share = action.abs() / now.robot.command_scale.to(action)
            strength = strength * (1 + self.bend * share)
        return action * (1 + strength), memory


class ActionBias(ActionEffect):
    """A constant is added: ``u + s``; in units of the command, up to 30 % of ``u_max``."""

    name, unit, group, memoryless = "action_bias", "command", "offset", True
    stage = 4

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return ±0.3 ``u_max``."""
        return within(robot.command_scale, -0.3, 0.3)

    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the shifted command."""
        del now
        return action + strength, memory


class BatterySag(ActionEffect):
    """The drive weakens with time: ``u max(1 − s f(x), 0)``, ``x = min(t / T, 1.5)``; 0 to 0.6.

    ``f(x) = (1 − e^{−b x}) / (1 − e^{−b})``, or ``x`` for ``b = 0``.

    Args:
        seconds: ``T``, after which the fraction ``s`` is lost.
        bend: ``b``; positive where it weakens ever less. A diagnosis fits it.
    """

    name, unit, group, memoryless = "battery_sag", "fraction", "gain", True
    stage = 9

    def __init__(self, seconds: float = 10.0, bend: float = 0.0) -> None:
        self.seconds, self.bend = seconds, bend

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the bend."""
        del reach
        return {"bend": (0.1, -1.0, 4.0)}

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return what is lost within the runs, if they are shorter than ``T``."""
        return (BatterySag(min(seconds, self.seconds)),)

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.6."""
        return within(torch.ones_like(robot.command_scale), 0.0, 0.6)

    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the command that the battery still supports."""
        spent = (now.time.to(action) / self.seconds).clamp(max=1.5)
        if self.bend:
            spent = torch.expm1(-self.bend * spent) / math.expm1(-self.bend)
        return action * (1 - strength * spent).clamp(min=0), memory


class PacketDrop(ActionEffect):
    """With probability ``s`` a command is lost, and the last one that arrived stays; 0 to 0.4."""

    name, unit, group, random = "packet_drop", "probability", "noise", True
    stage = 0

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.4."""
        return within(torch.ones_like(robot.command_scale), 0.0, 0.4)

    def start(self, action: Tensor) -> Memory:
        """Return no command yet."""
        return {"last": torch.full_like(action, torch.nan)}

    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return this command or the last that arrived."""
        arrived = torch.where(now.noise < strength, filled(memory["last"], action), action)
        return arrived, {"last": arrived}


class ActionQuantization(ActionEffect):
    """Commands are rounded to multiples of ``s``; in their units, 0 to 20 % of ``u_max``."""

    name, unit, group, memoryless = "action_quantization", "command", "noise", True
    stage = 3
    graded = False

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.2 ``u_max``."""
        return within(robot.command_scale, 0.0, 0.2)

    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the nearest multiple."""
        del now
        return quantized(action, strength), memory
