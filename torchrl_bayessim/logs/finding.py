"""What a check of logs found: where, what, and whether the part can be used."""

from __future__ import annotations

__all__ = ["Finding", "runs"]

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that is wrong, or odd, with the logs.

    Attributes:
        kind: A short name of what was found.
        file: The file's name; empty if it concerns all of them.
        rows: First and last row, counted from 0 without the header.
        message: One sentence.
        severity: ``error``: that part is left out of a diagnosis; ``warning``: it is used.
        parts: First and last row of every stretch, where there are several within ``rows``.
    """

    kind: str
    file: str
    rows: tuple[int, int]
    message: str
    severity: str = "warning"
    parts: tuple[tuple[int, int], ...] = field(default=())

    def __post_init__(self) -> None:
        if not self.parts:
            object.__setattr__(self, "parts", (self.rows,))

    def __str__(self) -> str:
        place = f"{self.file} rows {self.rows[0]} to {self.rows[1]}: " if self.file else ""
        return f"{self.severity}: {place}{self.message} ({self.kind})"


def runs(marked: NDArray[np.bool_]) -> tuple[tuple[int, int], ...]:
    """Return first and last index of every stretch of marked rows.

    Example:
        >>> runs(np.array([False, True, True, False, True]))
        ((1, 2), (4, 4))
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]])))
    return tuple((int(a), int(b) - 1) for a, b in edges.reshape(-1, 2))
