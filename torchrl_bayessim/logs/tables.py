"""Named columns from files: CSV, Parquet, Minari datasets, TensorDicts saved by TorchRL.

A table is one trajectory: a name and columns of equal length. Arrays of several numbers per row
become columns ``observation[0]``, ``observation[1]``, …; entries ``qpos``, ``qvel`` and ``ctrl`` or
``action`` of the model's sizes also get the default names of their joints and actuators; without a
time, rows follow each other at the control step.
"""

from __future__ import annotations

__all__ = ["Table", "dataset_tables", "read_csv", "read_parquet", "tensordict_tables"]

import csv
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib import import_module
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from ..envs.task import Task
from ..errors import message
from .columns import default_columns
from .memory_maps import saved_tensordict
from .system import System

Array = NDArray[np.float64]
_BATCH = 50_000  # rows that are held as text
_LONGEST = 1_000_000  # characters of a line
_STUMP = 10  # rows of what is left of an episode beside longer ones, too few for anything
_MOST = 100_000_000  # numbers: ten of them at 1 kHz for almost three hours


class Table(NamedTuple):
    """One trajectory.

    Attributes:
        name: Of the file, with the number of the episode where there are several.
        columns: By name, shape ``(T,)`` each.
    """

    name: str
    columns: Mapping[str, Array]


