"""The harness of broken runs finds what is wrong; whether the recipes are right, it says itself."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_bayessim.checkpoint import save
from torchrl_bayessim.whole_file import write_text

BENCHMARKS = Path(__file__).parent.parent / "recipes/benchmarks"
# Adds up squares, and keeps the sum; ``broken`` forgets how far it was
ADDING = """
import json, os, sys, time
settings = dict(a.split("=") for a in sys.argv[1:])
folder, start = settings.get("resume") or settings["out"], time.perf_counter()
os.makedirs(folder, exist_ok=True)
def path(name): return os.path.join(folder, name)
def keep(name, content):
    with open(path("." + name + ".tmp"), "w") as file:
        json.dump(content, file)
    os.replace(path("." + name + ".tmp"), path(name))
keep("settings.json", {})
state = {"i": 0, "sum": 0.1}
if os.path.exists(path("state.json")):
    state |= json.load(open(path("state.json")))
if BROKEN:
    state["i"] = 0
while state["i"] < 40:
    state = {"i": state["i"] + 1, "sum": state["sum"] + state["i"] ** 2}
    keep("state.json", state)
    time.sleep(0.01)
keep("result.json", {**state, "provenance": {"seconds": time.perf_counter() - start}})
"""


@pytest.fixture
def modules(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    import killed
    import written_numbers

    return killed, written_numbers


@pytest.mark.parametrize("broken", [False, True])
def test_runs_that_go_on_wrongly_are_found(modules, tmp_path, broken):
    killed, _ = modules
    script = tmp_path / "adding.py"
    script.write_text(f"BROKEN = {broken}\n{ADDING}")
    shares = list(killed.spread(4, seed=0, recipe="adding"))
    tally = killed.break_off(killed.Case(script, ()), tmp_path, shares=shares)
    assert tally.kills == 4
    assert tally.ended >= 1
    assert set(tally.differing) == ({"result.json/sum", "state.json/sum"} if broken else set())


def test_a_recipe_that_fails_is_no_broken_run(modules, tmp_path):
    killed, _ = modules
    script = tmp_path / "failing.py"
    script.write_text("raise SystemExit('no such robot')")
    with pytest.raises(RuntimeError, match=r"failing\.py ended with 1: no such robot"):
        killed.run(killed.Case(script, ()), tmp_path / "run")


def test_moments_are_spread_over_the_run(modules):
    killed, _ = modules

    def shares(seed, recipe):
        return tuple(killed.spread(20, seed=seed, recipe=recipe))

    one = shares(1, "sim2real_ppo")
    assert (np.sort(np.array(one) * 20).astype(int) == np.arange(20)).all()
    assert one == shares(1, "sim2real_ppo")
    assert one != shares(2, "sim2real_ppo")
    assert not set(one) & set(shares(1, "withheld_effects"))


def write(folder, *, weight=1.0, seconds=1.0, nan=float("nan")):
    save(folder / "policy.pt", {"weight": torch.tensor([weight, nan]), "seconds": seconds})
    result = {"real": [weight], "checkpoint": str(folder), "provenance": {"seed": seconds}}
    write_text(folder / "result.json", json.dumps(result))


def test_the_last_bit_counts_and_times_and_paths_do_not(modules, tmp_path):
    _, written_numbers = modules
    write(tmp_path / "one")
    write(tmp_path / "same", seconds=2.0)
    write(tmp_path / "other", weight=float(np.nextafter(np.float32(1), np.float32(2))))
    one, same, other = (written_numbers.read(tmp_path / name) for name in ("one", "same", "other"))
    assert written_numbers.differing(one, same) == []
    assert written_numbers.differing(one, other) == ["policy.pt/weight", "result.json/real/0"]
    assert written_numbers.differing(one, one | {"more.json": 0}) == ["more.json"]
    assert written_numbers.apart(one, same) == {}
    assert written_numbers.apart(one, other) == {"real": pytest.approx(2**-23, rel=0.05)}
    assert written_numbers.apart(one, {}) == {"real": np.inf}


@pytest.mark.parametrize("name", ["policy.pt", "result.json"])
def test_a_file_that_is_not_whole_is_found(modules, tmp_path, name):
    _, written_numbers = modules
    write(tmp_path)
    file = tmp_path / name
    file.write_bytes(file.read_bytes()[:-7])
    with pytest.raises(ValueError, match=r"whole checkpoint|Expecting"):
        written_numbers.read(tmp_path)
    left = tmp_path / ".result.json.12.tmp"
    left.write_text("")
    assert written_numbers.unfinished(tmp_path) == [left]
