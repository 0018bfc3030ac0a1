"""Files that are whole at every moment: written beside the target, forced to disk, renamed.

Whoever reads the target sees the old content or the new one, also after a kill or a power cut.
"""

from __future__ import annotations

__all__ = ["replacing", "replacing_folder", "write_text", "write_texts"]

import os
import platform
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import BinaryIO

from .errors import message


def _machine() -> str:
    """Return a name of where process numbers are unique: a host, or a container on it."""
    numbers = ""
    with suppress(OSError):  # Linux only
        numbers = "-" + os.readlink("/proc/self/ns/pid").strip("pid:[]")
    return (platform.node().replace(os.sep, "-") or "unnamed") + numbers


# On a shared file system others write too, whose processes have numbers of their own
_MACHINE = _machine()


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file that takes the place of ``path`` when the block ends without an error.

    Missing folders are made. What a writer of the same file on this machine left when it was killed
    is removed.

    Args:
        path: The file; replaced if it exists.

    Raises:
        OSError: It cannot be written; what was there before stays.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "numbers.bin"
        >>> with replacing(file) as whole:
        ...     _ = whole.write(b"half")
        ...     file.exists()
        False
        >>> file.read_bytes()
        b'half'
    """
    with _replacing([Path(path)]) as (file,):
        yield file


def write_text(path: str | os.PathLike[str], text: str, *, new: bool = False) -> None:
    """Write ``text`` to ``path`` in UTF-8, wholly or not at all.

    Args:
        path: The file; replaced if it exists.
        text: What it is to hold.
        new: Replace nothing: of several writers at once, one makes the file.

    Raises:
        FileExistsError: With ``new``, there is such a file.
        OSError: It cannot be written; what was there before stays.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "table.md"
        >>> write_text(file, "| θ |")
        >>> file.read_text(encoding="utf-8")
        '| θ |'
    """
    with _replacing([Path(path)], _name if new else os.replace) as (file,):
        file.write(text.encode())


def write_texts(texts: Mapping[Path, str]) -> None:
    """Write texts to their files in UTF-8: none takes its place before all are on disk.

    A kill between the renames leaves the first ones new and the others old, each of them whole.

    Raises:
        OSError: One cannot be written; what was there before stays, of the others too.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> (folder / "page.html").mkdir()
        >>> write_texts({folder / "page.json": "{}", folder / "page.html": "<p>"})
        Traceback (most recent call last):
        IsADirectoryError: expected a file to write, got '.../page.html, which is a folder'.
        >>> [path.name for path in folder.iterdir()]
        ['page.html']
    """
    with _replacing(list(texts)) as files:
        for file, text in zip(files, texts.values(), strict=True):
            file.write(text.encode())


@contextmanager
def replacing_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Make a folder beside ``path`` that becomes it when the block ends without an error.

    Args:
        path: The folder, which must not exist. What is left of a killed writer on this machine is
            removed.

    Raises:
        FileExistsError: There is such a folder, or file.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp()) / "pairs"
        >>> with replacing_folder(folder) as beside:
        ...     _ = (beside / "half").write_text("")
        ...     folder.exists()
        False
        >>> [file.name for file in folder.iterdir()]
        ['half']
    """
    path = Path(path).absolute()
    if os.path.lexists(path):  # a link to nothing too
        hint = "another folder; what is there is not written over"
        raise FileExistsError(message("a folder that does not exist yet", str(path), hint=hint))
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep(path)
    temporary = _beside(path)
    temporary.mkdir()
    try:
        yield temporary
        for file in temporary.rglob("*"):
            (_sync_folder if file.is_dir() else _sync)(file)
        _sync_folder(temporary)
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    _sync_folder(path.parent)


@contextmanager
def _replacing(
    paths: list[Path], rename: Callable[[Path, Path], None] = os.replace
) -> Iterator[list[BinaryIO]]:
    """Open files that take the places of ``paths``, in this order, when all are on disk."""
    paths = [path.absolute() for path in paths]
    for path in paths:
        if path.is_dir():  # said before anything is written
            raise IsADirectoryError(message("a file to write", f"{path}, which is a folder"))
    with ExitStack() as left:
        temporaries: list[Path] = []
        with ExitStack() as opened:
            files: list[BinaryIO] = []
            for path in paths:
                path.parent.mkdir(parents=True, exist_ok=True)
                _sweep(path)
                temporaries.append(_beside(path))
                left.callback(temporaries[-1].unlink, missing_ok=True)
                files.append(opened.enter_context(temporaries[-1].open("xb")))
            yield files
            for file in files:
                file.flush()
                os.fsync(file.fileno())
        for temporary, path in zip(temporaries, paths, strict=True):
            rename(temporary, path)
    for folder in {path.parent for path in paths}:
        _sync_folder(folder)


def _name(temporary: Path, path: Path) -> None:
    """Give a file its name, which a rename would take from another."""
    try:
        try:
            os.link(temporary, path)
        except FileExistsError:
            raise
        except OSError:  # a file system without links: alone too, but empty for a moment
            path.touch(exist_ok=False)
            temporary.replace(path)
    except FileExistsError:
        raise FileExistsError(message("a file that does not exist yet", str(path))) from None


def _beside(path: Path) -> Path:
    """Return where this process writes what is to become ``path``, each time another place."""
    return path.with_name(f".{path.name}.{_MACHINE}.{os.getpid()}.{secrets.token_hex(4)}.tmp")


def _sync(file: Path) -> None:
    """Force a file to disk that others have written."""
    with file.open("rb") as written:
        os.fsync(written.fileno())


def _sweep(path: Path) -> None:
    """Remove what killed writers of ``path`` on this machine left beside it."""
    for left in path.parent.glob(f".{escape(path.name)}.{escape(_MACHINE)}.*.tmp"):
        writer, _, rest = left.name.removeprefix(f".{path.name}.{_MACHINE}.").partition(".")
        if rest.count(".") == 1 and _ended(writer):
            if left.is_dir():
                shutil.rmtree(left)
            else:
                left.unlink(missing_ok=True)


def _ended(process: str) -> bool:
    if os.name != "posix" or not process.isdecimal():  # elsewhere signal 0 is not a question
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return True
    except (PermissionError, OverflowError):
        return False
    return False


def _sync_folder(folder: Path) -> None:
    """Force the rename itself to disk, where the system lets folders be opened."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
