"""The command that tests the declared versions: what it pins, and that nothing is left out."""

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture
def versions(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "recipes/benchmarks")
    import versions

    return versions


def test_low_pins_every_lower_bound_and_high_none(versions):
    pins = list(versions.constraints("low", {"torch": "2.13.0"}))
    assert pins[-1] == "torch==2.13.0"
    names = [versions.package(line) for line in pins]
    asked = versions.requirements(*versions.EXTRAS)
    assert sorted(names) == sorted({versions.package(line) for line in asked})
    for line in asked:
        lower = line.split(",")[0].replace(">=", "==").replace("[hdf5]", "")
        assert lower in pins or line.startswith("torch>")
    assert list(versions.constraints("high", {})) == []


def test_without_arguments_torch_is_taken_at_both_of_its_ends(versions):
    (torch,) = [line for line in versions.PROJECT["dependencies"] if line.startswith("torch>")]
    lower, _ = re.findall(r"[\d.]+", torch)
    assert f"torch=={lower}" in versions.constraints("low", {})
    assert not any(pin.startswith("torch=") for pin in versions.constraints("high", {}))
    assert {"low", "high"} <= versions.ENVIRONMENTS.keys()


def test_every_extra_has_its_environment_and_every_test_exists(versions):
    assert set(versions.EXTRAS) - {"test"} <= versions.ENVIRONMENTS.keys()
    for extras, _, tests in versions.ENVIRONMENTS.values():
        assert set(filter(None, extras.split(","))) <= versions.EXTRAS.keys()
        assert all((ROOT / test.removeprefix("--ignore=")).exists() for test in tests.split())


def test_an_unknown_environment_is_refused(versions):
    with pytest.raises(SystemExit, match=r"expected environments \['low'.*got \['lwo'\]"):
        versions.main("lwo")


def test_a_step_that_fails_says_how(versions, tmp_path):
    steps = {
        "install": [sys.executable, "-c", "print('done')"],
        "import": [sys.executable, "-c", "import no_such_module"],
    }
    found = versions.run(steps, tmp_path)
    assert found["failed"] == "import"
    assert found["said"][-1] == "ModuleNotFoundError: No module named 'no_such_module'"
    assert versions.run({"tests": steps["install"]}, tmp_path)["tests"] == "done"
