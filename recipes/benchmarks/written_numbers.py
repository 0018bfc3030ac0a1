"""What a run has written, number by number, so that two runs can be compared to the last bit."""

from __future__ import annotations

__all__ = ["apart", "differing", "read", "unfinished"]

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from torchrl_bayessim import checkpoint

# what depends on where and when a run was made
ELSEWHERE = {"provenance", "checkpoint", "video", "out", "resume"}


def read(folder: Path) -> dict[str, Any]:
    """Return every number of every file, without times and places, by where it stands.

    Pixels of pictures are among them; pages and tables, whose numbers are those of result.json,
    are not.

    Raises:
        ValueError, OSError: A file that is not whole.
    """
    return dict(_leaves(folder))


def differing(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Return where two runs differ, in files, entries or numbers."""
    return sorted(k for k in one.keys() | other.keys() if one.get(k, _NONE) != other.get(k, _NONE))


def apart(one: dict[str, Any], other: dict[str, Any]) -> dict[str, float]:
    """Return how far numbers of two result.json are apart, |a - b| / max(|a|, |b|), by name.

    Only those that differ; of a list, the largest. What is no number in both counts as infinity.
    """
    far: dict[str, float] = {}
    for place in differing(one, other):
        file, *names = place.split("/")
        if file == "result.json":
            name = next((n for n in reversed(names) if not n.isdecimal()), place)
            ratio = _ratio(one.get(place), other.get(place))
            far[name] = max(far.get(name, 0.0), float(f"{ratio:.2g}"))
    return far


def _ratio(one: Any, other: Any) -> float:
    try:
        a, b = (float.fromhex(v) if isinstance(v, str) else float(v) for v in (one, other))
    except (TypeError, ValueError):
        return float("inf")
    return abs(a - b) / (max(abs(a), abs(b)) or 1.0)  # zeros of two signs


def unfinished(folder: Path) -> list[Path]:
    """Return the files that someone was writing."""
    return list(folder.rglob(".*.tmp"))


_NONE = object()


def _leaves(folder: Path) -> Iterator[tuple[str, Any]]:
    for path in sorted(folder.rglob("*")):
        reader = _READERS.get(path.suffix)
        if reader and "seconds" not in path.name:
            yield from _flat(reader(path), str(path.relative_to(folder)))


def _archive(path: Path) -> dict[str, Any]:
    with np.load(path) as arrays:
        return dict(arrays)


def _pixels(path: Path) -> Any:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


_READERS = {
    ".json": lambda path: json.loads(path.read_text()),
    ".pt": checkpoint.load,
    ".npz": _archive,
    ".png": _pixels,
    ".csv": lambda path: path.read_text().splitlines(),
}


def _flat(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, item in value.items():
            if key not in ELSEWHERE and "seconds" not in str(key):
                yield from _flat(item, f"{place}/{key}")
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from _flat(item, f"{place}/{i}")
    elif isinstance(value, torch.Tensor | np.ndarray):
        array = np.asarray(value)
        yield place, (str(array.dtype), array.shape, array.tobytes())
    else:
        yield place, value.hex() if isinstance(value, float) else value
