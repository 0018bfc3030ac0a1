"""Strengths as users give them: one number, one per target, or some by name."""

from __future__ import annotations

__all__ = ["Strength", "strength_of"]

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ..errors import message
from ..kinds import real_numbers

Strength = float | Tensor | Sequence[float] | Mapping[str, float | Tensor]


def strength_of(name: str, strength: Strength, targets: tuple[str, ...]) -> Tensor:
    """Return strengths of shape ``(*batch, N)``, or ``(1,)`` for the same everywhere.

    Args:
        name: The effect's name, for errors.
        strength: One number for all targets, shape ``(*batch, N)``, or by target numbers or
            tensors ``batch``, zero for those not named.
        targets: The names of the ``N`` targets.

    Raises:
        KeyError: There is no such target.
        ValueError: There are no targets, or the strengths are no numbers, have another shape or are
            not finite.

    Example:
        >>> strength_of("coulomb_friction", {"knee": 0.1}, ("hip", "knee"))
        tensor([0.0000, 0.1000], dtype=torch.float64)
    """
    if not targets:
        raise ValueError(message(f"something that {name} can act on", "a robot without"))
    if isinstance(strength, Mapping):
        strength = dict(strength)
        for target in strength:
            if target not in targets:
                raise KeyError(message(f"a target of {name}", target, available=targets))
        given = {t: _numbers(s, name) for t, s in strength.items()}
        zero = torch.zeros((), dtype=torch.float64)
        try:
            columns = torch.broadcast_tensors(*(given.get(t, zero) for t in targets))
        except RuntimeError:
            shapes = {t: tuple(value.shape) for t, value in given.items()}
            raise ValueError(message(f"strengths of {name} of one shape", shapes)) from None
        values = torch.stack(columns, -1)
    else:
        values = _numbers(strength, name)
        values = values.expand(len(targets)) if values.ndim == 0 else values
    if not values.ndim or values.shape[-1] != len(targets):
        expected = f"one strength of {name} for each of {targets}"
        raise ValueError(message(expected, tuple(values.shape)))
    if not values.isfinite().all():
        raise ValueError(message(f"finite strengths of {name}", values.tolist()))
    return values


def _numbers(value: object, name: str) -> Tensor:
    try:
        return real_numbers(f"strengths of {name} in numbers", value, torch.float64)
    except TypeError:
        raise ValueError(message(f"strengths of {name} in numbers", value)) from None
