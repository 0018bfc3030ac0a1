"""Logs from wherever they are kept: a folder or files, in the formats of `tables`."""

from __future__ import annotations

__all__ = ["read_logs", "read_records"]

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tensordict import TensorDictBase

from ..errors import message, printable
from ..kinds import check_kind
from .log import Log
from .record import Record, record_of
from .resampling import resample
from .system import System
from .tables import Table, dataset_tables, read_csv, read_parquet, tensordict_tables

Source = str | Path | Sequence[str | Path] | TensorDictBase
_READERS = {".csv": read_csv, ".parquet": read_parquet}
_PACKED = {".gz", ".zip", ".xz", ".bz2", ".zst", ".7z", ".tar"}
_TEXT = {".txt", ".tsv", ".dat", ".log"}


def read_records(source: Source, system: System) -> list[Record]:
    """Return trajectories as they were logged.

    Args:
        source: A folder with CSV or Parquet files, a Minari dataset's folder, the folder of a
            TensorDict saved by TorchRL, a list of files, or a tensordict of batch size ``(*, T)``.
        system: The robot; its columns say what is read.

    Raises:
        TypeError: The source or the system is of another kind.
        ValueError: There is no log, a file is malformed, or a column is missing.
        ImportError: The format needs a package that is not installed.
    """
    check_kind("a System", system, System)
    if isinstance(source, TensorDictBase):
        tables = tensordict_tables(source, system)
    elif isinstance(source, str | Path):
        tables = _tables(Path(source), system)
    else:
        expected = "a folder, a list of files or a TensorDict of logs"
        check_kind(expected, source, list, tuple)
        for path in source:
            check_kind(expected, path, str, Path)
        tables = _files([Path(path) for path in source], system)
    if not tables:
        raise ValueError(message("at least one log", "none"))
    return [record_of(table, system) for table in tables]


def read_logs(source: Source, system: System) -> list[Log]:
    """Return trajectories at the system's control step; for the arguments see `read_records`.

    Rows that are not finite are left out, and gaps split a trajectory. Nothing else is checked:
    that is for `sanity`.

    Example:
        >>> from torchrl_bayessim.envs.tasks.catalogue import known_task
        >>> from tensordict import TensorDict
        >>> system = System(task=known_task("InvertedPendulum-v5"))
        >>> state = {"qpos": torch.zeros(8, 2), "qvel": torch.zeros(8, 2)}
        >>> data = TensorDict({**state, "action": torch.zeros(8, 1)}, batch_size=[8])
        >>> read_logs(data, system)[0].qpos.shape
        torch.Size([8, 2])

    Raises:
        ValueError: A time does not increase, a file has no usable rows, or as `read_records`.
        ImportError: As `read_records`.
    """
    return [log for record in read_records(source, system) for log in resample(record, system)]


def _tables(path: Path, system: System) -> list[Table]:
    try:
        kind = "file" if path.is_file() else "folder" if path.is_dir() else ""
    except OSError as error:
        got = f"{str(path)[:200]}: {error.strerror}"
        raise ValueError(message("a folder or file of logs", got)) from None
    if kind == "file":
        return [_file_table(path, system)]
    if not kind:
        raise ValueError(message("a folder or file of logs", str(path)))
    if (path / "data" / "metadata.json").is_file():
        return dataset_tables(path, system)
    # hidden ones are an editor's or a system's, such as ._run0.csv beside run0.csv
    shown = (file for file in path.iterdir() if not file.name.startswith("."))
    files = sorted(file for file in shown if file.suffix.lower() in _READERS)
    if files:
        return [_file_table(file, system) for file in files]
    if (path / "meta.json").is_file():
        return tensordict_tables(path, system)
    expected = "a folder with CSV or Parquet files, a Minari dataset or a saved TensorDict"
    shown = (file for file in path.iterdir() if not file.name.startswith("."))
    others = sorted((f for f in shown if f.is_file()), key=lambda f: (_kind(f), f.name))
    hint = _conversion(others[0]) if others else ""
    raise ValueError(message(expected, str(path), available=[o.name for o in others], hint=hint))


def _files(paths: Sequence[Path], system: System) -> list[Table]:
    """Return the tables of files; those of one name in several folders are named with these."""
    places = Counter(path.resolve() for path in paths)
    twice = [str(path) for path, count in places.items() if count > 1]
    if twice:
        raise ValueError(message("each file once", f"{twice[0]} twice"))
    names = Counter(path.name for path in paths)
    return [
        table if names[path.name] == 1 else table._replace(name=str(path))
        for path, table in ((path, _file_table(path, system)) for path in paths)
    ]


def _file_table(path: Path, system: System) -> Table:
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        hint = "" if path.is_dir() else _conversion(path)
        raise ValueError(message("a .csv or .parquet file", str(path), hint=hint))
    if not path.is_file():
        raise ValueError(message("a file that exists", str(path)))
    if not path.name.isprintable():  # findings name it, a line each
        raise ValueError(message("a file name of printable letters", path.name))
    return reader(path, system.columns.used())


def _kind(path: Path) -> int:
    """Return 0 for what is packed, 1 for what is neither packed nor text, 2 for text."""
    suffix = path.suffix.lower()
    return 0 if suffix in _PACKED else 2 if suffix in _TEXT else 1


def _conversion(path: Path) -> str:
    """Return how a file of another kind becomes one that can be read."""
    suffix, name, stem = (printable(part) for part in (path.suffix.lower(), path.name, path.stem))
    if suffix in _PACKED:
        return f"unpack {name} first"
    if suffix in _TEXT:
        return f"separate the cells of {name} by commas and call it {stem}.csv"
    return "write columns with a header, as pandas' DataFrame.to_csv(path, index=False) does"
