"""The harness of repeated runs: what it finds, and that it knows every recipe."""

import os
from pathlib import Path

import pytest

RECIPES = Path(__file__).parent.parent / "recipes"
# Adds up draws, as many parts at a time as there are threads
ADDING = """
import json, os, random, sys
settings = dict(a.split("=") for a in sys.argv[1:])
draw = random.Random(SEED)
values = [draw.random() for _ in range(1000)]
width = int(settings.get("threads", 1))
os.makedirs(settings["out"])
told = {"real": sum(sum(values[i::width]) for i in range(width)), "cores": CORES}
with open(os.path.join(settings["out"], "result.json"), "w") as file:
    json.dump(told, file)
"""


@pytest.fixture
def repeated(monkeypatch):
    monkeypatch.syspath_prepend(RECIPES / "benchmarks")
    import repeated

    return repeated


def script(folder, *, seed="0", cores="1"):
    file = folder / "adding.py"
    file.write_text(f"import os\nSEED = {seed}\nCORES = {cores}\n{ADDING}")
    return file


def test_another_order_of_adding_is_told_with_its_size(repeated, tmp_path):
    found = repeated.repeat(repeated.Case(script(tmp_path), ()), tmp_path, threads=2)
    assert (found["entries"], found["differing"]) == (2, [])
    assert found["apart"].keys() == {"real"}
    assert 0 < found["apart"]["real"] < 1e-14


def test_draws_without_a_seed_are_found(repeated, tmp_path):
    case = repeated.Case(script(tmp_path, seed="None"), ())
    found = repeated.repeat(case, tmp_path, threads=0)
    assert found == {"entries": 2, "differing": ["result.json/real"]}


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="there is one core only")
def test_what_depends_on_the_cores_is_found(repeated, tmp_path):
    case = repeated.Case(script(tmp_path, cores="len(os.sched_getaffinity(0))"), ())
    assert repeated.repeat(case, tmp_path, threads=0)["differing"] == ["result.json/cores"]
    assert len(os.sched_getaffinity(0)) > 1  # as before


def test_every_recipe_is_repeated(repeated):
    recipes = {path.stem for path in RECIPES.glob("*.py") if "recipe.main(" in path.read_text()}
    assert set(repeated.SETTINGS) == recipes
