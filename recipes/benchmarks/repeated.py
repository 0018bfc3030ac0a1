"""Same seed, same machine: the same numbers? And what do more threads change?

Every recipe in its short setting three times: with one thread of torch and simulations on all
cores; again on one core, which must give the same numbers, bit for bit and without times and paths;
and with more threads of torch, which add in another order: how far the numbers of result.json are
then apart. Prints one JSON line per recipe (half an hour on two busy cores)::

    python recipes/benchmarks/repeated.py [sim2real_ppo ...] [threads=2]

``threads=0`` leaves the third run out, which takes long where others use the cores too.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from killed import RECIPES, Case, run
from measuring import options, report
from written_numbers import apart, differing, read

SETTINGS = {
    "sim2real_ppo": ("short=true",),
    "sim2real_seeds": ("short=true", "seeds=2"),
    "sim2real_ddpg_her": ("short=true",),
    "posterior_recovery": ("short=true",),
    "sequential_refinement": ("short=true",),
    "robustness": ("short=true", "seeds=2"),
    "close_the_loop": ("short=true", "seeds=2"),
    "withheld_effects": ("robots=arm", "tiers=T0=1,T1=1", "seed=5"),
    "diagnose": (),
}


def made(name: str, folder: Path) -> Case:
    """Return a recipe with its short setting; with a robot's logs, if it needs them."""
    settings = SETTINGS[name]
    if name == "diagnose":
        sys.path.append(str(RECIPES))
        from withheld import cases, folders

        case = cases.make(cases.Plan("T1", "arm", ("coulomb_friction",)), np.random.default_rng(0))
        for file, text in folders.handed_over(case).items():
            (folder / file).write_text(text)
        settings = (f"system={folder}/system.yaml", f"data={folder}")
    return Case(RECIPES / f"{name}.py", settings)


@contextmanager
def one_core() -> Iterator[None]:
    """Let what is started here run on one of the cores."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def repeat(case: Case, folder: Path, *, threads: int) -> dict[str, Any]:
    """Return how many entries a run has, where a second one differs, and how far more threads."""
    run(case, folder / "first")
    with one_core():
        run(case, folder / "again")
    first = read(folder / "first")
    found: dict[str, Any] = {
        "entries": len(first),
        "differing": differing(first, read(folder / "again")),
    }
    if threads:
        run(replace(case, settings=(*case.settings, f"threads={threads}")), folder / "threads")
        found["apart"] = apart(first, read(folder / "threads"))
    return found


def main(*arguments: str) -> None:
    """Repeat the recipes in turn."""
    names = [name for name in arguments if "=" not in name]
    given = options([a for a in arguments if "=" in a], optional=["threads"], threads=2)
    for name in names or SETTINGS:
        with tempfile.TemporaryDirectory() as folder:
            data = Path(folder, "data")
            data.mkdir()
            found = repeat(made(name, data), Path(folder), threads=given["threads"])
        count = len(found["differing"])
        report("repeated", name, [count], unit="entries", seed=0, **given, **found)


if __name__ == "__main__":
    main(*sys.argv[1:])
