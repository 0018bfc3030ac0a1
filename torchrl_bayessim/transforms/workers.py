"""Telling apart the workers of a batched environment, from inside one of them.

A `SerialEnv` or `ParallelEnv` calls one function per worker and does not say which worker it is
for. The one thing that it gives each of them for itself is a seed: ``set_seed(s)`` hands ``s`` to
the first worker, a seed derived from it to the second, and so on.
"""

from __future__ import annotations

__all__ = ["first_of_worker", "in_worker", "note_seeds"]

import sys
from functools import partial
from typing import Any

from ..errors import PhysicsError, message
from ..randomness import seed_from

_BATCHED = ("torchrl.envs.batched_envs", "torchrl.envs.async_envs")


def note_seeds(env: Any) -> None:
    """Let the simulator ``env`` remember the seed of its last ``set_seed``."""
    if "_noted_seed" not in env.__dict__:
        env.__dict__["_noted_seed"] = None
        env.__dict__["set_seed"] = partial(_set_seed, env)


def first_of_worker(env: Any, *, numbered: bool) -> int:
    """Return a number for the first environment of a worker, made from its simulator's seed.

    Raises:
        PhysicsError: There has been no seed; or the numbers have to run from 0, ``numbered``.
    """
    seed = env.__dict__.get("_noted_seed")
    if seed is None or numbered:
        expected = "what tells the workers of a batched environment apart"
        got = "no seed yet" if seed is None else "a Grid, which goes by their numbers"
        outside = "TransformedEnv(SerialEnv(n, make), DomainRandomizer(source))"
        other = "env.set_seed(0) before the reset" if seed is None else "first_environment="
        hint = f"the randomizer outside, {outside}, or {other}"
        raise PhysicsError(message(expected, got, hint=hint))
    return seed_from(seed, "worker") % 2**48


def in_worker() -> bool:
    """Return whether a batched environment is the one that calls, in this process or another."""
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_globals.get("__name__") in _BATCHED:
            return True
        frame = frame.f_back
    return False


def _set_seed(env: Any, seed: int | None = None, *args: Any, **kwargs: Any) -> int | None:
    env.__dict__["_noted_seed"] = seed
    return type(env).set_seed(env, seed, *args, **kwargs)
