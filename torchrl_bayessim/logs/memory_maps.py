"""A TensorDict that TorchRL saved, from a folder that nobody vouches for.

``meta.json`` says which tensors the folder holds, and of which shape; each is a file that is mapped
into memory. Mapping a file that is shorter than its shape would lengthen it with zeros, so lengths
are compared first; pickles are never loaded.
"""

from __future__ import annotations

__all__ = ["saved_tensordict"]

import json
import math
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import torch
from tensordict import TensorDict, TensorDictBase

from ..errors import message

_MOST = 100_000_000  # rows
_DEEPEST = 20  # folders within each other


def saved_tensordict(folder: Path) -> TensorDictBase:
    """Return the tensordict that a folder holds.

    Raises:
        ValueError: The folder holds none, holds pickles, or a file is not as long as its shape.
    """
    expected = f"a tensordict without pickles in {folder.name}"
    try:
        _check(folder, depth=0)
        data = TensorDict.load_memmap(folder, device=torch.device("cpu"), allow_pickle=False)
        for key, value in data.items(include_nested=True, leaves_only=True):
            if value.shape[: data.ndim] != data.shape:
                raise ValueError(f"{key} of shape {list(value.shape)}")
    except Exception as error:  # whatever a loader does with what was made up
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(message(expected, reason)) from None
    if not isinstance(data, TensorDict):
        raise ValueError(message(expected, type(data).__name__))  # noqa: TRY004 (the file's value)
    return data


def _check(folder: Path, *, depth: int) -> None:
    """Raise a ValueError unless every file is as long as ``meta.json`` says."""
    meta = json.loads((folder / "meta.json").read_bytes())
    entries = {key: value for key, value in meta.items() if isinstance(value, dict)}
    if math.prod(meta.get("shape", ())) > _MOST or depth > _DEEPEST:
        raise ValueError(f"shape {meta.get('shape')}, folder {depth} of folders within each other")
    for path in folder.iterdir():
        if path.is_symlink():  # mapping a file may change it, wherever it is
            raise ValueError(f"{path.name}, which is a link")
        if path.name.endswith(".memmap"):
            stem = path.name.removesuffix(".memmap")  # may be empty, which is no suffix then
            for key in {stem, unquote(stem)} & entries.keys():
                _check_length(path, entries[key])
        elif path.is_dir() and (path / "meta.json").is_file():
            _check(path, depth=depth + 1)


def _check_length(path: Path, entry: dict[str, Any]) -> None:
    if not path.is_file() or entry.get("is_nested"):
        raise ValueError(f"{path.name}, which is no file of numbers of one shape")
    dtype = getattr(torch, str(entry["dtype"]).removeprefix("torch."))
    needed = math.prod(entry["shape"]) * dtype.itemsize
    if any(size < 0 for size in entry["shape"]) or path.stat().st_size < needed:
        got = f"{path.name} of {path.stat().st_size} bytes"
        raise ValueError(f"{got} for shape {entry['shape']}, the file may be cut off")
