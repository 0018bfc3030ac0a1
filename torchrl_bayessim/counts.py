"""Counts: whole numbers that are large enough."""

from __future__ import annotations

__all__ = ["check_count"]

from operator import index
from typing import Any

import numpy as np
import torch

from .errors import message

_MOST = 10**15  # beyond which counting would not end, and products of counts overflow
_BOOLEANS = (torch.bool, np.dtype(bool))  # which Python counts as 0 and 1


def check_count(name: str, value: Any, *, least: int = 1) -> None:
    """Refuse what is not a whole number of at least ``least``, and at most 10¹⁵.

    Raises:
        TypeError: It is not a whole number: ``16.0`` is none, as for :func:`range`, nor ``True``.
        ValueError: It is too small, or absurdly large.

    Example:
        >>> check_count("episodes", 2)
        >>> check_count("episodes", 2.5)
        Traceback (most recent call last):
        TypeError: expected a whole number of episodes, got 2.5.
    """
    try:
        if isinstance(value, bool) or getattr(value, "dtype", None) in _BOOLEANS:
            raise TypeError
        number = index(value)
    except TypeError:
        hint = f"{int(value)}" if isinstance(value, float) and value.is_integer() else ""
        raise TypeError(message(f"a whole number of {name}", value, hint=hint)) from None
    if number < least:
        expected = {0: f"{name} not to be negative", 1: f"{name} to be positive"}
        raise ValueError(message(expected.get(least, f"at least {least} {name}"), number))
    if number > _MOST:
        raise ValueError(message(f"at most {_MOST} {name}", number))
