"""Processes beside a recipe, which end when it does, also if it is killed."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process

import torch


def workers(count: int, *, threads: int) -> ProcessPoolExecutor:
    """Return a pool of ``count`` processes of their own interpreters, each of so many threads."""
    spawn = get_context("spawn")
    return ProcessPoolExecutor(count, mp_context=spawn, initializer=begin, initargs=(threads,))


def begin(threads: int) -> None:
    """Set the threads of this process, and end it when its parent ends."""
    torch.set_num_threads(threads)
    parent = parent_process()
    assert parent is not None  # it was spawned

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
