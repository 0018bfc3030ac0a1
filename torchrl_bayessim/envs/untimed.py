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

import mujoco

from .libmujoco import address_of

_clock = ctypes.c_void_p.from_address(address_of("mjcb_time"))


@contextmanager
def untimed() -> Iterator[None]:
    """Take the clock of MuJoCo's Python bindings away, and give it back; a user's own stays.

    It is one for all of a process: durations of what other threads step meanwhile mean nothing,
    since some begin with a clock and end without. Threads may overlap: whoever took the clock
    returns it, unless there is another one by then.
    """
    if mujoco.get_mjcb_time() is not None:  # set by a user, in Python
        yield
        return
    # other threads may step: a compiled call site loads the pointer once, and tests what it calls
    taken, _clock.value = _clock.value, None
    try:
        yield
    finally:
        if taken is not None and _clock.value is None:
            _clock.value = taken
