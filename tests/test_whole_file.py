"""A file is the old one or the new one, whoever is killed while writing it."""

import ast
import errno
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest

from torchrl_bayessim.whole_file import replacing, replacing_folder, write_text, write_texts

ENDS = f"import os; os.kill(os.getpid(), {int(signal.SIGKILL)})"
HALF = """
import sys
from torchrl_bayessim.whole_file import replacing
with replacing(sys.argv[1]) as file:
    file.write(b"half")
    file.flush()
    {ends}
"""


@pytest.fixture
def file(tmp_path):
    return tmp_path / "run" / "table.md"


def killed_in_mid_write(file):
    command = [sys.executable, "-W", "ignore", "-c", HALF.format(ends=ENDS), str(file)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL


def test_the_old_content_stays_until_the_new_one_is_whole(file):
    write_text(file, "old θ")
    with replacing(file) as whole:
        whole.write(b"new")
        whole.flush()
        assert file.read_text(encoding="utf-8") == "old θ"
    assert file.read_bytes() == b"new"
    assert list(file.parent.iterdir()) == [file]


def test_an_error_while_writing_leaves_the_old_content_and_nothing_else(file):
    write_text(file, "old")
    with suppress(ZeroDivisionError), replacing(file) as whole:
        whole.write(b"new")
        whole.write(bytes(1 // 0))
    assert file.read_text() == "old"
    assert list(file.parent.iterdir()) == [file]


def test_what_a_killed_writer_left_is_removed_by_the_next(file):
    write_text(file, "old")
    killed_in_mid_write(file)
    (left,) = (path for path in file.parent.iterdir() if path != file)
    assert left.read_bytes() == b"half"
    assert file.read_text() == "old"
    writer = left.name.removeprefix(".table.md.").removesuffix(".tmp")
    machine, ended, token = writer.rsplit(".", 2)
    assert machine
    stay = [f".other.md.{writer}", f".table.md.{machine}.{os.getppid()}.{token}"]
    stay += [f".table.md.elsewhere.{ended}.{token}", f".table.md.{machine}.5.{writer}"]
    stay += [f".table.md.{machine}.{os.getpid()}.{token}", f".table.md.{machine}.{ended}"]
    stay = {left.with_name(f"{name}.tmp") for name in stay}
    for path in stay:
        path.write_text("of another file, machine, or of a writer that runs")
    write_text(file, "new")
    assert file.read_text() == "new"
    assert set(file.parent.iterdir()) == {file, *stay}


def test_writers_of_one_file_in_one_process_do_not_meet(file):
    with replacing(file) as first:
        first.write(b"first")
        with replacing(file) as second:
            second.write(b"second")
        assert file.read_bytes() == b"second"
    assert file.read_bytes() == b"first"
    assert list(file.parent.iterdir()) == [file]


def test_many_threads_write_one_file(file):
    texts = [str(number) * 50_000 for number in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda text: [write_text(file, text) for _ in range(5)], texts))
    assert file.read_text() in texts
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize("links", [True, False])
def test_of_many_writers_of_a_new_file_one_makes_it(links, file, monkeypatch):
    def link(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")  # as Linux says it

    if not links:
        monkeypatch.setattr(os, "link", link)
    refused = []

    def make(text):
        try:
            write_text(file, text, new=True)
        except FileExistsError as error:
            refused.append(str(error))
            return None
        return text

    with ThreadPoolExecutor(8) as pool:
        made = [text for text in pool.map(make, "abcdefgh") if text]
    assert made == [file.read_text()]
    assert len(refused) == 7
    assert all("expected a file that does not exist yet, got '" in text for text in refused)
    assert list(file.parent.iterdir()) == [file]


def test_texts_are_all_written_or_none(file):
    write_texts({file: "old", file.with_name("page"): "old"})
    file.with_name("folder").mkdir()
    with pytest.raises(IsADirectoryError, match=r"a file to write, got '.*folder, which is a"):
        write_texts({file: "new", file.with_name("page"): "new", file.with_name("folder"): "new"})
    assert [path.read_text() for path in (file, file.with_name("page"))] == ["old", "old"]
    assert len(list(file.parent.iterdir())) == 3


@pytest.mark.parametrize("full", ["table.md", "page"])
def test_texts_that_cannot_be_forced_to_disk_leave_all_old_ones(full, file, monkeypatch):
    page = file.with_name("page")
    write_texts({file: "old", page: "old"})

    def fsync(number):
        if f".{full}." in os.readlink(f"/proc/self/fd/{number}"):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(OSError, match="No space left"):
        write_texts({file: "new", page: "new"})
    assert [path.read_text() for path in (file, page)] == ["old", "old"]
    assert set(file.parent.iterdir()) == {file, page}


def test_data_are_forced_to_disk_before_the_rename_and_the_folder_after(file, monkeypatch):
    """Otherwise a power cut leaves an empty file under the new name."""
    done = []
    monkeypatch.setattr(
        os, "fsync", lambda number: done.append(os.readlink(f"/proc/self/fd/{number}"))
    )
    with replacing(file) as whole:
        whole.write(b"new")
        (written,) = file.parent.iterdir()
    assert done == [str(written), str(file.parent)]
    done.clear()
    with replacing_folder(file.with_name("pairs")) as beside:
        (beside / "part").mkdir()
        (beside / "part" / "rows").write_text("new")
    inside = {str(beside / name) for name in ("part", "part/rows")}
    assert set(done[:2]) == inside
    assert done[2:] == [str(beside), str(file.parent)]


def writers(path):
    """Yield the lines of a file that write another one in place."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            modes = [a.value for a in node.args if isinstance(a, ast.Constant)]
            opened = name == "open" and any(set("wax+") & set(str(mode)) for mode in modes)
            method = isinstance(node.func, ast.Attribute) and name in {"write_text", "write_bytes"}
            if opened or method:
                yield node.lineno


def test_nothing_else_in_the_package_or_the_recipes_writes_a_file():
    root = Path(__file__).parent.parent
    parts = [(root / "torchrl_bayessim").rglob("*.py"), (root / "recipes").rglob("*.py")]
    found = {
        f"{path.relative_to(root)}:{line}"
        for part in parts
        for path in part
        if path.parent.name != "benchmarks"
        for line in writers(path)
    }
    # a description of the robot in a temporary folder, read at once by the engine
    found = {line for line in found if not line.startswith("recipes/withheld/plant_bullet.py:")}
    (only,) = found
    assert only.startswith("torchrl_bayessim/whole_file.py:")


HALF_A_FOLDER = """
import sys
from torchrl_bayessim.whole_file import replacing_folder
with replacing_folder(sys.argv[1]) as beside:
    (beside / "file").write_text("half")
    {ends}
"""


def test_a_folder_is_there_when_it_is_whole_and_replaces_none(tmp_path):
    folder = tmp_path / "runs" / "pairs"
    with suppress(ZeroDivisionError), replacing_folder(folder) as beside:
        (beside / "file").write_text(str(1 // 0))
    assert list(folder.parent.iterdir()) == []
    command = [sys.executable, "-W", "ignore", "-c", HALF_A_FOLDER.format(ends=ENDS), str(folder)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    (left,) = folder.parent.iterdir()
    assert left != folder
    with replacing_folder(folder) as beside:
        (beside / "file").write_text("whole")
        assert not folder.exists()
    assert list(folder.parent.iterdir()) == [folder]
    assert (folder / "file").read_text() == "whole"
    link = folder.with_name("link")
    link.symlink_to("nowhere")
    for taken in (folder, link):
        refused = pytest.raises(FileExistsError, match="a folder that does not exist yet")
        with refused, replacing_folder(taken):
            pass
    assert (folder / "file").read_text() == "whole"
