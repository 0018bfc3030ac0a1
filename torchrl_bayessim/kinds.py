"""Refusing what is of another kind than an argument must be, before it fails somewhere inside."""

from __future__ import annotations

__all__ = [
    "check_choice",
    "check_function",
    "check_key",
    "check_keys",
    "check_kind",
    "check_names",
    "real_numbers",
]

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from .errors import message


def check_kind(expected: str, value: object, *kinds: type, hint: str = "") -> None:
    """Refuse what is an instance of none of ``kinds``.

    Raises:
        TypeError: It is none.

    Example:
        >>> check_kind("a prior", None, dict)
        Traceback (most recent call last):
        TypeError: expected a prior, got 'NoneType'.
    """
    if not isinstance(value, kinds):
        raise TypeError(message(expected, type(value).__name__, hint=hint))


def check_function(expected: str, value: object) -> None:
    """Refuse what cannot be called.

    Raises:
        TypeError: It cannot.
    """
    if not callable(value):
        raise TypeError(message(expected, type(value).__name__))


def check_choice(expected: str, value: object, available: Iterable[str]) -> None:
    """Refuse what is none of some names.

    Raises:
        ValueError: It is none.

    Example:
        >>> check_choice("a reduction", "men", ["mean", "sum"])
        Traceback (most recent call last):
        ValueError: expected a reduction, got 'men'. Available: mean (did you mean this?), sum.
    """
    names = list(available)
    if not isinstance(value, str) or value not in names:
        raise ValueError(message(expected, value, available=names))


def check_key(name: str, value: object) -> None:
    """Refuse what is no key of a TensorDict's entry: a string, or a tuple of them.

    Raises:
        TypeError: It is none.
    """
    parts = value if isinstance(value, tuple) else (value,)
    if not parts or not all(isinstance(part, str) and part for part in parts):
        raise TypeError(message(f"{name}= to be an entry's key, a string or tuple of them", value))


def check_keys(name: str, value: object) -> None:
    """Refuse what is no sequence of keys, as one string is none.

    Raises:
        TypeError: It is none.
    """
    if isinstance(value, str) or not isinstance(value, Sequence):
        hint = f"({value!r},)" if isinstance(value, str) else ""
        raise TypeError(message(f"{name}= to be a sequence of keys", value, hint=hint))
    for key in value:
        check_key(name, key)


def check_names(expected: str, names: Sequence[Any]) -> None:
    """Refuse what are no names, each once and at least one.

    Raises:
        TypeError: One is no string.
        ValueError: There is none, or one twice.
    """
    for name in names:
        if not isinstance(name, str):
            raise TypeError(message(f"{expected}, strings", name))
    if not names or len(set(names)) != len(names):
        raise ValueError(message(expected, names))


def real_numbers(expected: str, value: Any, dtype: torch.dtype | None = None) -> Tensor:
    """Return lists, arrays and tensors of real numbers as a tensor, of ``dtype`` if one is given.

    Raises:
        TypeError: They are no real numbers.

    Example:
        >>> real_numbers("a gain", [0.5])
        tensor([0.5000])
    """
    try:
        found = torch.as_tensor(value)
    except (
        TypeError,
        ValueError,
        RuntimeError,
        OverflowError,
    ):  # torch's, of what it cannot make sense of
        raise TypeError(message(expected, value)) from None
    if found.is_complex():
        raise TypeError(message(expected, f"complex ones, {found.dtype}"))
    return found if dtype is None else torch.as_tensor(value, dtype=dtype)
