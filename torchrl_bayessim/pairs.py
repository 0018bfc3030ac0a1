"""Room for pairs of parameters and summaries, in memory or on disk, and what fills it."""

from __future__ import annotations

__all__ = ["counted", "empty_pairs", "fill_parameters", "fill_summaries"]

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from tqdm.auto import tqdm

from .inference.rows import parts
from .sources import Source, draw

_T = TypeVar("_T")


def counted(
    turns: Iterable[tuple[Tensor, _T]], total: int, *, progress: bool
) -> Iterator[tuple[Tensor, _T]]:
    """Yield the turns of a simulation, with a progress bar of their summaries, ``(n, L)`` each."""
    with tqdm(total=total, desc="simulate", disable=not progress, leave=False, unit="pair") as bar:
        for summaries, rest in turns:
            yield summaries, rest
            bar.update(len(summaries))


def empty_pairs(count: int, folder: Path | None) -> TensorDictBase:
    """Return pairs without entries, of batch size ``[count]``: in memory, or in files there."""
    pairs = TensorDict({}, batch_size=[count])
    return pairs if folder is None else pairs.memmap_(str(folder))


def fill_parameters(pairs: TensorDictBase, source: Source, *, key: tuple[int | str, ...]) -> Tensor:
    """Give pairs their ``"theta"``, and return it, ``(N, D)``; many are drawn in parts.

    Example:
        >>> uniform = torch.distributions.Uniform(torch.zeros(2), torch.ones(2))
        >>> fill_parameters(empty_pairs(70_000, None), uniform, key=(0,)).unique(dim=0).shape
        torch.Size([70000, 2])
    """
    room = torch.empty(0)
    for number, part in enumerate(parts(len(pairs))):
        part_key = (*key, number) if number else key
        theta = draw(source, part.stop - part.start, key=part_key)
        room = room if number else _room(pairs, "theta", theta)
        room[part] = theta
    return room


def fill_summaries(
    pairs: TensorDictBase, turns: Iterable[tuple[Tensor, object]], *, progress: bool
) -> None:
    """Give pairs their ``"summary"``, turn by turn: the first of each turn, ``(n, L)``."""
    done, room = 0, torch.empty(0)
    for summaries, _ in counted(turns, len(pairs), progress=progress):
        if len(summaries):
            room = room if done else _room(pairs, "summary", summaries)
            room[done : done + len(summaries)] = summaries
            done += len(summaries)


def _room(pairs: TensorDictBase, name: str, rows: Tensor) -> Tensor:
    """Return room for such rows of all pairs."""
    shape = torch.Size((len(pairs), *rows.shape[1:]))
    if not pairs.is_memmap():
        pairs.set(name, torch.empty(shape, dtype=rows.dtype))
        return pairs.get(name)
    return pairs.make_memmap(name, shape=shape, dtype=rows.dtype).as_subclass(Tensor)
