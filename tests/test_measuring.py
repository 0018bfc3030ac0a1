"""Every line of a benchmark says what is needed to repeat and to judge it."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

FILE = Path(__file__).parent.parent / "recipes/benchmarks/measuring.py"


@pytest.fixture
def measuring():
    spec = importlib.util.spec_from_file_location("measuring", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_line_has_median_spread_ratios_seed_threads_and_versions(measuring, capsys):
    against = {"other": [1.0, 4.0, 2.0]}
    measuring.report("b", "c", [1.0, 2.0, 6.0], seed=3, threads=2, against=against, n=5)
    line = json.loads(capsys.readouterr().out)
    found = {key: line[key] for key in ("median", "min", "max", "runs", "seed", "threads", "n")}
    assert found == {"median": 2, "min": 1, "max": 6, "runs": 3, "seed": 3, "threads": 2, "n": 5}
    assert line["against"] == {"other": 1.0}  # the median of 1, 0.5 and 3: of ratios, not medians
    assert {
        "python",
        "torchrl-bayessim",
        "tensordict",
        "mujoco",
        "torch",
        "torchrl",
        "numba",
    } <= line["versions"].keys()
    with pytest.raises(TypeError, match="seed"):
        measuring.report("b", "c", [1.0], threads=2)


@pytest.mark.parametrize("given", ["runs=x", "runs=0", "runs=-1", "runs=1.5", "runs="])
def test_options_are_whole_positive_numbers(measuring, given):
    with pytest.raises(SystemExit, match=r"expected runs= a whole number from 1 on, got '"):
        measuring.options([given], runs=7)
    assert measuring.options(["sbi=0"], optional=["sbi"], sbi=10, runs=7) == {"sbi": 0, "runs": 7}


def test_misspelt_options_are_refused():
    """In a process of its own: a benchmark imports its neighbours as scripts do."""
    command = [sys.executable, FILE.parent / "replay.py", "rnus=1"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert "runs" in run.stderr
    assert "got ['rnus']" in run.stderr
