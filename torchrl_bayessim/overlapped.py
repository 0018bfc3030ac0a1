"""A learner that improves from one batch while the next one is collected, if it can."""

from __future__ import annotations

__all__ = ["Overlapped"]

from collections.abc import Callable
from typing import Any

from tensordict import TensorDictBase


class Overlapped:
    """Hands batches to a learner and leaves the time of collecting to it.

    Off-policy learners can use it, those that have ``begin``, ``work`` and ``finish`` besides
    ``update``, such as :class:`.agents.ddpg.DDPG`; others learn at once. The policy then changes
    while it collects, by updates that no clock decides: same seed, same numbers.

    Args:
        learner: Has ``update``, and the other three if it can.

    Attributes:
        meanwhile: For `next_batch`; None if the learner cannot use the time.
    """

    def __init__(self, learner: Any) -> None:
        self._learner = learner
        self._into: dict[str, float] | None = None
        able = all(hasattr(learner, name) for name in ("begin", "work", "finish"))
        self.meanwhile: Callable[[float], None] | None = learner.work if able else None

    def update(self, batch: TensorDictBase, *, into: dict[str, float], **options: Any) -> None:
        """Hand over a batch, after the last one is used up; the report on it goes ``into``."""
        self.finish()
        if self.meanwhile is None:
            into.update(self._learner.update(batch, **options))
            return
        self._learner.begin(batch, **options)
        self._into = into

    def finish(self) -> None:
        """Let the learner use the last batch up; what `update` reports of it is there then."""
        if self._into is not None:
            into, self._into = self._into, None
            into.update(self._learner.finish())
