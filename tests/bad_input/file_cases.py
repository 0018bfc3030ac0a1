"""Logs that are no files, other files than their names say, or programs in disguise."""

import io
import json
import os
import pickle
import shutil
import socket
import sqlite3
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import torch
from case import RUNS, Case, all_of, one, put, rows, write_logs
from tensordict import TensorDict

MARKER = "executed"  # what a pickle writes when it is loaded
NAMES = ("t", "q", "qd", "tau")


class Payload:
    """Writes the marker into the current folder when it is unpickled."""

    def __reduce__(self):
        return Path.touch, (Path(MARKER),)


def columns(run, **others):
    return dict(zip(NAMES, np.array(rows(run)).T.copy(), strict=True)) | others


def parquet(path, **others):
    pyarrow.parquet.write_table(pyarrow.table(columns(2, **others)), path)


def in_place_of_one(name, make):
    """Return what puts another file, or a thing that is no file, where a log was."""

    def spoil(folder):
        one(folder).unlink()
        make(folder / "logs" / name)

    return spoil


def in_place_of_all(name, make):
    def spoil(folder):
        shutil.rmtree(folder / "logs")
        (folder / "logs").mkdir()
        make(folder / "logs" / name)

    return spoil


def no_files():
    """Put things that cannot be read in place of a log."""
    things = {
        "a folder": Path.mkdir,
        "a dangling link": lambda p: p.symlink_to("nowhere.csv"),
        "a link to itself": lambda p: p.symlink_to(p.name),
        "a link to a folder": lambda p: p.symlink_to("."),
        "a pipe": os.mkfifo,
        "a socket": _socket,
        "a device": lambda p: p.symlink_to("/dev/zero"),
    }
    for name, make in things.items():
        said = "a file that exists, got 'logs/run2.csv'"
        yield Case(name=name, spoil=in_place_of_one("run2.csv", make), said=said)
        if name != "a folder":
            spoil = in_place_of_all("run2.parquet", make)
            yield Case(name=f"{name} as Parquet", spoil=spoil, said="a file that exists")
    for name in "run2.csv", "run2.parquet":
        spoil = in_place_of_one(name, lambda p: p.symlink_to("/proc/self/mem"))
        yield Case(name=f"unreadable {name}", spoil=spoil, said=name)
    for name in b"run\xff.csv", b"run\n2.csv", b"run\x1b[31m.csv":
        spoil = in_place_of_one(os.fsdecode(name), lambda p: p.write_text("t,q,qd,tau\n"))
        yield Case(name=f"a file named {name}", spoil=spoil, said="a file name of printable")
    said = "a folder with CSV or Parquet files"
    yield Case(name="no logs", spoil=lambda f: [p.unlink() for p in all_of(f)], said=said)
    others = in_place_of_all("run.txt", lambda p: p.write_text("t,q,qd,tau\n"))
    yield Case(name="other files only", spoil=others, said=said)
    nothing = lambda f: shutil.rmtree(f / "logs")
    yield Case(name="no folder", spoil=nothing, said="a folder or file of logs")
    link = lambda f: (nothing(f), (f / "logs").symlink_to("nowhere"))
    yield Case(name="a dangling link to a folder", spoil=link, said="a folder or file of logs")
    file = lambda f: (nothing(f), (f / "logs").write_text("t,q,qd,tau\n"))
    yield Case(name="a file without a suffix", spoil=file, said=".csv or .parquet file")


def _socket(path):
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(path))


