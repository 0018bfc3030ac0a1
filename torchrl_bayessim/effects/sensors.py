"""What happens to a measured value: timing, distortion, noise and loss, at every control step.

Strengths are per channel, in seconds, in the channel's units or as fractions. ``x`` is the true
value, ``Δ`` the control step. `restore` undoes a law on a whole record where it can be undone.
"""

from __future__ import annotations

__all__ = [
    "SensorBias",
    "SensorDelay",
    "SensorDrift",
    "SensorDropout",
    "SensorGain",
    "SensorLag",
    "SensorNoise",
    "SensorQuantization",
]

from collections.abc import Mapping

import torch
from torch import Tensor

from ..scalars import check_number
from .effect import Effect, Memory, Now, Reach, SensorEffect
from .history import advanced, delayed, empty_line, filled, read_line
from .laws import SECOND_LAG, SECOND_LAG_OF_STEPS, decay, quantized, within
from .robot import Robot

_LONGEST = 8  # control steps that a delay line remembers
_STEP = 0.05  # of a drift, to see what a change of the law does
_LEAST = 1e-7  # a uniform number of zero would be infinitely many standard deviations away


class SensorDelay(SensorEffect):
    """Values arrive late: ``(1−f) x_{k−n} + f x_{k−n−1}`` with ``s = (n+f) Δ``.

    In seconds, 0 to 5 control steps or 0.1 s. The same on all channels, it cannot be told from a
    delay of commands.
    """

    name, unit, group = "sensor_delay", "s", "timing"

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 5 control steps, at most 0.1 s."""
        return within(torch.ones_like(robot.channel_scale), 0.0, min(5 * robot.dt, 0.1))

    def start(self, reading: Tensor) -> Memory:
        """Return a delay line that remembers nothing."""
        return {"past": empty_line(reading, _LONGEST)}

    def measure(
        self, reading: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the values of ``s`` seconds ago."""
        late, past = read_line(memory["past"], reading, strength / now.robot.dt)
        return late, {"past": past}

    def whole(self, readings: Tensor, strength: Tensor, now: Now) -> Tensor:
        """Return a whole record, delayed."""
        return delayed(readings, (strength / now.robot.dt).unsqueeze(-2).clamp(max=_LONGEST))

    def restore(self, measured: Tensor, strength: Tensor, now: Now) -> Tensor:
        """Return the record ``s`` seconds earlier; the last values are held."""
        return advanced(measured, (strength / now.robot.dt).unsqueeze(-2))


class SensorBias(SensorEffect):
    """A constant is added: ``x + s``; in the channel's units, up to 20 % of its scale."""

    name, unit, group, memoryless = "sensor_bias", "channel", "offset", True

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return ±20 % of the scale."""
        return within(robot.channel_scale, -0.2, 0.2)

    def measure(
        self, reading: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the shifted values."""
        del now
        return reading + strength, memory

    def restore(self, measured: Tensor, strength: Tensor, now: Now) -> Tensor:
        """Return the values without the constant."""
        del now
        return measured - strength.unsqueeze(-2)


class SensorGain(SensorEffect):
    """Values are scaled: ``(1 + s) x``; a fraction, −0.2 to 0.2."""

    name, unit, group, memoryless = "sensor_gain", "fraction", "gain", True

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return −0.2 and 0.2."""
        return within(torch.ones_like(robot.channel_scale), -0.2, 0.2)

    def measure(
        self, reading: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the scaled values."""
        del now
        return reading * (1 + strength), memory

    def restore(self, measured: Tensor, strength: Tensor, now: Now) -> Tensor:
        """Return the values before scaling."""
        del now
        return measured / (1 + strength.unsqueeze(-2))


class SensorNoise(SensorEffect):
    """White noise is added: ``x + s ε`` with ``ε ~ N(0, 1)``; up to 5 % of the channel's scale."""

    name, unit, group = "sensor_noise", "channel", "noise"
    memoryless, random = True, True

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 5 % of the scale."""
        return within(robot.channel_scale, 0.0, 0.05)

    def measure(
        self, reading: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the noisy values."""
        normal = torch.special.ndtri(now.noise.clamp(_LEAST, 1 - _LEAST))
        return reading + strength * normal, memory


class SensorQuantization(SensorEffect):
    """Values are rounded to multiples of ``s``: the step of an encoder; up to 5 % of the scale."""

    name, unit, group = "sensor_quantization", "channel", "noise"
    memoryless, random = True, True

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 5 % of the scale."""
        return within(robot.channel_scale, 0.0, 0.05)

    def measure(
        self, reading: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the nearest multiple."""
        del now
        return quantized(reading, strength), memory


