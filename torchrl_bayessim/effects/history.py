"""What was commanded or measured before: delays of a fraction of a step, and values held.

A delay of ``d = n + f`` steps interpolates between samples, ``y_k = (1−f) x_{k−n} + f x_{k−n−1}``,
so that it is continuous in ``d`` and does nothing, to the bit, at ``d = 0``. Before the first
sample there was the first sample: a memory starts as NaN, and what is NaN is replaced by what comes
first. So a constant signal passes unchanged.
"""

from __future__ import annotations

__all__ = ["advanced", "delayed", "empty_line", "filled", "read_line"]

import torch
from torch import Tensor


def filled(memory: Tensor, value: Tensor) -> Tensor:
    """Return the memory, with ``value`` where nothing has been remembered yet."""
    return torch.where(memory.isnan(), value, memory)


def empty_line(value: Tensor, length: int) -> Tensor:
    """Return a delay line for values ``(*batch, N)`` of up to ``length`` steps ago."""
    return value.new_full((*value.shape, length), torch.nan)


def read_line(line: Tensor, value: Tensor, steps: Tensor) -> tuple[Tensor, Tensor]:
    """Return the value of ``steps`` ago, and the line with the present one.

    Args:
        line: Past values, the latest first, shape ``(*batch, N, L)``.
        value: The present ones, shape ``(*batch, N)``.
        steps: Delays, broadcast to ``(*batch, N)``; longer ones than ``L`` act as ``L``.
    """
    past = torch.cat([value.unsqueeze(-1), filled(line, value.unsqueeze(-1))], -1)
    whole, fraction = _split(steps.expand_as(value), past.shape[-1] - 1)
    whole = whole.unsqueeze(-1)
    older = (whole + 1).clamp(max=past.shape[-1] - 1)
    recent, before = past.gather(-1, whole)[..., 0], past.gather(-1, older)[..., 0]
    return recent + fraction * (before - recent), past[..., :-1]


def delayed(record: Tensor, steps: Tensor) -> Tensor:
    """Return a whole record ``(*batch, T, N)``, delayed by ``steps``, ``(*batch, T or 1, N)``.

    Example:
        >>> delayed(torch.tensor([[0.0], [1.0], [2.0]]), torch.tensor([[1.5]]))[:, 0]
        tensor([0.0000, 0.0000, 0.5000])
    """
    return _shifted(record, steps, -1)


def advanced(record: Tensor, steps: Tensor) -> Tensor:
    """Return a whole record with later values, what `delayed` undoes up to interpolation.

    After the last value the last one is held.
    """
    return _shifted(record, steps, 1)


def _shifted(record: Tensor, steps: Tensor, sign: int) -> Tensor:
    shape = torch.broadcast_shapes(record.shape, steps.shape)
    record, last = record.expand(shape), shape[-2] - 1
    whole, fraction = _split(steps.to(record).expand(shape), last + 1)
    index = torch.arange(last + 1)[:, None] + sign * whole
    near = record.gather(-2, index.clamp(0, last))
    far = record.gather(-2, (index + sign).clamp(0, last))
    return near + fraction * (far - near)


def _split(steps: Tensor, longest: int) -> tuple[Tensor, Tensor]:
    steps = steps.clamp(0, longest)
    whole = steps.floor()
    return whole.long(), steps - whole
