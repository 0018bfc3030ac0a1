"""Updates that are due, made bit by bit: while a simulator steps, a learner has time for some."""

from __future__ import annotations

__all__ = ["OwedUpdates"]

from collections.abc import Iterator


class OwedUpdates:
    """So many updates of a learner, to be made when there is time.

    What is made when depends on the shares that are asked for, and on no clock.

    Example:
        >>> made = []
        >>> owed = OwedUpdates((made.append(i) for i in range(10)), 10)
        >>> owed.work(0.25)
        >>> made
        [0, 1]
        >>> owed.finish()
        >>> len(made)
        10

    Args:
        updates: Makes one update at each turn.
        count: How many there are.
    """

    def __init__(self, updates: Iterator[None], count: int) -> None:
        self._updates, self._count, self._made = updates, count, 0
        self._failure: Exception | None = None

    def work(self, share: float) -> None:
        """Make updates until this share of them is made; `finish` tells of a failure."""
        while self._failure is None and self._made < round(min(share, 1.0) * self._count):
            try:
                next(self._updates, None)  # an interrupt ends them
            except Exception as error:
                self._failure = error
            self._made += 1

    def finish(self) -> None:
        """Make the others.

        Raises:
            Exception: What an update raised; those after it are not made.
        """
        self.work(1.0)
        if self._failure is not None:
            raise self._failure
