"""Draws for episodes: θ as a function of (seed, entry, environment, episode), and of nothing else.

However environments are spread over processes, and in whatever order they finish, episode ``e``
of environment ``i`` gets the same θ. One call of the source serves 64 environments: the table of
``(environment // 64, episode)`` is drawn under its own key, and environment ``i`` takes row
``i mod 64``.
"""

from __future__ import annotations

__all__ = ["EpisodeDraws"]

from collections import OrderedDict

import torch
from tensordict import NestedKey
from torch import Tensor

from .counts import check_count
from .errors import message
from .sources import Empirical, Grid, Source, check_source, draw

_ROWS = 64
_TABLES = 4096  # of 64 rows: 1,024 environments may lie 256 episodes apart before one is redrawn


class EpisodeDraws:
    """θ for any (environment, episode).

    Args:
        source: Where to draw from; a `Grid` gives environment ``i`` its row in every episode.
        seed: Another seed, other draws.
        pool: Restrict to this many draws, made once; each episode takes one of them at random.
            (Ramos et al. 2019 train on 100 domains.)
        entry: What is drawn: two entries of one environment are independent.

    Raises:
        TypeError: ``source`` cannot be sampled, or ``pool`` is no whole number.
        ValueError: ``pool`` is not positive, or is given for a `Grid`.

    Example:
        >>> theta = EpisodeDraws(torch.distributions.Uniform(torch.zeros(2), torch.ones(2)))
        >>> environments, episodes = torch.tensor([0, 1, 70]), torch.tensor([3, 3, 0])
        >>> bool((theta(environments, episodes)[2] == theta(environments[2:], episodes[2:])).all())
        True
    """

    def __init__(
        self,
        source: Source | Grid,
        *,
        seed: int = 0,
        pool: int | None = None,
        entry: NestedKey = "theta",
    ) -> None:
        if not isinstance(source, Grid):
            check_source(source)
        if pool is not None:
            check_count("draws in a pool", pool)
            if isinstance(source, Grid):
                raise ValueError(message("a source that samples, to draw a pool from", "a Grid"))
        self._key = (seed, entry if isinstance(entry, str) else repr(entry))
        if pool is not None and not isinstance(source, Grid):
            source = Empirical(draw(source, pool, key=(*self._key, "pool")))
        self.source = source
        self._tables: OrderedDict[tuple[int, int], Tensor] = OrderedDict()

    def __call__(self, environments: Tensor, episodes: Tensor) -> Tensor:
        """Return θ, shape ``(N, D)``, for ``N > 0`` global environment and episode numbers."""
        source = self.source
        if isinstance(source, Grid):
            return source.rows(environments)
        rows: dict[tuple[int, int], list[int]] = {}
        pairs = zip((environments // _ROWS).tolist(), episodes.tolist(), strict=True)
        for n, pair in enumerate(pairs):
            rows.setdefault(pair, []).append(n)
        parts = [self._table(source, *pair)[environments[n] % _ROWS] for pair, n in rows.items()]
        order = torch.tensor([n for part in rows.values() for n in part])
        return torch.cat(parts)[order.argsort()]

    def _table(self, source: Source, chunk: int, episode: int) -> Tensor:
        table = self._tables.get((chunk, episode))
        if table is None:
            key = (*self._key, chunk, episode)
            table = self._tables[chunk, episode] = draw(source, _ROWS, key=key)
            if len(self._tables) > _TABLES:
                self._tables.popitem(last=False)
        return table
