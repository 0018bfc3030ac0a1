"""Throughputs measured side by side, so that what else the machine does cancels in their ratios."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import version

__all__ = ["compare", "options", "report"]

PACKAGES = (
    "torchrl-bayessim", "torch", "torchrl", "tensordict", "mujoco", "gymnasium",
    "gymnasium-robotics", "numba",
)  # fmt: skip


def options(
    arguments: list[str], *, optional: Sequence[str] = (), **defaults: int
) -> dict[str, int]:
    """Return ``name=value`` arguments over their defaults: positive, or 0 where ``optional``."""
    given = {key: value for key, _, value in (a.partition("=") for a in arguments)}
    unknown = given.keys() - defaults
    if unknown:
        raise SystemExit(f"expected options {sorted(defaults)}, got {sorted(unknown)}")
    for name, value in given.items():
        least = 0 if name in optional else 1
        if not value.isdecimal() or int(value) < least:
            raise SystemExit(f"expected {name}= a whole number from {least} on, got {value!r}")
    return defaults | {name: int(value) for name, value in given.items()}


def compare(cases: Mapping[str, Callable[[], int]], *, runs: int) -> dict[str, list[float]]:
    """Run the cases in turn, ``runs`` times after a warm-up; return frames per second of each.

    A case does some work and returns how many frames it was.
    """
    for case in cases.values():
        case()
    rates: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(runs):
        for name, case in cases.items():
            start = time.perf_counter()
            frames = case()
            rates[name].append(frames / (time.perf_counter() - start))
    return rates


def report(
    benchmark: str,
    case: str,
    values: list[float],
    *,
    seed: int | str,
    threads: int,
    unit: str = "frames/s",
    against: Mapping[str, list[float]] | None = None,
    **context: object,
) -> None:
    """Print one JSON line: median, spread, seed, threads, versions and what else the machine did.

    Args:
        benchmark: The script.
        case: What was measured.
        values: One per run.
        seed: Of everything that was drawn; in words for several.
        threads: That the case may use.
        unit: Of the values.
        against: Other cases of the same runs; the line gives medians of the ratios within a run.
        **context: What else a reader needs to repeat it.
    """
    ratios = {
        name: round(statistics.median(a / b for a, b in zip(values, other, strict=True)), 3)
        for name, other in (against or {}).items()
    }
    median = statistics.median(values)
    line = {
        "benchmark": benchmark,
        "case": case,
        "value": _rounded(median),
        "unit": unit,
        "median": _rounded(median),
        "min": _rounded(min(values)),
        "max": _rounded(max(values)),
        "runs": len(values),
        "against": ratios,
        "seed": seed,
        "threads": threads,
    }
    print(json.dumps(line | context | dict(_provenance())), flush=True)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def _provenance() -> Iterator[tuple[str, object]]:
    yield "cores", len(os.sched_getaffinity(0))
    yield "machine", platform.processor() or platform.machine()
    yield "load", round(os.getloadavg()[0], 1)
    versions = {name: version(name) for name in PACKAGES}
    yield "versions", {"python": platform.python_version(), **versions}
