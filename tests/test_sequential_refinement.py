"""Rounds against one round, as the recipe runs them."""

import json
import re
import shutil
from pathlib import Path

import pytest
from command_line import run_here

RECIPE = Path(__file__).parent.parent / "recipes" / "sequential_refinement.py"


@pytest.mark.slow
def test_both_ways_tell_more_with_more_simulations_and_parts_are_kept(
    tmp_path, same_numbers, monkeypatch, capsys
):
    run_here(monkeypatch, RECIPE, "Refinement", "short=true", f"out={tmp_path / 'run'}")
    out = capsys.readouterr().out
    result = json.loads((tmp_path / "run/result.json").read_text())
    assert json.loads(out.splitlines()[-1].removeprefix("RESULT ")) == result
    found = result["problems"]["pendulum"]
    assert found["simulations"] == [100, 200]
    for rows in found["nats"].values():
        assert len(rows) == 2
        assert all(len(row) == 2 for row in rows)
    assert found["mean"]["one round"][-1]["mean"] > 0.5
    assert found["mean"]["sequential"][-1]["mean"] > found["mean"]["sequential"][0]["mean"] - 0.5
    gained = [b[-1] - a[-1] for a, b in zip(*found["nats"].values(), strict=True)]
    assert found["gain"]["values"] == pytest.approx(gained)
    assert (tmp_path / "run/nats_pendulum.png").stat().st_size > 5000
    assert "| simulations | one round | sequential |" in (tmp_path / "run/table.md").read_text()
    parts = sorted((tmp_path / "run/parts").iterdir())
    assert len(parts) == 3
    shutil.copytree(tmp_path / "run", tmp_path / "again")
    (tmp_path / "again/parts" / parts[0].name).unlink()  # which is run again, to the same numbers
    run_here(monkeypatch, RECIPE, "Refinement", "short=true", f"out={tmp_path / 'again'}")
    same_numbers(tmp_path / "run", tmp_path / "again")


@pytest.fixture
def refusal(monkeypatch, tmp_path, capsys):
    """Return what turns an argument into what is said of it."""
    monkeypatch.chdir(tmp_path)

    def refusal(given):
        with pytest.raises(SystemExit, match="2"):
            run_here(monkeypatch, RECIPE, "Refinement", given)
        return capsys.readouterr().err

    return refusal


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("truths=1", "expected truths=2 or more, for an interval, got 1"),
        ("rounds=100", "at least 16 simulations in each .*, got 'rounds=100 simulations=1000'"),
        ("problem=pendulumm", "expected a problem, got 'pendulumm'"),
    ],
)
def test_what_cannot_be_compared_is_refused(given, expected, refusal):
    assert re.search(expected, refusal(given))


def test_the_fewest_simulations_are_those_of_the_mean_over_robots(monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    from sequential_refinement import fewest

    once = [[0.0, 1.0, 2.0], [0.0, 1.0, 4.0]]
    assert fewest([1, 2, 3], {"one round": once, "sequential": [[1, 4, 9], [1, 3, 9]]}) == 2
    assert fewest([1, 2, 3], {"one round": once, "sequential": [[0, 2, 2], [0, 3, 3]]}) is None
