"""Stepping without MuJoCo's own timers, which read a clock a dozen times per evaluation.

Its Python bindings give MuJoCo a clock with every ``MjData``, for the durations in its ``timer``.
Nobody reads those of the data that simulations are stepped in, and they take a sixth of a step of
Hopper.
"""

from __future__ import annotations

__all__ = ["untimed"]

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

from .libmujoco import address_of

_clock = ctypes.c_void_p.from_address(address_of("mjcb_time"))


@contextmanager
def untimed() -> Iterator[None]:
    """Take MuJoCo's clock away, and give it back.

    It is one for all of a process: what other threads step meanwhile is not timed, either. Threads
    may overlap: whoever took the clock returns it, unless there is another one by then.
    """
    taken, _clock.value = _clock.value, None
    try:
        yield
    finally:
        if _clock.value is None:
            _clock.value = taken
