"""Rows of pairs that stay on disk: memory-mapped TensorDicts, read a part at a time."""

from __future__ import annotations

__all__ = ["PART", "Rows", "mapped", "parts", "spread"]

from collections.abc import Iterable, Iterator
from itertools import chain

import torch
from tensordict import MemoryMappedTensor, TensorDictBase
from torch import Tensor

PART = 2**16  # rows that are held in memory at a time


class Rows:
    """Some rows of pairs in some order; indexing reads what it asks for and nothing else.

    Args:
        pairs: Batch size ``[N]``; memory-mapped, or it is in memory anyway.
        index: Which rows, shape ``(n,)``.

    Example:
        >>> from tensordict import TensorDict
        >>> rows = Rows(TensorDict({"theta": torch.arange(9)}, [9]), torch.tensor([7, 3, 5]))
        >>> len(rows), rows[torch.tensor([2, 0])]["theta"].tolist()
        (3, [5, 7])
    """

    def __init__(self, pairs: TensorDictBase, index: Tensor) -> None:
        self.pairs, self.index = pairs, index

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, rows: Tensor | slice) -> TensorDictBase:
        """Return these rows, in memory."""
        return self.pairs[self.index[rows]]

    def parts(self) -> Iterator[TensorDictBase]:
        """Yield all rows in order, a part at a time."""
        return (self[part] for part in parts(len(self)))


def parts(count: int) -> Iterator[slice]:
    """Yield slices that cover ``count`` rows.

    Example:
        >>> list(parts(PART + 1))
        [slice(0, 65536, None), slice(65536, 65537, None)]
    """
    return (slice(start, min(start + PART, count)) for start in range(0, count, PART))


def mapped(pairs: TensorDictBase) -> bool:
    """Return whether pairs lie in files, and not in memory."""
    return any(
        isinstance(value, MemoryMappedTensor)
        for value in pairs.values(include_nested=True, leaves_only=True)
    )


def spread(values: Iterable[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    r"""Return mean, standard deviation and largest magnitude over the rows of all parts.

    Two parts a and b have, together, :math:`\sum (x - \bar x)^2 = S_a + S_b + n_a n_b
    (\bar x_a - \bar x_b)^2 / (n_a + n_b)` (Chan, Golub & LeVeque, 1979).

    Example:
        >>> one, other = torch.tensor([[1.0], [3.0]]), torch.tensor([[-5.0]])
        >>> mean, deviation, largest = spread([one, other])
        >>> mean.item(), deviation.item() ** 2, largest.item()
        (-0.333..., 17.33..., 5.0)
    """
    remaining = iter(values)
    first, second = next(remaining), next(remaining, None)
    if second is None:
        return first.mean(0), first.std(0), first.abs().amax(0)
    count, mean, squares, largest = 0, torch.zeros(()), torch.zeros(()), torch.zeros(())
    for part in chain([first, second], remaining):
        rows, apart = len(part), part.double().mean(0) - mean
        squares = squares + part.double().var(0, correction=0) * rows
        squares = squares + apart**2 * (count * rows / (count + rows))
        mean = mean + apart * (rows / (count + rows))
        largest = torch.maximum(largest, part.abs().amax(0))
        count += rows
    deviation = (squares / (count - 1)).sqrt()
    return mean.to(largest), deviation.to(largest), largest
