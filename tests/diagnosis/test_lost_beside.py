"""Commands that are lost beside a law that lasts, where single losses are too small to be seen."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from test_chance import lost
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis.chance import _of_one_place
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.with_chance import _beside_losses, with_chance
from torchrl_bayessim.effects.action import PacketDrop

SOME = (
    "parallel_spring", "packet_drop", "sensor_dropout", "action_delay", "coulomb_friction",
    "battery_sag",
)  # fmt: skip


@dataclass(frozen=True)
class PlainUnit:
    """An effect at some targets."""

    name: str
    where: str
    targets: list[int] = field(hash=False)


def spring(q, v):
    return -0.4 * q


def test_lost_commands_are_named_beside_a_spring():
    """They change little from one to the next, so that each that is lost is as much as noise."""
    act = lost(0.15, np.random.default_rng(1))
    report = diagnose(system(), None, logs(8, act=act, push=spring), effects=SOME)
    found = {effect.name: effect for effect in report.effects}
    assert set(found) == {"parallel_spring", "packet_drop"}
    assert found["parallel_spring"].strength == pytest.approx(0.4, rel=0.05)
    low, high = found["packet_drop"].ci95
    assert low < 0.15 < high
    assert report.gap.with_effects == pytest.approx(1.0, abs=0.3)


def test_nothing_is_lost_beside_a_law_that_is_not_quite_the_true_one():
    def stiffer(q, v):
        return -0.4 * q - 0.2 * np.tanh(v / 2.0) * q**2

    report = diagnose(system(), None, logs(8, push=stiffer), effects=SOME)
    assert not {effect.name for effect in report.effects} & {"packet_drop", "sensor_dropout"}


@pytest.mark.parametrize(
    ("gains", "kept"),
    [
        ({"one": 202.0, "two": 184.0, "both": 175.0}, {"sample"}),  # either, as it seems
        ({"one": 202.0, "two": 90.0, "both": 175.0}, {"one", "two", "both", "sample"}),
        ({"one": 202.0}, {"one", "sample"}),
    ],
)
def test_losses_that_several_drives_explain_alone_are_those_of_none(gains, kept):
    targets = {"one": [0], "two": [1], "both": [0, 1]}
    units = [PlainUnit("packet_drop", where, targets[where]) for where in gains]
    best = {unit: (300.0 - gains[unit.where], 0.1) for unit in units}
    best[PlainUnit("sensor_dropout", "sample", [0])] = (310.0, 0.1)
    assert {unit.where for unit in _of_one_place(best, 300.0)} == kept


@pytest.mark.parametrize(("lost", "taken"), [(1, False), (3, False), (4, True)])
def test_of_samples_that_are_decided_on_one_by_one_a_few_have_to_be_lost(monkeypatch, lost, taken):
    other, mine = (SimpleNamespace(unit=unit) for unit in ("another sensor", "sensor"))
    told = "interpolated", "more", [mine], SimpleNamespace(lost=lost)
    beside = SimpleNamespace(told=lambda: told, chance=mine)
    where = "torchrl_bayessim.diagnosis.with_chance."
    monkeypatch.setattr(where + "beside_lost_commands", lambda _: None)
    monkeypatch.setattr(where + "beside_lost_samples", lambda _: beside)
    sought = SimpleNamespace(selection="selection", found=[mine, other])
    before = "before", "selection", [other], None
    assert _beside_losses("before", sought) == (told if taken else before)
    # commands that stay the same show no loss, however many are lost
    monkeypatch.setattr(where + "beside_lost_commands", lambda _: beside)
    assert _beside_losses("before", sought) == told
    monkeypatch.setattr(where + "beside_lost_commands", lambda _: None)
    monkeypatch.setattr(where + "beside_lost_samples", lambda _: None)
    assert _beside_losses("before", sought) == ("before", "selection", [mine, other], None)


@dataclass(frozen=True)
class PlainPrepared:
    """What a search starts from."""

    alarms: tuple[str, ...] = ()
    sets: dict = field(default_factory=lambda: {"train": None})


@pytest.mark.parametrize(("calm", "asked"), [(True, True), (False, False), (None, True)])
def test_long_segments_say_what_is_lost_beside_effects_where_short_ones_hold_noise_alone(
    monkeypatch, calm, asked
):
    """Where those hold more, losses are seen there one by one, or there are none."""
    drop = SimpleNamespace(effect=PacketDrop(), targets=[0])
    selection = SimpleNamespace(best=SimpleNamespace(units=()), offered=())
    suspects = calm is not None and SimpleNamespace(rival=SimpleNamespace(calm=calm))
    beside = []

    def chances(sets, selection, units, **given):
        beside.extend(units if given else [])
        return []

    where = "torchrl_bayessim.diagnosis.with_chance."
    monkeypatch.setattr(where + "Suspects.of", lambda *_: suspects or None)
    monkeypatch.setattr(where + "losses", lambda *_: [])
    monkeypatch.setattr(where + "_beside_losses", lambda p, s: (p, selection, [], None))
    monkeypatch.setattr(where + "beside_jitter", lambda *_, **__: None)
    monkeypatch.setattr(where + "_may_be_jitter", lambda *_: False)
    monkeypatch.setattr(where + "of_chance", list)
    monkeypatch.setattr(where + "chances", chances)
    monkeypatch.setattr(where + "_beside_variation", lambda search, p, s, random: (p, s))
    monkeypatch.setattr(where + "detectable", lambda *_: [])
    monkeypatch.setattr(where + "unseen", lambda *_: [])
    with_chance(
        PlainPrepared(),
        selection,
        logs=[],
        units=[drop],
        holds=[],
        alarms=(),
        search=pytest.fail,
        generator=np.random.default_rng(0),
    )
    assert (beside == [drop]) is asked
