r"""Shift and scale of a network's inputs, which one absurd simulation does not decide.

Inputs are standardised, :math:`(x - \bar x) / s`, which leaves nothing of a statistic if one
simulation of a thousand lies a billion deviations away: for the network all others are then equal.
The median and the quartiles do not move, and take the place of mean and deviation there.
"""

from __future__ import annotations

__all__ = ["InputScaling", "input_scaling"]

from collections.abc import Iterable
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from .rows import spread

_SAMPLE = 4096  # rows are enough for quartiles
_ABSURD = 1e4  # deviations from quartiles: others would differ by less than a thousandth or so
_FEW = 0.01  # of all rows: what happens more often is no accident
_CONSTANT = 1e-6  # of the magnitude: rounding


class InputScaling(NamedTuple):
    """How inputs are standardised.

    Attributes:
        shift: What is taken from them, shape ``(L,)``.
        scale: What they are then divided by, infinite for constants, shape ``(L,)``.
        absurd: Whether few rows lie so far out that the quartiles are used, shape ``(L,)``.
    """

    shift: Tensor
    scale: Tensor
    absurd: Tensor


def input_scaling(summaries: Iterable[Tensor]) -> InputScaling:
    """Return how to standardise summaries ``(N, L)``, given in parts.

    Example:
        >>> plain = torch.randn(100, 2, generator=torch.Generator().manual_seed(0))
        >>> input_scaling([plain]).absurd
        tensor([False, False])
        >>> plain[7, 1] = 3e38
        >>> found = input_scaling([plain])
        >>> found.absurd, bool((found.scale < 2).all())
        (tensor([False,  True]), True)
    """
    remaining = iter(summaries)
    first = next(remaining)
    mean, deviation, largest = spread(chain([first], remaining))
    ordered = first[:_SAMPLE].sort(0).values
    low, median, high = (ordered[len(ordered) * quarter // 4] for quarter in (1, 2, 3))
    typical = (high / 1.35 - low / 1.35).clamp(max=torch.finfo(mean.dtype).max)
    varies = typical > _CONSTANT * median.abs()
    far = (first[:_SAMPLE] - median).abs() > _ABSURD * typical
    few = far.double().mean(0) <= _FEW
    absurd = ~deviation.isfinite() | (varies & few & (deviation > _ABSURD * typical))
    constant = deviation <= _CONSTANT * (1e-12 + largest)
    scale = torch.where(constant, torch.inf, deviation)
    quartiles = torch.where(varies, typical, torch.inf)
    return InputScaling(
        torch.where(absurd, median, mean), torch.where(absurd, quartiles, scale), absurd
    )
