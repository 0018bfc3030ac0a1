"""Processes beside a recipe, which end when it does, also if it is killed."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process

import torch


def workers(count: int, *, threads: int) -> ProcessPoolExecutor:
    """Return a pool of ``count`` processes of their own interpreters, each of so many threads.

    Their matrix products are as precise as this process's are now.
    """
    return ProcessPoolExecutor(
        count,
        mp_context=get_context("spawn"),
        initializer=begin,
        initargs=(threads, torch.get_float32_matmul_precision()),
    )


def begin(threads: int, matmul_precision: str) -> None:
    """Set how this process calculates, and end it when its parent ends."""
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision(matmul_precision)
    parent = parent_process()
    assert parent is not None  # it was spawned

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
