"""Randomness with an owner: every draw is a function of a seed and a key, never of global state.

A *key* is a tuple of integers and strings such as ``(seed, "reset", environment, episode)``. The
same key gives the same numbers on one process, on many, and after a resume, so nothing about
random number generators needs to be kept in a checkpoint.
"""

from __future__ import annotations

__all__ = ["check_draw_key", "generator", "isolated", "seed_from"]

import hashlib
import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from .kinds import check_kind


def seed_from(*key: int | str) -> int:
    """Return a 63-bit seed that depends on every element of ``key`` and on their order.

    Example:
        >>> seed_from(0, "reset", 3) == seed_from(0, "reset", 3)
        True
        >>> seed_from(0, 12) == seed_from(0, 1, 2)
        False
    """
    digest = hashlib.blake2b(repr(key).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def check_draw_key(key: object) -> None:
    """Refuse what is no key of draws.

    Raises:
        TypeError: It is no tuple, or list, of numbers and strings.
    """
    check_kind("a key of draws, a tuple of whole numbers and strings", key, tuple, list)


def generator(*key: int | str) -> torch.Generator:
    """Return a CPU generator seeded by ``key``.

    Example:
        >>> a, b = generator(0, "a"), generator(0, "a")
        >>> torch.rand(1, generator=a) == torch.rand(1, generator=b)
        tensor([True])
    """
    return torch.Generator().manual_seed(seed_from(*key))


@contextmanager
def isolated(*key: int | str) -> Iterator[None]:
    """Seed the global generators of torch, NumPy and Python by ``key``, and restore them after.

    Those of CUDA, too, if CUDA was in use before.

    For code that draws from the global generators and takes no other (policies and collectors of
    TorchRL, third-party distributions): inside the block its draws depend on ``key`` alone, and
    the user's program does not notice.

    Example:
        >>> before = torch.random.get_rng_state()
        >>> with isolated(0, "policy"):
        ...     _ = torch.rand(3)
        >>> bool((torch.random.get_rng_state() == before).all())
        True
    """
    numpy_state, python_state = np.random.get_state(), random.getstate()  # noqa: NPY002
    try:
        # to ask an unused GPU for its state would begin its use
        devices = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
        with torch.random.fork_rng(devices=devices):
            seed = seed_from(*key, "torch")
            torch.random.default_generator.manual_seed(seed)
            if devices:
                torch.cuda.manual_seed_all(seed)
            np.random.seed(seed_from(*key, "numpy") % 2**32)  # noqa: NPY002
            random.seed(seed_from(*key, "python"))
            yield
    finally:
        np.random.set_state(numpy_state)  # noqa: NPY002
        random.setstate(python_state)
