"""Keeping work: a file that is always whole, and that runs no code when it is read.

`save` replaces the file as `whole_file` does: whoever looks sees the old checkpoint or the new one,
also after a crash or a power cut. `load` accepts tensors and plain values only, and checks the file
before it trusts it.
"""

from __future__ import annotations

__all__ = ["SCHEMA", "load", "save"]

import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .errors import message
from .whole_file import replacing

SCHEMA = 1
"""Version of the file's layout; a file with another one is refused."""

_FORMAT = "torchrl_bayessim checkpoint"


def save(path: str | os.PathLike[str], state: Mapping[str, Any]) -> None:
    """Write ``state`` to ``path``, wholly or not at all. Missing folders are made.

    Args:
        path: The file; replaced if it exists.
        state: Nested dicts, lists and tuples of tensors, numbers, strings, booleans and None.
            Tensors are copied to the CPU, without their gradients.

    Raises:
        TypeError: A value of another type; the message says where. Nothing is written then.
        IsADirectoryError: The path is a folder.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "run" / "round.pt"
        >>> save(file, {"round": 2, "weight": torch.ones(2)})
        >>> load(file)
        {'round': 2, 'weight': tensor([1., 1.])}
    """
    content = {"format": _FORMAT, "schema": SCHEMA, "state": _plain(state, "state")}
    with replacing(_file(path)) as file:
        torch.save(content, file)


def load(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the state that `save` wrote to ``path``, its tensors on the CPU.

    Raises:
        FileNotFoundError: There is no such file.
        IsADirectoryError: The path is a folder.
        ValueError: The file is truncated, damaged, of another program or of another schema.
    """
    data = _file(path).read_bytes()
    try:
        whole = _verified(data)
        content = torch.load(whole, map_location="cpu", weights_only=True)
    except Exception as e:  # there is no end of what a damaged archive or pickle ends in
        raise ValueError(
            message(
                "a whole checkpoint written by this package",
                f"{path}: {type(e).__name__}, {len(data)} bytes",
                hint="another checkpoint, or begin that run anew",
            )
        ) from e
    if not isinstance(content, dict) or content.get("format") != _FORMAT or "state" not in content:
        raise ValueError(message("a checkpoint written by this package", str(path)))
    if content.get("schema") != SCHEMA:
        raise ValueError(
            message(
                f"a checkpoint of schema {SCHEMA}",
                content.get("schema"),
                hint="the version of the package that wrote it",
            )
        )
    return content["state"]


def _verified(data: bytes) -> io.BytesIO:
    """Return the archive anew, from parts whose checksums are right.

    `torch.load` verifies none, and finds tensors by headers, in which one wrong byte moves them.

    Raises:
        zipfile.BadZipFile: A checksum is wrong, or two parts have one name.
    """
    whole = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as damaged, zipfile.ZipFile(whole, "w") as archive:
        if len(set(damaged.namelist())) < len(damaged.namelist()):
            raise zipfile.BadZipFile("two parts of one name")
        for name in damaged.namelist():
            archive.writestr(zipfile.ZipInfo(name), damaged.read(name))
    whole.seek(0)
    return whole


def _plain(value: Any, where: str) -> Any:
    """Return ``value`` with its tensors detached and copied; raise for what is not plain."""
    if isinstance(value, Tensor):
        return value.detach().to("cpu", copy=True).contiguous()
    if isinstance(value, Mapping):
        for key in value:
            if type(key) not in (str, int):
                raise TypeError(message(f"keys of {where} to be str or int", key))
        return {key: _plain(item, f"{where}[{key!r}]") for key, item in value.items()}
    if type(value) in (list, tuple):
        return type(value)(_plain(item, f"{where}[{i}]") for i, item in enumerate(value))
    if value is None or type(value) in (bool, int, float, str, bytes):
        return value
    raise TypeError(
        message(
            f"{where} to be a tensor or a plain value",
            type(value).__name__,
            hint="its state_dict(), or a tensor, number or string made from it",
        )
    )


def _file(path: str | os.PathLike[str]) -> Path:
    if Path(path).is_dir():
        hint = "name a file in it, such as checkpoint.pt"
        raise IsADirectoryError(
            message("the file of a checkpoint", f"the folder {path}", hint=hint)
        )
    return Path(path)
