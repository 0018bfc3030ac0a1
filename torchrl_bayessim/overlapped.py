"""A learner that improves from one batch while the next one is collected, if it can."""

from __future__ import annotations

__all__ = ["Overlapped"]

from collections.abc import Callable
from typing import Any

from tensordict import TensorDictBase


class Overlapped:
    """Hands batches to a learner and leaves the time of collecting to it.

    Off-policy learners can use it, those with ``begin``, ``work`` and ``finish`` such as
    :class:`.agents.ddpg.DDPG`; others learn at once. Either way a report comes one batch late. The
    policy changes while it collects, by updates that no clock decides: same seed, same numbers.

    Args:
        learner: Has ``update``, or all three.

    Attributes:
        meanwhile: For `next_batch`; None if the learner cannot use the time.
    """

    def __init__(self, learner: Any) -> None:
        self._learner = learner
        self._reported: dict[str, float] = {}
        able = all(hasattr(learner, name) for name in ("begin", "work", "finish"))
        self.meanwhile: Callable[[float], None] | None = learner.work if able else None

    def update(self, batch: TensorDictBase, **options: Any) -> dict[str, float]:
        """Hand over a batch; return the report on the one before, empty for the first."""
        reported = self.finish()
        if self.meanwhile is None:
            self._reported = self._learner.update(batch, **options)
        else:
            self._learner.begin(batch, **options)
        return reported

    def finish(self) -> dict[str, float]:
        """Let the learner use the last batch up, and return the report on it."""
        if self.meanwhile is not None:
            return self._learner.finish()
        reported, self._reported = self._reported, {}
        return reported
