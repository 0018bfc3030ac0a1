"""Processes beside a recipe, which end when it does, also if it is killed."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process


def workers(count: int) -> ProcessPoolExecutor:
    """Return a pool of ``count`` processes of their own interpreters."""
    spawn = get_context("spawn")
    return ProcessPoolExecutor(count, mp_context=spawn, initializer=end_with_parent)


def end_with_parent() -> None:
    """End this process when its parent does."""
    parent = parent_process()
    assert parent is not None  # it was spawned

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
