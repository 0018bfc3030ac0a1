"""Named columns from files: CSV, Parquet, Minari datasets, TensorDicts saved by TorchRL.

A table is one trajectory: a name and columns of equal length. Arrays of several numbers per row
become columns ``observation[0]``, ``observation[1]``, …; entries ``qpos``, ``qvel`` and ``ctrl`` or
``action`` of the model's sizes also get the default names of their joints and actuators; without a
time, rows follow each other at the control step.
"""

from __future__ import annotations

__all__ = ["Table", "dataset_tables", "read_csv", "read_parquet", "tensordict_tables"]

import csv
from collections.abc import Iterator, Mapping
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from ..errors import message
from .columns import default_columns
from .system import System

Array = NDArray[np.float64]


class Table(NamedTuple):
    """One trajectory.

    Attributes:
        name: Of the file, with the number of the episode where there are several.
        columns: By name, shape ``(T,)`` each.
    """

    name: str
    columns: Mapping[str, Array]


def read_csv(path: Path, names: list[str]) -> Table:
    """Return columns of a CSV file with a header row; an empty cell is NaN.

    Raises:
        ValueError: The file is empty or not text in UTF-8, has a column twice, a row with another
            number of cells or a cell that is not a number, or lacks one of ``names``.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except UnicodeDecodeError:
        raise ValueError(message("a CSV file in UTF-8", str(path))) from None
    except csv.Error as error:
        raise ValueError(message(f"a CSV file in {path.name}", str(error))) from None
    if len(rows) < 2:
        raise ValueError(message(f"a header and rows in {path.name}", f"{len(rows)} rows"))
    header = [name.strip() for name in rows[0]]
    twice = sorted({name for name in header if header.count(name) > 1})
    if twice:
        raise ValueError(message(f"each column once in {path.name}", twice[0]))
    _check_names(names, header, path.name)
    for i, row in enumerate(rows[1:]):
        if len(row) != len(header):
            expected = f"{len(header)} cells in row {i} of {path.name}"
            hint = "the file may be cut off: delete the row, or write it anew"
            raise ValueError(message(expected, len(row), hint=hint))
    columns = {name: _numbers(rows[1:], header.index(name), path.name, name) for name in names}
    return Table(path.name, columns)


def _numbers(rows: list[list[str]], column: int, file: str, name: str) -> Array:
    cells = [row[column].strip() or "nan" for row in rows]
    try:
        return np.array(cells, dtype=np.float64)
    except ValueError:
        for i, cell in enumerate(cells):
            try:
                float(cell)
            except ValueError:
                expected = f"a number in row {i}, column {name!r} of {file}"
                raise ValueError(message(expected, cell)) from None
        raise


def read_parquet(path: Path, names: list[str]) -> Table:
    """Return columns of a Parquet file; a missing value is NaN.

    Raises:
        ImportError: pyarrow is not installed.
        ValueError: It is not a Parquet file, or lacks one of ``names``, or one is not of numbers.
    """
    try:
        pyarrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError:
        hint = "pip install torchrl_bayessim[recipes]"
        raise ImportError(message("pyarrow, to read Parquet", "none", hint=hint)) from None
    try:
        _check_names(names, parquet.read_schema(path).names, path.name)
        table = parquet.read_table(path, columns=names)
        columns = {}
        for name in names:
            column = table[name].combine_chunks().cast(pyarrow.float64())
            columns[name] = np.array(column.fill_null(np.nan).to_numpy(zero_copy_only=False))
    except pyarrow.ArrowException as error:
        reason = str(error).splitlines()[0]
        raise ValueError(message(f"numbers in Parquet in {path.name}", reason)) from None
    return Table(path.name, columns)


def dataset_tables(folder: Path, system: System) -> list[Table]:
    """Return the episodes of a Minari dataset, with ``observations``, ``actions`` and ``infos``.

    Raises:
        ImportError: Minari is not installed.
        ValueError: The episodes lack one of the system's columns.
    """
    try:
        minari = import_module("minari")
    except ImportError:
        hint = "pip install torchrl_bayessim[minari]"
        raise ImportError(message("minari, to read its datasets", "none", hint=hint)) from None
    tables = []
    for episode in minari.MinariDataset(folder / "data"):
        steps = len(episode.actions)
        arrays = {"actions": episode.actions}
        for name, entry in ("observations", episode.observations), ("infos", episode.infos or {}):
            arrays |= dict(_leaves(name if not isinstance(entry, Mapping) else "", entry))
        arrays = {k: v[:steps] for k, v in arrays.items()}  # the last state has no action
        arrays["action"] = arrays["actions"]
        tables.append(_table(f"{folder.name}[{episode.id}]", arrays, system))
    return tables


def tensordict_tables(data: TensorDictBase | Path, system: System) -> list[Table]:
    """Return the trajectories of a tensordict of batch size ``(*, T)``, cut where it is ``done``.

    Entries under ``next`` are the next row's, and left out.

    Raises:
        ValueError: There is no batch dimension, the folder holds no tensordict or pickles, or the
            trajectories lack one of the system's columns.
    """
    name = "tensordict"
    if isinstance(data, Path):
        name = data.name
        try:
            data = TensorDict.load_memmap(data, allow_pickle=False)
        except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
            reason = str(error).splitlines()[0][:200]
            expected = f"a tensordict without pickles in {name}"
            raise ValueError(message(expected, reason)) from None
    if not data.ndim:
        raise ValueError(message(f"a tensordict of batch size (*, T) in {name}", "none"))
    if 0 in data.shape:
        return []
    done = data.get(("next", "done"), None)
    rows = data.exclude("next").reshape(-1, data.shape[-1])
    ends = torch.zeros(rows.shape) if done is None else done.reshape(*rows.shape, -1).any(-1)
    tables = []
    for i, row in enumerate(rows.unbind(0)):
        cuts = [0, *(ends[i].nonzero()[:, 0] + 1).tolist(), rows.shape[1]]
        for begin, end in pairwise(cuts):
            if begin < end:
                part = row[begin:end]
                arrays = {
                    ".".join((key,) if isinstance(key, str) else key): part.get(key).numpy()
                    for key in part.keys(include_nested=True, leaves_only=True)
                }
                label = f"{name}[{len(tables)}]"
                tables.append(_table(label, arrays, system))
    return tables


def _leaves(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays of nested mappings, by their names joined with dots."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(f"{name}.{key}" if name else str(key), inner)
    else:
        yield name, np.asarray(value)


def _table(name: str, arrays: Mapping[str, NDArray[Any]], system: System) -> Table:
    columns: dict[str, Array] = {}
    for key, value in arrays.items():
        if not (np.issubdtype(value.dtype, np.number) or value.dtype == bool) or value.ndim < 1:
            continue
        flat = value.reshape(len(value), -1).astype(np.float64)
        columns |= {f"{key}[{i}]": flat[:, i] for i in range(flat.shape[1])}
        if value.ndim == 1 or flat.shape[1] == 1:
            columns[key] = flat[:, 0]
        columns |= _by_joint(key.rpartition(".")[2], flat, system.task.model)
    names, time = system.columns.used(), system.columns.time
    if time is not None and time not in columns:
        length = len(next(iter(arrays.values())))
        columns[time] = system.control_dt * np.arange(length, dtype=np.float64)
    _check_names(names, list(columns), name)
    return Table(name, {key: columns[key] for key in names})


def _by_joint(key: str, flat: Array, model: mujoco.MjModel) -> dict[str, Array]:
    columns = default_columns(model)
    names = {
        "qpos": [n for group in columns.qpos.values() for n in group],
        "qvel": [n for group in columns.qvel.values() for n in group],
        "ctrl": list(columns.ctrl.values()),
        "action": list(columns.ctrl.values()),
    }.get(key, [])
    return dict(zip(names, flat.T, strict=True)) if len(names) == flat.shape[1] else {}


def _check_names(names: list[str], header: list[str], file: str) -> None:
    for name in names:
        if name not in header:
            hint = "name it under columns in system.yaml"
            expected = f"a column of {file}"
            raise ValueError(message(expected, name, available=header, hint=hint))
