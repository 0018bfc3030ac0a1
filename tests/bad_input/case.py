"""One malformed input: how it is made from a good one, and how the diagnosis must answer."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from one_joint_arm import motion, save

RUNS, ROWS = 4, 160


@dataclass(frozen=True, kw_only=True)
class Case:
    """A folder with robot.xml, robot.yaml and logs/run0.csv to run3.csv, and what spoils it.

    Exactly one of `said` and `found` is given.

    Attributes:
        name: Of the test.
        spoil: Spoils the folder.
        said: Part of the one message with which the diagnosis refuses it.
        found: What the sanity gate says, as ``"kind"`` (of all logs) or ``"run2.csv kind"``.
        arguments: Of the command line.
    """

    name: str
    spoil: Callable[[Path], object] = lambda _: None
    said: str = ""
    found: tuple[str, ...] = ()
    arguments: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """The kind of what is found."""
        return self.found[-1].rpartition(" ")[2] if self.found else ""


@cache
def rows(run):
    """Return a run's rows t, q, qd, tau."""
    return tuple(tuple(row) for row in motion(run, rows=ROWS))


def write_logs(folder):
    for run in range(RUNS):
        save(folder / f"logs/run{run}.csv", rows(run))


def one(folder):
    """Return the log that is spoilt where only one is."""
    return folder / "logs/run2.csv"


def all_of(folder):
    return sorted((folder / "logs").iterdir())


def put(data, *, file="logs/run2.csv"):
    """Return what writes bytes or text into a file."""
    return lambda folder: (folder / file).write_bytes(
        data if isinstance(data, bytes) else data.encode()
    )


def text(change, *, everywhere=False):
    """Return what changes a log's text, or all of them."""

    def spoil(folder):
        for path in all_of(folder) if everywhere else [one(folder)]:
            changed = change(path.read_bytes().decode())
            path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())

    return spoil


def swap(old, new, *, file="robot.yaml", count=-1):
    """Return what replaces a part of a file that must be there."""

    def spoil(folder):
        before = (folder / file).read_text()
        assert old in before, old
        (folder / file).write_text(before.replace(old, new, count))

    return spoil
