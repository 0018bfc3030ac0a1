"""The benchmark that puts each effect of the catalogue on a robot and looks for it."""

import json
from pathlib import Path

import pytest

from torchrl_bayessim.effects.catalogue import CATALOGUE

BENCHMARKS = Path(__file__).parents[2] / "recipes" / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    import each_effect

    # one that is found, one that robots without contacts cannot have, one that is never excited
    names = ("quadratic_drag", "contact_friction", "saturation")
    few = {name: CATALOGUE[name] for name in names}
    monkeypatch.setattr(each_effect, "CATALOGUE", few)
    return each_effect


@pytest.mark.slow
def test_what_was_put_on_is_found_or_said_not_to_show(benchmark, capsys):
    benchmark.main("hopper=0", "cartpole=0", "percent=20")
    *lines, total = map(json.loads, capsys.readouterr().out.splitlines())
    found = {line["case"].partition(" at ")[0]: line for line in lines}
    assert found.keys() == {f"two_links, {name}" for name in ("quadratic_drag", "saturation")}
    drag = found["two_links, quadratic_drag"]
    assert drag["value"] == "named"
    (strength,) = drag["effects"].values()
    assert strength == pytest.approx(drag["strength"], rel=0.02)
    assert found["two_links, saturation"]["value"] == "not shown"
    assert total["value"] == {"named": 1, "not shown": 1}


def test_an_effect_that_is_overlooked_is_missed(benchmark, monkeypatch, capsys):
    diagnose = benchmark.diagnose
    monkeypatch.setattr(
        benchmark, "diagnose", lambda *given: diagnose(*given, effects=["sensor_drift"])
    )
    benchmark.main("hopper=0", "cartpole=0", "quadratic_drag")
    line, total = map(json.loads, capsys.readouterr().out.splitlines())
    assert line["value"] == "missed"
    assert line["verdict"] in {"unknown", "none"}
    assert total["value"] == {"missed": 1}


def test_an_effect_that_is_none_is_refused(benchmark):
    with pytest.raises(ValueError, match=r"an effect.*drag.*quadratic_drag"):
        benchmark.main("drag")
