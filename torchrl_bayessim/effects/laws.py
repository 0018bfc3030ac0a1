"""Formulas that several laws share, each exact where the strength is zero."""

from __future__ import annotations

__all__ = [
    "SECOND_LAG",
    "SECOND_LAG_OF_STEPS",
    "bent",
    "decay",
    "lagged",
    "quantized",
    "two_lags",
    "within",
]

from collections.abc import Mapping

import torch
from torch import Tensor

from .effect import Memory
from .history import filled

# a share of the time constant, as `Effect.free` has it
SECOND_LAG: Mapping[str, tuple[float, float, float]] = {"second": (0.02, 0.0, 0.5)}
# of what is filtered once per control step: what is far below that changes nothing
SECOND_LAG_OF_STEPS: Mapping[str, tuple[float, float, float]] = {"second": (0.25, 0.0, 0.5)}


def within(scale: Tensor, low: float, high: float) -> tuple[Tensor, Tensor]:
    """Return bounds that are multiples of a scale."""
    return scale * low, scale * high


def decay(dt: float, time_constant: Tensor) -> Tensor:
    """Return ``e^{−dt/T}``, what is left after ``dt``; zero for a time constant of zero."""
    return torch.exp(-dt / time_constant.clamp(min=0.0))


def two_lags(dt: float, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return what is left after ``dt`` of two lags in a row, and of the first in the second.

    The second is the shorter one.

    With ``T₁ ȧ = −a`` and ``T₂ ḃ = a − b``: ``a = e₁ a₀`` and ``b = e₂ b₀ + g a₀``, where
    ``g = T₁ (e₁ − e₂) / (T₁ − T₂)``, for equal ones ``(dt / T) e^{−dt/T}``.

    Example:
        >>> one = torch.ones(1, dtype=torch.float64)
        >>> [round(float(left), 4) for left in two_lags(1.0, 2 * one, one)]
        [0.6065, 0.3679, 0.4773]
    """
    left, further = decay(dt, first), decay(dt, second)
    some = torch.where(second > 0, second, 1.0)
    apart = dt * (first - second) / (torch.where(first > 0, first, 1.0) * some)
    # (1 - exp(-x)) / x, which loses nothing where lags are nearly equal
    share = torch.where(apart > 0, -torch.expm1(-apart) / torch.where(apart > 0, apart, 1.0), 1.0)
    return left, further, dt / some * left * share


def lagged(
    command: Tensor, memory: Memory, *, dt: float, time_constant: Tensor, second: float
) -> tuple[Tensor, Memory]:
    """Return the mean over ``dt`` of what follows a command with a lag, and where it has got to.

    Of one filter ``u + (s/Δ) (1 − e^{−Δ/s}) (a − u)``; of two, see `two_lags`.

    Args:
        command: ``u``, shape ``(*batch, N)``.
        memory: ``last``, ``a``, and of two filters ``first``; NaN before the first command.
        dt: ``Δ``, s.
        time_constant: ``s``, s, broadcast to the command's shape.
        second: Share of a second filter; 0 for one.

    Example:
        >>> none = {"last": torch.full((1,), torch.nan)}
        >>> lag = dict(dt=0.1, time_constant=torch.tensor([0.1]), second=0.0)
        >>> mean, memory = lagged(torch.zeros(1), none, **lag)
        >>> mean, memory = lagged(torch.ones(1), memory, **lag)
        >>> round(mean.item(), 3), round(memory["last"].item(), 3)
        (0.368, 0.632)
    """
    behind = filled(memory["last"], command) - command
    if not second:
        left = decay(dt, time_constant)
        reached = command + left * behind
        return command + time_constant / dt * (1 - left) * behind, {"last": reached}
    before = filled(memory["first"], command) - command
    times = (1 - second) * time_constant, second * time_constant
    left, further, through = two_lags(dt, *times)
    first, last = left * before, further * behind + through * before
    late = (times[0] * (before - first) + times[1] * (behind - last)) / dt
    return command + late, {"first": command + first, "last": command + last}


def quantized(value: Tensor, step: Tensor) -> Tensor:
    """Return the nearest multiple of ``step``, or the value itself where that is zero."""
    some = torch.where(step > 0, step, 1.0)
    return torch.where(step > 0, some * torch.round(value / some), value)


def bent(value: Tensor, limit: Tensor, softness: float) -> Tensor:
    """Return values that bend into ``±limit``: ``v (1 + |v / l|^(1/σ))^(−σ)``, at σ = 0 cut there.

    Example:
        >>> one = torch.tensor(1.0)
        >>> [round(bent(one, one, softness).item(), 3) for softness in (0.0, 0.5, 1.0)]
        [1.0, 0.707, 0.5]
    """
    if not softness:
        return value.clamp(-limit, limit)
    some = torch.where(limit > 0, limit, 1.0)
    over = (value / some).abs()
    # of the larger of the two, so that no power overflows
    large = over.clamp(min=1.0)
    bend = large * ((over / large) ** (1 / softness) + large ** (-1 / softness)) ** softness
    return torch.where(limit > 0, value / bend, 0.0)
