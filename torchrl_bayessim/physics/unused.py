"""Which parameters change nothing: rollouts at both ends of each, everything else the same."""

from __future__ import annotations

__all__ = ["Rollout", "differ", "unused"]

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

Rollout = dict[str, Tensor]


def unused(
    names: Sequence[str],
    bounds: tuple[Tensor, Tensor],
    others: Iterable[Tensor],
    rollout: Callable[[Tensor], Rollout],
) -> tuple[str, ...]:
    """Return the parameters of which ``rollout`` does not depend in a single bit.

    Args:
        names: Of the D parameters.
        bounds: Lower and upper, each of shape ``(D,)``.
        others: Values of the other parameters, each of shape ``(D,)``, while one goes from its
            lower bound to its upper.
        rollout: θ of shape ``(D,)`` to what was seen, the same for the same θ.

    Example:
        >>> ends = torch.zeros(2), torch.ones(2)
        >>> unused(["a", "b"], ends, [torch.full((2,), 0.5)], lambda theta: {"seen": theta[:1]})
        ('b',)
    """
    low, high = bounds
    found = []
    for column, name in enumerate(names):
        at = torch.arange(len(low)) == column
        ends = ((torch.where(at, low, theta), torch.where(at, high, theta)) for theta in others)
        if not any(differ(rollout(one), rollout(two)) for one, two in ends):
            found.append(name)
    return tuple(found)


def differ(one: Rollout, two: Rollout) -> bool:
    """Return whether two rollouts differ in any entry."""
    return one.keys() != two.keys() or any(not torch.equal(one[key], two[key]) for key in one)
