"""Killed at random moments and resumed: does a recipe end with the numbers of an unbroken run?

For each recipe one unbroken run, then runs that get SIGKILL at moments spread over its time, and go
on until the next; those that end are compared with it, number by number and bit for bit, without
times and paths. After every kill all files must be whole, and the processes beside the recipe must
have ended. Prints one JSON line per recipe (an hour on two busy cores)::

    python recipes/benchmarks/killed.py [sim2real_ppo ...] [kills=25] [seed=0]
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measuring import options, report
from written_numbers import differing, read, unfinished

RECIPES = Path(__file__).parent.parent


@dataclass(frozen=True)
class Case:
    """A recipe and its settings; one without ``resume=`` goes on with the same command."""

    script: Path
    settings: tuple[str, ...]
    resumes: bool = True

    def command(self, folder: Path) -> list[str]:
        """Return what starts a run, or goes on with the one that the folder holds."""
        begun = self.resumes and (folder / "settings.json").exists()
        settings = [f"resume={folder}"] if begun else [*self.settings, f"out={folder}"]
        return [sys.executable, str(self.script), "progress=false", *settings]


LONG = ("task=fetch_reach", "short=true", "warmup=104", "rounds=1", "simulations=16", "video=false")
CASES = {
    "sim2real_ppo": Case(RECIPES / "sim2real_ppo.py", ("short=true",)),
    "posterior_recovery": Case(RECIPES / "posterior_recovery.py", ("short=true",), resumes=False),
    "withheld_effects": Case(
        RECIPES / "withheld_effects.py", ("robots=arm", "tiers=T0=1,T1=1", "seed=5")
    ),
    "sim2real_ddpg_her": Case(RECIPES / "sim2real_ddpg_her.py", LONG),
}


@dataclass
class Tally:
    """What came of the kills: runs that ended, entries that differ, writes that were hit."""

    kills: int = 0
    ended: int = 0
    in_mid_write: int = 0
    differing: tuple[str, ...] = ()


def run(case: Case, folder: Path, *, until: Callable[[], bool] = lambda: False) -> bool:
    """Run and kill as soon as ``until()`` holds; return whether the run ended before.

    Raises:
        RuntimeError: The recipe failed.
        subprocess.TimeoutExpired: It was killed, but processes beside it go on.
    """
    process = subprocess.Popen(
        case.command(folder),
        env=os.environ | {"PYTHONWARNINGS": "ignore"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        while process.poll() is None and not until():
            with suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=0.01)
        process.kill()
        said, _ = process.communicate(timeout=60)  # until all who hold the pipe have ended
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    if process.returncode not in {0, -signal.SIGKILL}:
        raise RuntimeError(f"{case.script.name} ended with {process.returncode}: {said}")
    return process.returncode == 0


def after(seconds: float) -> Callable[[], bool]:
    """Return what holds as soon as so much time has gone by."""
    moment = time.perf_counter() + seconds
    return lambda: time.perf_counter() > moment


def unbroken(case: Case, folder: Path) -> tuple[float, float]:
    """Run without a kill; return when the recipe began to work, and when it ended, in seconds."""
    start = time.perf_counter()
    run(case, folder)
    whole = time.perf_counter() - start
    result = json.loads((folder / "result.json").read_text())
    return whole - result["provenance"]["seconds"], whole


def break_off(case: Case, folder: Path, *, shares: Sequence[float]) -> Tally:
    """Kill runs at these shares of an unbroken run's time, and compare those that end with it."""
    begun, whole = unbroken(case, folder / "unbroken")
    expected, tally = read(folder / "unbroken"), Tally()
    for share in shares:
        while True:
            current = folder / str(tally.ended)
            fresh, start = not current.exists(), time.perf_counter()
            if not run(case, current, until=after(begun + share * (whole - begun))):
                break
            if fresh:  # faster than the one whose time was taken
                whole = min(whole, time.perf_counter() - start)
            compare(current, expected, tally)
        tally.kills += 1
        tally.in_mid_write += bool(unfinished(current))
        read(current)  # raises if a file is not whole
    current = folder / str(tally.ended)
    run(case, current)
    compare(current, expected, tally)
    return tally


def compare(folder: Path, expected: dict[str, object], tally: Tally) -> None:
    """Note that a run has ended, and where it differs from the unbroken one."""
    tally.ended += 1
    left = [path.name for path in unfinished(folder)]
    tally.differing += (*differing(read(folder), expected), *left)


def spread(count: int, *, seed: int, recipe: str) -> Iterator[float]:
    """Yield ``count`` shares, one at random in each stretch of [0, 1), in random order.

    Each recipe has its own.
    """
    rng = np.random.default_rng([seed, *recipe.encode()])
    yield from (rng.permutation(count) + rng.random(count)) / count


def main(*arguments: str) -> None:
    """Break off the recipes in turn."""
    names = [name for name in arguments if "=" not in name]
    given = options([a for a in arguments if "=" in a], optional=["seed"], kills=25, seed=0)
    for name in names or CASES:
        shares = list(spread(given["kills"], seed=given["seed"], recipe=name))
        with tempfile.TemporaryDirectory() as folder:
            tally = break_off(CASES[name], Path(folder), shares=shares)
        told = {"ended": tally.ended, "in_mid_write": tally.in_mid_write}
        told |= {"differing": tally.differing, "seed": given["seed"], "threads": 1}
        report("killed", name, [tally.kills], unit="kills", **told)


if __name__ == "__main__":
    main(*sys.argv[1:])
