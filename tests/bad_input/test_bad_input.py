"""Hundreds of malformed logs and systems: each ends in one clear message and status 2.

Logs that are odd but honest end in a report with an alarm. Nothing ends in a traceback, or with a
file written over.
"""

import io
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stderr

import description_cases
import file_cases
import model_cases
import number_cases
import odd_cases
import pytest
import text_cases
from case import Case, one, text, write_logs
from one_joint_arm import FEW, RECIPES, describe, diagnose

MODULES = (text_cases, number_cases, file_cases, description_cases, model_cases)
CASES = [case for module in MODULES for case in module.CASES]
KINDS = {case.kind: case for case in CASES if case.found}  # one of each
EARLIER = {"report.html": "<p>earlier</p>", "report.json": "{}", "result.json": "{}",
           "settings.json": "{}", "notes.txt": "mine"}  # fmt: skip


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Return a folder that can be diagnosed, with an earlier report."""
    folder = tmp_path_factory.mktemp("good") / "robot"
    folder.mkdir()
    describe(folder)
    write_logs(folder)
    (folder / "report").mkdir()
    for name, content in EARLIER.items():
        (folder / "report" / name).write_text(content)
    return folder


@pytest.fixture
def spoilt(good, tmp_path, monkeypatch):
    """Return what makes a spoilt folder, beside files that it must not reach."""
    (tmp_path / "secret.xml").write_text(model_cases.SECRET)
    folder = tmp_path / "robot"
    shutil.copytree(good, folder)
    monkeypatch.chdir(folder)

    def spoil(case):
        case.spoil(folder)
        return folder

    return spoil


def contents(folder):
    """Return what every file and link under a folder holds."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = os.readlink(path)
        else:
            found[name] = path.read_bytes() if path.is_file() else ""
    return found


def unique(cases):
    names = [case.name for case in cases]
    return len(set(names)) == len(names)


def test_there_are_hundreds_and_each_has_one_expectation():
    assert len(CASES) >= 200
    assert unique([*CASES, *odd_cases.CASES])
    assert all(bool(case.said) != bool(case.found) for case in CASES)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_what_cannot_be_used_ends_in_one_message(case: Case, spoilt):
    folder = spoilt(case)
    before = contents(folder.parent)
    with redirect_stderr(io.StringIO()) as errors, pytest.raises(SystemExit) as ended:
        diagnose(folder, *case.arguments)
    assert ended.value.code == 2
    (line,) = errors.getvalue().splitlines()
    assert line.startswith("diagnose: expected")
    assert case.said in line
    for file, _, kind in (expected.rpartition(" ") for expected in case.found):
        assert line.startswith("diagnose: expected logs that can be used")
        assert re.search(rf"{re.escape(file)}.*\({kind}[;)]", line)
    assert len(line) < 1500
    assert contents(folder.parent) == before


LEAVE_OUT = "spoilt=leave_out"


@pytest.mark.parametrize(
    ("case", "more"),
    [*((case, ()) for case in odd_cases.CASES), *((case, (LEAVE_OUT,)) for case in KINDS.values())],
    ids=lambda given: given.name if isinstance(given, Case) else "".join(given),
)
def test_what_can_be_used_is_named_by_the_gate(case: Case, more, spoilt):
    folder = spoilt(case)
    before = contents(folder)
    printed = diagnose(folder, *case.arguments, *more, "out=new")
    for expected in case.found:
        file, _, kind = expected.rpartition(" ")
        place = rf"{re.escape(file)} rows \d+ to \d+: " if file else ""
        assert re.search(rf"^(error|warning): {place}.*\({kind}\)$", printed, re.M), printed
    report = json.loads((folder / "new/report.json").read_text())
    assert any(f"({case.kind})" in alarm for alarm in report["alarms"])
    assert not report["verdict"].startswith("named")  # nothing is wrong with the simulator
    shutil.rmtree(folder / "new")
    assert contents(folder) == before


def test_the_pickles_would_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickle.loads(pickle.dumps(file_cases.Payload()))
    assert (tmp_path / file_cases.MARKER).exists()


@pytest.mark.parametrize(
    "change",
    [
        text(lambda log: "\ufeff" + log),
        text(lambda log: log.replace("\r\n", "\r")),
        text(lambda log: log.replace(",", " , ")),
        text(lambda log: log.replace("\r\n", "\r\n\r\n")),
        text(lambda log: log.replace("\r\n", ",\r\n")),
        lambda folder: one(folder).rename(one(folder).with_suffix(".CSV")),
        lambda folder: (one(folder).rename(folder / "a"), one(folder).symlink_to("../a")),
    ],
    ids=["BOM", "CR", "spaces", "empty lines", "an empty column", "upper case", "a link"],
)
def test_what_is_unusual_is_taken_without_a_word(change, spoilt):
    folder = spoilt(Case(name="unusual", spoil=change))
    printed = diagnose(folder, "out=new")
    assert printed.startswith("The page is")
    assert json.loads((folder / "new/report.json").read_text())["verdict"] == "none"


SOME = {"YAML tag apply": [pytest.mark.slow], "a pipe": []}


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=SOME[c.name], id=c.name) for c in CASES if c.name in SOME],
)
def test_the_same_from_a_shell(case: Case, spoilt):
    folder = spoilt(case)
    before = contents(folder.parent)
    given = ["system=robot.yaml", "data=logs", "out=report", *FEW, *case.arguments]
    command = [sys.executable, str(RECIPES / "diagnose.py"), *given]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert line.startswith("diagnose: expected")
    assert case.said in line
    assert contents(folder.parent) == before
