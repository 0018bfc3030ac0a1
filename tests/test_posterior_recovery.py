"""The table of recovered parameters from its command line, as users run it."""

import json
import re
import shutil
from functools import partial
from pathlib import Path

import pytest
import torch
from command_line import run_here, run_recipe

from torchrl_bayessim.inference.priors import BoxPrior

RECIPE = Path(__file__).parent.parent / "recipes" / "posterior_recovery.py"


run = partial(run_recipe, RECIPE)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recovery")
    status, out, err = run(
        "short=true", "processes=1", "problem=pendulum", "out=run", folder=folder
    )
    assert status == 0, err
    return folder, out


def rows_of(folder):
    return json.loads((folder / "run/result.json").read_text())["rows"]


def test_ranks_that_are_not_uniform_are_told(monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    from recovery_table import uniform

    even = (torch.arange(300) + 0.5) / 300
    assert uniform(even) > 0.99
    assert uniform(0.25 + even / 2) < 1e-6  # too unsure
    assert uniform(even.round()) < 1e-6  # too sure
    assert uniform(even[:0]) is None


def test_a_method_is_averaged_over_the_seeds_that_it_was_asked_with(monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    from recovery_table import cell, joint, rows

    def part(**at_truth):
        entry = {"nats": [], "place": [], "joint_nats": None, "seconds_fit": None}
        methods = {name: entry | {"log_prob": [value]} for name, value in at_truth.items()}
        return {
            "problem": "pendulum", "methods": methods, "seconds_simulate": 1.0, "simulations": 9,
        }  # fmt: skip

    parts = [part(BayesSim=1.0, MCMC=5.0), part(BayesSim=3.0)]
    both, once = rows(parts)
    assert (both["log_prob_mean"], both["seeds"], once["seeds"]) == (2.0, 2, 1)
    assert cell(once) == "5.00"
    assert list(joint(parts)) == []


def test_rows_have_what_others_read(finished):
    folder, out = finished
    result = json.loads((folder / "run/result.json").read_text())
    assert json.loads(out.splitlines()[-1].removeprefix("RESULT ")) == result
    assert {row["method"] for row in result["rows"]} == {"BayesSim", "Rejection ABC"}
    for row in result["rows"]:
        assert {
            *("problem", "parameter", "method", "log_prob_mean", "log_prob_sd", "nats_over_prior"),
            *("coverage_50", "coverage_90", "seconds_simulate", "seconds_fit", "simulations"),
            *("seeds", "paper_best"),
        } <= row.keys()
        assert (row["problem"], row["parameter"]) == ("pendulum", "dt")
        assert (row["simulations"], row["seeds"], row["truths"]) == (200, 2, 32)
        assert row["paper_best"] == 3.199
        assert 0 <= row["coverage_50"] <= row["coverage_90"] <= 1
    assert result["provenance"]["seed"] == 0


def test_a_parameter_is_recovered_better_than_by_the_prior(finished):
    folder, _ = finished
    rows = json.loads((folder / "run/result.json").read_text())["rows"]
    found = {row["method"]: row for row in rows}
    assert found["BayesSim"]["nats_over_prior"] > 1
    assert found["BayesSim"]["nats_over_prior"] > found["Rejection ABC"]["nats_over_prior"]


def test_table_and_picture_are_there(finished):
    folder, _ = finished
    table = (folder / "run/table.md").read_text()
    assert "| paper, best | 3.20 | |" in table
    assert "These data say much about dt" in table
    (own,) = (row for row in rows_of(folder) if row["method"] == "BayesSim")
    assert f"| {own['coverage_90']:.1%} | {own['sbc_p']:.2g} | 32 |" in table
    assert "of 32 truths 50%: 31.2% to 68.8%, 90%: 78.1% to 100.0%." in table  # binomial
    assert re.search(r"\| pendulum, all together \| BayesSim \| \d+\.\d% \| \d+\.\d% \|", table)
    assert (folder / "run/pendulum.png").stat().st_size > 5000


def test_a_missing_part_is_run_again_to_the_same_numbers_and_no_other(
    finished, same_numbers, tmp_path, monkeypatch
):
    shutil.copytree(finished[0] / "run", tmp_path / "run")
    missing, *others = sorted((tmp_path / "run/parts").iterdir())
    before = [path.stat().st_mtime_ns for path in others]
    missing.unlink()
    asked = "short=true", "processes=1", "problem=pendulum", f"out={tmp_path / 'run'}"
    run_here(monkeypatch, RECIPE, "Recovery", *asked)
    assert others
    assert [path.stat().st_mtime_ns for path in others] == before
    same_numbers(tmp_path / "run", finished[0] / "run")


@pytest.mark.slow
def test_by_the_papers_protocol_ten_trajectories_together_tell_more_than_their_mean(
    tmp_path, monkeypatch
):
    asked = "short=true", "paper_mode=true", "problem=pendulum", "online=false"
    run_here(monkeypatch, RECIPE, "Recovery", *asked, f"out={tmp_path / 'run'}")
    rows = json.loads((tmp_path / "run/result.json").read_text())["rows"]
    found = {row["method"]: row for row in rows}
    (pooled,) = (row for name, row in found.items() if name.startswith("BayesSim pooled"))
    mean = found["BayesSim NN diagonal, our statistics"]
    assert pooled["nats_over_prior"] > 0.3 + mean["nats_over_prior"]
    assert pooled["coverage_90"] > 0.6
    assert "Rejection ABC, the paper's statistics" in found
    table = (tmp_path / "run/table.md").read_text()
    best = max(row["log_prob_mean"] for row in rows)
    assert f"| pendulum, dt | 3.20 | {best:.2f} |" in table


def test_chains_start_where_distances_are_small_also_where_most_are_equal(monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    from recovery_methods import mcmc_abc

    prior = BoxPrior({"x": (0.0, 1.0)})
    near = mcmc_abc(lambda theta: theta, prior, torch.tensor([0.3]), budget=1000, seed=0)
    assert near.mean().item() == pytest.approx(0.3, abs=0.02)
    assert near.std() < 0.05
    blind = mcmc_abc(lambda theta: 0 * theta, prior, torch.tensor([0.0]), budget=1000, seed=0)
    assert len(blind) >= 500
    assert 0.2 < blind.std() < 0.4  # the prior's is 0.29


def test_parts_of_other_methods_are_other_parts(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    import posterior_recovery

    monkeypatch.setattr(posterior_recovery, "answered", lambda s, *_: {"online": s.online})
    for online in (False, True):
        settings = posterior_recovery.Recovery(online=online)
        assert posterior_recovery.run(settings, "pendulum", 0, tmp_path) == {"online": online}


def test_an_unknown_problem_ends_in_one_line(tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit, match="2"):
        run_here(monkeypatch, RECIPE, "Recovery", "problem=pendulumm", f"out={tmp_path / 'run'}")
    (line,) = capsys.readouterr().err.splitlines()
    assert "expected a problem, got 'pendulumm'. Available: pendulum (did you mean" in line