def parquets():
    """Spoil Parquet files."""

    def spoilt(name, said, make):
        return Case(name=name, spoil=in_place_of_one("run2.parquet", make), said=said)

    def cut(path, count):
        parquet(path)
        path.write_bytes(path.read_bytes()[:count])

    for count in 0, 1, 4, 8, 100, 1000, 4000, -1, -4, -8, -100:
        name, said = f"Parquet cut at {count}", "Parquet in run2.parquet"
        yield spoilt(name, said, lambda p, count=count: cut(p, count))
    csv = "t,q,qd,tau\n0,0,0,0\n"
    yield spoilt("CSV as Parquet", "Parquet in run2.parquet", lambda p: p.write_text(csv))
    yield Case(name="Parquet as CSV", spoil=lambda f: parquet(one(f)), said="UTF-8")
    yield spoilt("bytes changed", "run2.parquet", _garbled)
    yield spoilt("a name that is no text", "numbers in Parquet in run2.parquet", _misnamed)
    words = ["fast"] * len(rows(2))
    others = {
        "words": (words, "numbers in Parquet in run2.parquet"),
        "lists": ([[1.0, 2.0]] * len(words), "numbers in Parquet in run2.parquet"),
        "maps": ([{"x": 1.0}] * len(words), "numbers in Parquet in run2.parquet"),
        "bytes": ([b"\x00\xff"] * len(words), "numbers in Parquet in run2.parquet"),
        "dates": (np.array([0] * len(words), "datetime64[ns]"), "Try: seconds, as numbers"),
        "truths": ([True] * len(words), "numbers in column 'q' of run2.parquet, got 'booleans'"),
    }
    for name, (value, said) in others.items():
        yield spoilt(f"Parquet of {name}", said, lambda p, value=value: parquet(p, q=value))
    for name in NAMES:
        said = f"a column of run2.parquet, got {name!r}"
        yield spoilt(f"Parquet without {name}", said, lambda p, name=name: _without(p, name))
    yield spoilt("Parquet without rows", "rows in run2.parquet", _empty)
    yield spoilt("Parquet with a column twice", "each column once in run2.parquet", _twice)
    yield spoilt("100 million rows in little Parquet", "rows of 4 columns in run2.parquet", _bomb)
    empty = in_place_of_one("run2.parquet", lambda p: parquet(p, q=[None] * len(words)))
    yield Case(name="Parquet of nothing", spoil=empty, found=("run2.parquet short",))


def _garbled(path):
    parquet(path)
    data = bytearray(path.read_bytes())
    data[100:1100] = bytes(1000)
    path.write_bytes(data)


def _misnamed(path):
    parquet(path)
    path.write_bytes(path.read_bytes().replace(b"tau", b"\xe9au"))


def _without(path, name):
    table = columns(2)
    del table[name]
    pyarrow.parquet.write_table(pyarrow.table(table), path)


def _empty(path):
    table = {name: np.zeros(0) for name in NAMES}
    pyarrow.parquet.write_table(pyarrow.table(table), path)


def _twice(path):
    arrays = [*columns(2).values(), columns(1)["q"]]
    pyarrow.parquet.write_table(pyarrow.table(arrays, [*NAMES, "q"]), path)


def _bomb(path):
    """Write 110 million rows of one value."""
    group = pyarrow.table({"q": np.zeros(10_000_000, dtype=np.int8)})
    with pyarrow.parquet.ParquetWriter(path, group.schema, compression="zstd") as writer:
        for _ in range(11):
            writer.write_table(group)


def pickles():
    """Put programs where numbers should be: none may run."""
    raw = pickle.dumps(Payload())
    for protocol in 0, 2, 5:
        name = f"a pickle of protocol {protocol} as CSV"
        yield Case(name=name, spoil=put(pickle.dumps(Payload(), protocol)), said="run2.csv")
    spoil = in_place_of_one("run2.parquet", lambda p: p.write_bytes(raw))
    yield Case(name="a pickle as Parquet", spoil=spoil, said="Parquet in run2.parquet")
    for suffix in "pt", "pkl", "npy", "npz", "pickle", "joblib", "h5":
        arguments = (f"data=logs/run.{suffix}",)
        spoil = in_place_of_all(f"run.{suffix}", lambda p: p.write_bytes(raw))
        said = "a .csv or .parquet file"
        yield Case(name=f"a pickle as {suffix}", spoil=spoil, said=said, arguments=arguments)
        said = "a folder with CSV or Parquet files"
        yield Case(name=f"a folder with a pickle as {suffix}", spoil=spoil, said=said)
    torch_file = in_place_of_all("run.csv", lambda p: torch.save({"a": Payload()}, p))
    yield Case(name="torch.save as CSV", spoil=torch_file, said="run.csv")
    numpy_file = lambda p: p.write_bytes(_saved(np.array([Payload()])))
    yield Case(name="numpy.save as CSV", spoil=in_place_of_all("a.csv", numpy_file), said="a.csv")
    yield Case(name="a database as CSV", spoil=in_place_of_all("a.csv", _database), said="a.csv")
    extension = in_place_of_one("run2.parquet", _extension)
    yield Case(name="a pickled type in Parquet", spoil=extension, said="numbers in Parquet")
    yield Case(name="a pickle as robot.yaml", spoil=put(raw, file="robot.yaml"), said="UTF-8")
    yield Case(name="a pickle as robot.xml", spoil=put(raw, file="robot.xml"), said="XML in")


