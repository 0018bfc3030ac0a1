"""Threads that are started when they are first needed, and again in a process forked from this."""

from __future__ import annotations

__all__ = ["Threads"]

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")


class Threads:
    """A pool of threads that a forked process does not inherit: it would wait for them for ever.

    Example:
        >>> Threads(2).submit(max, 1, 3).result()
        3

    Args:
        count: How many at most.
    """

    def __init__(self, count: int) -> None:
        self._count, self._process = count, 0
        self._pool: ThreadPoolExecutor | None = None

    def submit(self, call: Callable[..., Result], *arguments: object) -> Future[Result]:
        """Let a thread call ``call(*arguments)``."""
        if self._pool is None or self._process != os.getpid():
            self._pool, self._process = ThreadPoolExecutor(self._count), os.getpid()
        return self._pool.submit(call, *arguments)