def read_csv(path: Path, names: list[str]) -> Table:
    """Return columns of a CSV file with a header row.

    An empty cell is NaN. The last number of a file without a line end may be cut off, and is none.

    Raises:
        ValueError: The file cannot be read, is empty or not text in UTF-8, has a column twice, a
            row with another number of cells, a cell that is not a number or may be cut off, or
            lacks one of ``names``.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = (row for row in csv.reader(_lines(file, path.name)) if row)
            return Table(path.name, _columns(rows, names, path.name))
    except UnicodeDecodeError:
        raise ValueError(message("a CSV file in UTF-8", str(path))) from None
    except csv.Error as error:
        raise ValueError(message(f"a CSV file in {path.name}", str(error))) from None
    except OSError as error:
        expected = "a file that can be read"
        raise ValueError(message(expected, f"{path}: {error.strerror}")) from None


def _lines(file: TextIO, name: str) -> Iterator[str]:
    while line := file.readline(_LONGEST):
        if not line.endswith(("\n", "\r")):
            if len(line) == _LONGEST:
                expected = f"lines of fewer than {_LONGEST} characters in {name}"
                raise ValueError(message(expected, "a longer one"))
            line += " and no line end: is it cut off?"
        yield line


def _columns(rows: Iterator[list[str]], names: list[str], file: str) -> dict[str, Array]:
    """Return columns of numbers, from a batch of rows at a time."""
    header = [name.strip() for name in next(rows, [])]
    batch = list(islice(rows, _BATCH))
    if not batch:
        raise ValueError(message(f"a header and rows in {file}", "no rows"))
    _check_twice(header, file)
    _check_names(names, header, file)
    parts: dict[str, list[Array]] = {name: [] for name in names}
    start = 0
    while batch:
        for i, row in enumerate(batch, start):
            if len(row) != len(header):
                expected = f"{len(header)} cells in row {i} of {file}"
                hint = "the file may be cut off: delete the row, or write it anew"
                raise ValueError(message(expected, len(row), hint=hint))
        for name in names:
            column = header.index(name)
            cells = [row[column].strip() or "nan" for row in batch]
            parts[name].append(_numbers(cells, start, f"column {name!r} of {file}"))
        start += len(batch)
        _check_count(start, names, file)
        batch = list(islice(rows, _BATCH))
    return {name: np.concatenate(part) for name, part in parts.items()}


def _numbers(cells: list[str], start: int, place: str) -> Array:
    text = "".join(cells)
    if text.isascii() and "_" not in text:  # Python takes 1_000 and digits of any script
        with suppress(ValueError):
            return np.array(cells, dtype=np.float64)
    row, cell = next((i, cell) for i, cell in enumerate(cells, start) if not _is_number(cell))
    raise ValueError(message(f"a number in row {row}, {place}", cell[:80]))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell


def read_parquet(path: Path, names: list[str]) -> Table:
    """Return columns of a Parquet file; a missing value is NaN.

    Raises:
        ImportError: pyarrow is not installed.
        ValueError: It is not a Parquet file, has a column twice or lacks one of ``names``, or one
            is not of numbers.
    """
    try:
        pyarrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError:
        hint = "pip install torchrl_bayessim[recipes]"
        raise ImportError(message("pyarrow, to read Parquet", "none", hint=hint)) from None
    try:
        _check_count(parquet.read_metadata(path).num_rows, names, path.name)
        header = parquet.read_schema(path).names
        _check_twice(header, path.name)
        _check_names(names, header, path.name)
        table = parquet.read_table(path, columns=names)
        columns = {}
        for name in names:
            column = table[name].combine_chunks()
            if column.type == pyarrow.bool_():
                raise _no_number(name, path.name)
            if pyarrow.types.is_temporal(column.type):
                hint = "seconds, as numbers"
                raise _no_number(name, path.name, str(column.type), hint=hint)
            column = column.cast(pyarrow.float64())
            columns[name] = np.array(column.fill_null(np.nan).to_numpy(zero_copy_only=False))
    except (pyarrow.ArrowException, OSError, UnicodeDecodeError) as error:  # names are text
        reason = " ".join(str(error).split())[:200]
        raise ValueError(message(f"numbers in Parquet in {path.name}", reason)) from None
    return Table(path.name, columns)


def dataset_tables(folder: Path, system: System) -> list[Table]:
    """Return the episodes of a Minari dataset, with ``observations``, ``actions`` and ``infos``.

    Raises:
        ImportError: Minari is not installed.
        ValueError: The folder holds no dataset, or none that says which spaces it has (Minari would
            make the environment that it names, and so run what is written there), or the episodes
            lack one of the system's columns.
    """
    try:
        minari = import_module("minari")
    except ImportError:
        hint = "pip install torchrl_bayessim[minari]"
        raise ImportError(message("minari, to read its datasets", "none", hint=hint)) from None
    _require_spaces(folder)
    try:
        episodes = list(minari.MinariDataset(folder / "data"))
    except Exception as error:  # whatever a loader does with what was made up
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(message(f"a Minari dataset in {folder.name}", reason)) from None
    tables = []
    for episode in episodes:
        steps = len(episode.actions)
        arrays = {"actions": episode.actions}
        for name, entry in ("observations", episode.observations), ("infos", episode.infos or {}):
            arrays |= dict(_leaves(name if not isinstance(entry, Mapping) else "", entry))
        arrays = {k: v[:steps] for k, v in arrays.items()}  # the last state has no action
        arrays["action"] = arrays["actions"]
        tables.append(_table(f"{folder.name}[{episode.id}]", arrays, system))
    return tables


def _require_spaces(folder: Path) -> None:
    expected = f"a Minari dataset in {folder.name} whose metadata.json has its spaces"
    try:
        metadata = json.loads((folder / "data" / "metadata.json").read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(message(expected, str(error)[:200])) from None
    spaces = "observation_space", "action_space"
    known = metadata if isinstance(metadata, dict) else {}
    if not all(isinstance(known.get(name), str) for name in spaces):
        raise ValueError(message(expected, sorted(known)[:20] or type(metadata).__name__))


def tensordict_tables(data: TensorDictBase | Path, system: System) -> list[Table]:
    """Return the trajectories of a tensordict of batch size ``(*, T)``, cut where it is ``done``.

    Entries under ``next`` are the next row's, and left out. So are episodes of 10 rows or fewer
    beside longer ones of the same batch entry: what its size has cut off.

    Raises:
        ValueError: There is no batch dimension, trajectories of a lazy stack differ in length, an
            entry is sparse or has no values, the folder holds no tensordict or pickles, or the
            trajectories lack one of the system's columns.
    """
    name = "tensordict"
    if isinstance(data, Path):
        name = data.name
        data = saved_tensordict(data)
    if not data.ndim:
        raise ValueError(message(f"a tensordict of batch size (*, T) in {name}", "none"))
    if -1 in data.shape:
        hint = "read_logs(part, system) of each, and add the lists"
        expected = f"trajectories of one length in {name}"
        raise ValueError(message(expected, f"a batch size of {tuple(data.shape)}", hint=hint))
    if 0 in data.shape:
        return []
    _check_dense(data, name)
    done = data.get(("next", "done"), None)
    rows = data.exclude("next").reshape(-1, data.shape[-1])
    ends = torch.zeros(rows.shape) if done is None else done.reshape(*rows.shape, -1).any(-1)
    tables = []
    for row, ended in zip(rows.unbind(0), ends.unbind(0), strict=True):
        for begin, end in _episodes(ended):
            part = row[begin:end]
            arrays = {
                ".".join((key,) if isinstance(key, str) else key): _array(value)
                for key, value in part.items(include_nested=True, leaves_only=True)
                if isinstance(value, torch.Tensor) and not value.is_complex()
            }
            label = f"{name}[{len(tables)}]"
            tables.append(_table(label, arrays, system))
    return tables


def _check_dense(data: TensorDictBase, name: str) -> None:
    for value in data.values(include_nested=True, leaves_only=True):
        if not isinstance(value, torch.Tensor):
            continue
        kind = "nested" if value.is_nested else str(value.layout)
        kind = "meta" if value.is_meta else kind
        if kind != str(torch.strided):
            expected = f"dense tensors that hold values in {name}"
            raise ValueError(message(expected, f"one that is {kind}"))


def _episodes(ends: torch.Tensor) -> list[tuple[int, int]]:
    """Return where episodes begin and end, but for stumps that a batch has cut off others."""
    cuts = [0, *(ends.nonzero()[:, 0] + 1).tolist(), len(ends)]
    parts = [(begin, end) for begin, end in pairwise(cuts) if begin < end]
    if max(end - begin for begin, end in parts) <= _STUMP:
        return parts
    return [(begin, end) for begin, end in parts if end - begin > _STUMP]


def _array(value: torch.Tensor) -> NDArray[Any]:
    plain = value.detach().cpu().resolve_neg()
    return plain.numpy() if plain.dtype == torch.bool else plain.double().numpy()


def _leaves(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays of nested mappings, by their names joined with dots."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(f"{name}.{key}" if name else str(key), inner)
    else:
        yield name, np.asarray(value)


def _table(name: str, arrays: Mapping[str, NDArray[Any]], system: System) -> Table:
    columns: dict[str, NDArray[Any]] = {}
    for key, value in arrays.items():
        if not (np.issubdtype(value.dtype, np.number) or value.dtype == bool) or value.ndim < 1:
            continue
        flat = value.reshape(len(value), -1)
        columns |= {f"{key}[{i}]": flat[:, i] for i in range(flat.shape[1])}
        if value.ndim == 1 or flat.shape[1] == 1:
            columns[key] = flat[:, 0]
        columns |= _by_joint(key.rpartition(".")[2], flat, system.task)
    names, time = system.columns.used(), system.columns.time
    if time is not None and time not in columns:
        if not arrays:
            raise ValueError(message(f"columns in {name}", "none"))
        length = len(next(iter(arrays.values())))
        columns[time] = system.control_dt * np.arange(length, dtype=np.float64)
    _check_names(names, list(columns), name)
    if truths := [key for key in names if columns[key].dtype == bool]:
        raise _no_number(truths[0], name)
    return Table(name, {key: columns[key].astype(np.float64) for key in names})


def _by_joint(key: str, flat: NDArray[Any], task: Task) -> dict[str, NDArray[Any]]:
    columns = default_columns(task)
    names = {
        "qpos": [n for group in columns.qpos.values() for n in group],
        "qvel": [n for group in columns.qvel.values() for n in group],
        "ctrl": list(columns.ctrl.values()),
        "action": list(columns.ctrl.values()),
    }.get(key, [])
    return dict(zip(names, flat.T, strict=True)) if len(names) == flat.shape[1] else {}


def _no_number(
    column: str,
    file: str,
    kind: str = "booleans",
    *,
    hint: str = "what was measured or commanded, in the units of the model",
) -> ValueError:
    """Return the error for values of which nobody knows how much they are in the model's units."""
    return ValueError(message(f"numbers in column {column!r} of {file}", kind, hint=hint))


def _check_count(rows: int, names: list[str], file: str) -> None:
    most = _MOST // len(names)
    if rows > most:
        hint = "write several shorter logs"
        expected = f"at most {most} rows of {len(names)} columns in {file}"
        raise ValueError(message(expected, rows, hint=hint))


def _check_twice(header: list[str], file: str) -> None:
    # cells that a program has left empty at the ends of all rows have no names
    twice = sorted(name for name, count in Counter(header).items() if name and count > 1)
    if twice:
        raise ValueError(message(f"each column once in {file}", twice[0]))


def _check_names(names: list[str], header: list[str], file: str) -> None:
    for name in names:
        if name not in header:
            hint = "name it under columns in system.yaml"
            if (
                header
                and header[0].startswith("#")
                and (len(header) == 1 or header[0].lstrip("# ") in names)
            ):
                hint = "a first line with the names alone, without # and comments above it"
            elif len(header) == 1:
                hint = "separate cells by commas"
            expected = f"a column of {file}"
            raise ValueError(message(expected, name, available=header, hint=hint))