def _saved(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def _database(path):
    with sqlite3.connect(path) as database:
        database.execute("create table a (b)")
    database.close()


def _extension(path):
    """Write the extension type whose metadata old versions of Arrow unpickled."""
    key = {b"ARROW:extension:name": b"arrow.py_extension_type"}
    key[b"ARROW:extension:metadata"] = pickle.dumps(Payload())
    table = pyarrow.table(columns(2, q=[b"x"] * len(rows(2))))
    place = table.schema.get_field_index("q")
    schema = table.schema.set(place, table.schema.field("q").with_metadata(key))
    pyarrow.parquet.write_table(table.cast(schema), path)


def tensordicts():
    """Spoil the folder of a saved TensorDict."""

    def spoilt(name, change, said="a tensordict without pickles in logs"):
        def spoil(folder):
            shutil.rmtree(folder / "logs")
            arrays = [columns(run) for run in range(RUNS)]
            stacked = {k: torch.tensor(np.stack([a[k] for a in arrays])) for k in NAMES}
            data = TensorDict(stacked, batch_size=[RUNS, len(rows(0))])
            data.memmap(folder / "logs")
            change(folder / "logs")

        return Case(name=f"TensorDict {name}", spoil=spoil, said=said)

    def meta(edit):
        def change(folder):
            path = folder / "meta.json"
            content = json.loads(path.read_text())
            path.write_text(json.dumps(edit(content) or content))

        return change

    actions = torch.ones(RUNS, len(rows(0)), dtype=torch.bool)
    yield spoilt(
        "of truths",
        lambda f: TensorDict.load_memmap(f).clone().set("tau", actions).memmap(f),
        "numbers in column 'tau' of logs[0], got 'booleans'",
    )
    yield spoilt("cut", lambda f: os.truncate(f / "q.memmap", 1000))
    linked = lambda f: ((f / "q.memmap").rename(f / "r"), (f / "q.memmap").symlink_to("r"))
    yield spoilt("with a link", linked)
    nameless = lambda m: m.update({"": {"shape": [4, 160], "dtype": "torch.float64"}})
    yield spoilt(
        "with a short nameless entry",
        lambda f: ((f / ".memmap").write_bytes(b"short"), meta(nameless)(f)),
    )
    yield spoilt("emptied", lambda f: os.truncate(f / "q.memmap", 0))
    yield spoilt("without a column", lambda f: (f / "q.memmap").unlink(), "got 'q'")
    yield spoilt("with a pipe", lambda f: ((f / "q.memmap").unlink(), os.mkfifo(f / "q.memmap")))
    for count in 0, 1, 40, 100:
        name = f"whose meta.json is cut at {count}"
        yield spoilt(name, lambda f, count=count: os.truncate(f / "meta.json", count))
    edits = {
        "of huge shape": lambda m: m["q"].update(shape=[4, 10**12]),
        "of overflowing shape": lambda m: m["q"].update(shape=[2**62, 2**62]),
        "of negative shape": lambda m: m["q"].update(shape=[-1, 160]),
        "of a shape in words": lambda m: m["q"].update(shape="many"),
        "of nested shape": lambda m: m["q"].update(is_nested=True),
        "of unknown numbers": lambda m: m["q"].update(dtype="torch.quaternion"),
        "of wider numbers": lambda m: m["q"].update(dtype="torch.complex128"),
        "of an unknown type": lambda m: m.update(_type="<class 'os.system'>"),
        "of another batch": lambda m: m.update(shape=[3, 7]),
        "of a huge batch": lambda m: m.update(shape=[4, 10**12]),
        "as a list": lambda m: [m],
        "as text": lambda m: "x",
    }
    for name, edit in edits.items():
        yield spoilt(name, meta(edit), "in logs")
    leaving = lambda m: m.update({"../secret": m.pop("q")})
    yield spoilt("that leaves its folder", meta(leaving), "got 'q'")
    deep = lambda f: (f / "meta.json").write_text("[" * 100_000)
    yield spoilt("of deep nesting", deep)
    pickled = lambda f: (f / "other.pickle").write_bytes(pickle.dumps(Payload()))
    sidecar = meta(lambda m: m.update({"_type": "<class 'tensordict.tensorclass.NonTensorData'>"}))
    yield spoilt("with a pickle", lambda f: (pickled(f), sidecar(f)), "in logs")


CASES = [*no_files(), *parquets(), *pickles(), *tensordicts()]
__all__ = ["CASES", "MARKER", "write_logs"]