class SensorLag(SensorEffect):
    """A first-order filter, as many make velocities: ``y ← x + e^{−Δ/s} (y − x)``; to 0.1 s.

    Of two such filters in a row the first has ``(1 − r) s`` and the second ``r s``.

    Args:
        second: ``r``, 0 to 0.5; 0 for one filter. A diagnosis tries one and two equal ones, and
            fits it.

    Raises:
        TypeError: ``second`` is no number.
        ValueError: ``second`` is not from 0 to 0.5.
    """

    name, unit, group = "sensor_lag", "s", "timing"

    def __init__(self, second: float = 0.0) -> None:
        check_number("the second filter's share", second, least=0.0, most=0.5)
        self.second = second

    @property
    def shares(self) -> tuple[float, ...]:
        """Of the strength, that of each filter."""
        return (1 - self.second, self.second) if self.second else (1.0,)

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return one filter, and two that are equal."""
        del seconds
        return SensorLag(), SensorLag(SECOND_LAG["second"][-1])

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the share of the second filter."""
        del reach
        return SECOND_LAG_OF_STEPS

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.1 s."""
        return within(torch.ones_like(robot.channel_scale), 0.0, 0.1)

    def start(self, reading: Tensor) -> Memory:
        """Return no value yet."""
        unknown = torch.full_like(reading, torch.nan)
        return {"first": unknown, "last": unknown} if self.second else {"last": unknown}

    def measure(
        self, reading: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return what the filter shows, or the second of two."""
        first, *second = self._kept(strength, now)
        passed = _filtered(reading, first, memory["first" if second else "last"])
        if not second:
            return passed, {"last": passed}
        shown = _filtered(passed, second[0], memory["last"])
        return shown, {"first": passed, "last": shown}

    def restore(self, measured: Tensor, strength: Tensor, now: Now) -> Tensor:
        """Return ``(y_k − e y_{k−1}) / (1 − e)``, of two filters twice."""
        for kept in reversed(self._kept(strength, now)):
            left = kept.unsqueeze(-2)
            before = torch.cat([measured[..., :1, :], measured[..., :-1, :]], -2)
            measured = measured + left / (1 - left) * (measured - before)
        return measured

    def _kept(self, strength: Tensor, now: Now) -> list[Tensor]:
        """Return what each filter keeps of its last value."""
        return [decay(now.robot.dt, share * strength) for share in self.shares]


def _filtered(value: Tensor, kept: Tensor, memory: Tensor) -> Tensor:
    """Return a value after a first-order filter."""
    return value + kept * (filled(memory, value) - value)


class SensorDrift(SensorEffect):
    """An offset grows with time: ``x + s (1 - exp(-k t)) / k``, or ``x + s t`` for ``k = 0``.

    Up to 10 % of the channel's scale per second.

    Args:
        settling: ``k``, 1/s, as of what warms up. A diagnosis fits it.
    """

    name, unit, group, memoryless = "sensor_drift", "channel/s", "offset", True

    def __init__(self, settling: float = 0.0) -> None:
        self.settling = settling

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the settling: until it is a constant from nearly the start."""
        once = 1 / max(reach.time, 1e-9)
        return {"settling": (_STEP * once, 0.0, 20 * once)}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return ±10 % of the scale per second."""
        return within(robot.channel_scale, -0.1, 0.1)

    def measure(
        self, reading: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return the drifted values."""
        return reading + strength * self._spent(now.time.to(reading)), memory

    def restore(self, measured: Tensor, strength: Tensor, now: Now) -> Tensor:
        """Return the values without the drift."""
        return measured - strength.unsqueeze(-2) * self._spent(now.time.to(measured))

    def _spent(self, time: Tensor) -> Tensor:
        """Return how long it would have drifted steadily to where it is, s."""
        return time if not self.settling else -torch.expm1(-self.settling * time) / self.settling


class SensorDropout(SensorEffect):
    """With probability ``s`` a value is not renewed, and the last one shown stays; 0 to 0.3."""

    name, unit, group, random = "sensor_dropout", "probability", "noise", True

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.3."""
        return within(torch.ones_like(robot.channel_scale), 0.0, 0.3)

    def start(self, reading: Tensor) -> Memory:
        """Return no value yet."""
        return {"last": torch.full_like(reading, torch.nan)}

    def measure(
        self, reading: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return this value or the last that was shown."""
        shown = torch.where(now.noise < strength, filled(memory["last"], reading), reading)
        return shown, {"last": shown}
