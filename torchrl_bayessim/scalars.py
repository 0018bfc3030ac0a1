"""Settings that are one real number, within bounds."""

from __future__ import annotations

__all__ = ["check_number"]

import math
from numbers import Real
from typing import Any

from .errors import message


def check_number(
    name: str,
    value: Any,
    *,
    least: float = -math.inf,
    above: float = -math.inf,
    below: float = math.inf,
    most: float = math.inf,
) -> None:
    """Refuse what is no finite number, or lies outside the bounds.

    Raises:
        TypeError: It is no number.
        ValueError: It is not finite, less than ``least``, more than ``most``, or not between
            ``above`` and ``below``.

    Example:
        >>> check_number("lr", 1e-3, above=0.0)
        >>> check_number("lr", "fast", above=0.0)
        Traceback (most recent call last):
        TypeError: expected a finite lr above 0, got 'fast'.
    """
    bounds = {" of at least": least, " of at most": most, " above": above, " below": below}
    said = [f"{words} {bound:g}" for words, bound in bounds.items() if math.isfinite(bound)]
    expected = f"a finite {name}{' and'.join(said)}"
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(message(expected, value))
    number = float(value)
    if not (math.isfinite(number) and least <= number <= most and above < number < below):
        raise ValueError(message(expected, value))
