"""Effects that last are found beside commands that were lost, on those that arrived."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from noisy_cheetah import cheetah
from plain_models import A, plain
from test_chance import lost
from test_diagnose import logs, system
from test_lost_values import TWO, run_of_two

from torchrl_bayessim.diagnosis.arrivals import Arrivals
from torchrl_bayessim.diagnosis.as_recorded import Recorded, Sent, along
from torchrl_bayessim.diagnosis.beside_losses import Sought
from torchrl_bayessim.diagnosis.chance import Chance
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.evident_losses import _likely, evident
from torchrl_bayessim.diagnosis.loss_law import LossLaw
from torchrl_bayessim.diagnosis.loss_segments import loss_segments
from torchrl_bayessim.diagnosis.loss_suspects import Alone
from torchrl_bayessim.diagnosis.losses import _sensed, may_be_beside
from torchrl_bayessim.diagnosis.lost_commands import _matters, _searched, beside_lost_commands
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.diagnosis.prepared_anew import with_other_logs
from torchrl_bayessim.diagnosis.scatter import Scatter
from torchrl_bayessim.effects.action import PacketDrop
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.system import System

SOME = (
    "action_delay", "action_gain", "action_lag", "coulomb_friction", "dead_band", "packet_drop",
    "sensor_dropout",
)  # fmt: skip


def jumps(share, seed, *, through=lambda u: u):
    """Return commands that jump and are lost now and then, and the list of those that arrived."""
    rng, noise, arrived = np.random.default_rng(seed), np.random.default_rng(99), []
    arrives = lost(share, rng)

    def act(u, k):
        if k == 0:
            u += noise.normal(size=len(u))
            arrived.append([])
        arrived[-1].append(arrives(u, k))
        return through(arrived[-1][-1])

    return act, arrived


def test_commands_that_arrived_are_told_from_those_that_were_sent():
    act, arrived = jumps(0.2, 1)
    data = logs(8, act=act)
    units = units_of([PacketDrop()], system().robot)
    prepared = prepare(system(), data, units, generator=np.random.default_rng(0))
    law = LossLaw(share=0.2, scatter=1.0, spoiled=0.01, size=16)
    found = Arrivals(prepared, Point(prepared.nominal.point.z), [0], law).decided(prepared.logs)
    true = {log.name: torch.tensor(one) for log, one in zip(data, arrived, strict=True)}
    wrong, lost_ones, sent_wrong = 0.0, 0, 0.0
    for split, part in found.items():
        for log, sent in zip(part, prepared.logs[split], strict=True):
            first = next(one for name, one in true.items() if log.name.startswith(name))
            right = first[log.first_row : log.first_row + len(log)]
            wrong += float((log.ctrl[:, 0] - right).abs().sum())
            sent_wrong += float((sent.ctrl[:, 0] - right).abs().sum())
            lost_ones += int((log.ctrl != sent.ctrl).sum())
            assert set(log.ctrl[:, 0].tolist()) <= set(sent.ctrl[:, 0].tolist())
    assert lost_ones > 200
    assert wrong < 0.1 * sent_wrong


@pytest.mark.parametrize(
    ("name", "strength", "through", "push"),
    [
        ("dead_band", 0.5, lambda u: np.sign(u) * max(abs(u) - 0.5, 0.0), lambda q, v: 0.0),
        pytest.param(
            "coulomb_friction",
            0.3,
            lambda u: u,
            lambda q, v: -0.3 * np.tanh(v / 0.01),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_another_cause_is_found_beside_lost_commands(name, strength, through, push):
    act, _ = jumps(0.15, 2, through=through)
    rivals = "action_delay", "coulomb_friction", "dead_band", "packet_drop"
    report = diagnose(system(), None, logs(6, act=act, push=push), effects=rivals)
    assert report.verdict in {"named", "named_partial"}
    found = {effect.name: effect for effect in report.effects}
    assert set(found) == {name, "packet_drop"}
    assert found[name].strength == pytest.approx(strength, rel=0.1)
    assert found["packet_drop"].strength == pytest.approx(0.15, rel=0.5)
    assert {effect.name for effect in report.strengths} == set(found)
    shares = [effect.share_of_gap for effect in report.effects]
    assert shares == sorted(shares, reverse=True)
    assert min(shares) > 0.0
    assert sum(shares) == pytest.approx(report.gap.explained_fraction, abs=1e-6)
    assert report.confusion_set[0] == report.effects[0].name
    assert report.gap.refit > 5.0  # of commands as they were sent
    channels = report.where["channel"]
    assert max(channels, key=channels.__getitem__) == "actuation"


def test_what_packets_of_several_commands_hide_leaves_them_their_share_of_the_gap():
    """Half of what each removes alone and beside the other, and never more than there is."""
    rng = np.random.default_rng(8)
    band = lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.5, 0.0)
    data = [run_of_two(rng, f"run{i}", share=0.15, through=band) for i in range(6)]
    robot = System(task=Task(model=mujoco.MjModel.from_xml_string(TWO), frame_skip=1))
    report = diagnose(robot, None, data, effects=SOME, horizon=10)
    found = {effect.name: effect for effect in report.effects}
    assert set(found) == {"dead_band", "packet_drop"}
    assert found["packet_drop"].where == "all"
    assert min(effect.share_of_gap for effect in report.effects) > 0.05
    shares = sum(effect.share_of_gap for effect in report.effects)
    assert shares == pytest.approx(report.gap.explained_fraction, abs=1e-6)
    assert report.gap.horizon_steps == 10
    (note,) = [alarm for alarm in report.alarms if "taken to have been lost" in alarm]
    assert "of 900 commands" in note


@pytest.mark.slow
def test_of_many_runs_some_are_decided_on(monkeypatch):
    monkeypatch.setattr("torchrl_bayessim.diagnosis.arrivals._LARGEST", 20_000)
    act, _ = jumps(0.15, 2, through=lambda u: np.sign(u) * max(abs(u) - 0.5, 0.0))
    report = diagnose(system(), None, logs(12, act=act), effects=SOME)
    assert {effect.name for effect in report.effects} == {"dead_band", "packet_drop"}
    assert any("was decided on in 6 of 12 runs" in alarm for alarm in report.alarms)


def test_losses_alone_sit_in_the_actuation():
    act, _ = jumps(0.1, 3)
    report = diagnose(system(), None, logs(8, act=act), effects=SOME)
    assert [effect.name for effect in report.effects] == ["packet_drop"]
    assert report.where["channel"]["actuation"] == pytest.approx(1.0)
    assert report.where["joints"][0] == {"name": "hinge", "share": 1.0}


def test_the_search_is_not_done_again_where_no_losses_are_evident(monkeypatch):
    """Friction whose law no effect has is wrong everywhere, and some of that looks like losses."""

    def search(*_, **__):
        pytest.fail("searched again")

    seen = []

    def watched(sought):
        seen.append(sought.selection.best.mean_square)
        assert beside_lost_commands(replace(sought, search=search)) is None

    monkeypatch.setattr("torchrl_bayessim.diagnosis.with_chance.beside_lost_commands", watched)
    data = logs(6, push=lambda q, v: -0.4 * np.tanh(v / 0.3) * (1 + np.sin(9 * q)))
    diagnose(system(), None, data, effects=SOME)
    assert seen[0] > 3.0


@pytest.mark.parametrize(
    ("before", "after", "matters"), [(1.15, 1.0, False), (2.0, 1.25, True), (2.0, 1.75, False)]
)
def test_what_mends_a_little_of_wrong_decisions_is_no_effect(before, after, matters):
    """Of 400 numbers."""
    found = SimpleNamespace(nominal=plain([], 400 * before), best=plain([A], 400 * after))
    assert _matters(found) == matters


@pytest.mark.parametrize(("beside", "searched"), [(False, True), (True, False), (None, False)])
def test_beside_losses_that_were_found_alone_more_is_looked_for(monkeypatch, beside, searched):
    """However little of what is wrong with their segments they explain."""
    (unit,) = units_of([PacketDrop()], system().robot)
    law = SimpleNamespace(deviance=lambda _: 95.0)
    monkeypatch.setattr("torchrl_bayessim.diagnosis.evident_losses.likeliest", lambda *_, **__: law)
    monkeypatch.setattr("torchrl_bayessim.diagnosis.evident_losses._plain", lambda *_: False)
    segments = SimpleNamespace(tried=lambda _: None, point=Point(np.zeros(1)))
    data = {"train": segments, "validation": segments}
    alone = SimpleNamespace(law=SimpleNamespace(size=16), costs=[60.0, 40.0])
    suspects = SimpleNamespace(units=[unit], nominal=data, best=data, alone=alone, rival=alone)
    selection = SimpleNamespace(best=plain([], 1e3))
    found = [] if beside is None else [SimpleNamespace(unit=unit, beside=beside)]
    sought = SimpleNamespace(suspects=suspects, selection=selection, found=found)
    seen = evident(sought)
    assert (seen is not None) == searched
    if seen is not None:
        assert seen.unit is unit
        assert seen.without == 100.0


@pytest.mark.parametrize(
    ("effects", "left", "calm", "cost", "beside", "again"),
    [
        ([A], 1.1, True, 700.0, 100.0, False),
        ([], 1.1, True, 700.0, 100.0, True),  # nothing else was found
        ([A], 1.3, True, 700.0, 100.0, True),  # what was leaves more than noise
        ([A], 1.1, False, 700.0, 100.0, True),  # some segments hold more than noise
        ([A], 1.1, True, 400.0, 100.0, True),  # losses explain two thirds of what it does
        ([A], 1.1, True, 700.0, -50.0, True),  # or much beside it
    ],
)
def test_losses_that_explain_far_less_than_effects_are_not_fitted_again(
    monkeypatch, *, effects, left, calm, cost, beside, again
):
    """Of 1000 that parameters leave, the effect takes 900."""
    (unit,) = units_of([PacketDrop()], system().robot)
    where, asked = "torchrl_bayessim.diagnosis.evident_losses.", []
    law = SimpleNamespace(deviance=lambda judged: judged[0])
    monkeypatch.setattr(where + "likeliest", lambda *_, **__: law)
    monkeypatch.setattr(where + "_plain", lambda *_: False)
    monkeypatch.setattr(where + "_fitted_again", lambda *_: asked.append(1))
    data, best = (
        dict.fromkeys(("train", "validation"), SimpleNamespace(tried=lambda _, left=left: left))
        for left in (cost, beside)
    )
    alone = SimpleNamespace(law=SimpleNamespace(size=16), costs=[600.0, 400.0])
    rival = SimpleNamespace(law=SimpleNamespace(size=16), costs=[60.0, 40.0], calm=calm)
    suspects = SimpleNamespace(units=[unit], nominal=data, best=best, alone=alone, rival=rival)
    selection = SimpleNamespace(best=plain(effects, 400 * left))
    sought = SimpleNamespace(suspects=suspects, selection=selection, found=[])
    assert evident(sought) is None
    assert bool(asked) == again


@pytest.mark.parametrize(("share", "off", "there"), [(0.3, 1.5, True), (0.0, 0.7, False)])
def test_losses_are_plain_once_parameters_are_fitted_to_commands_that_arrived(share, off, there):
    """Of an arm whose parameters had made up for them as far as they could, and were far off."""
    act, _ = jumps(share, 3)
    units = units_of([PacketDrop()], system().robot)
    generator = np.random.default_rng(0)
    prepared = prepare(system(), logs(6, act=act), units, generator=generator)
    bent = prepared.nominal.point.z + off
    data = {name: one.at(Point(bent)) for name, one in loss_segments(prepared).items()}
    suspects = SimpleNamespace(units=units, nominal=data, alone=Alone.of(data))
    assert not _likely(data, units[0], suspects.alone).plain
    found = SimpleNamespace(best=plain([], 1e3))
    sought = Sought(prepared, found, [], suspects, None, generator)
    seen = evident(sought)
    assert (seen is not None) == there
    if seen is not None:
        assert seen.law.share == pytest.approx(share, rel=0.4)
        unspoiled = prepare(system(), logs(6, act=jumps(0.0, 3)[0]), units, generator=generator)
        right = unspoiled.nominal.point.z
        assert np.linalg.norm(seen.point.z - right) < 0.4 * np.linalg.norm(bent - right)


@pytest.mark.parametrize(
    ("found", "last"),
    [
        ([(6.2, 4.3, A), (4.2, 1.8, A), (3.7, 1.5, A)], 1.5),  # better decisions each time
        ([(6.2, 1.8, A), (4.2, 2.0, A)], 1.8),
        ([(6.2, 4.3, A), (4.2, 4.0, A), (4.1, 3.9, A)], None),  # in the end it mends a little
        ([(6.2, 6.2, None)], 6.2),  # losses are all there is
        ([(6.2, 1.8, A), (1.5, 1.5, None)], 1.5),
    ],
)
def test_which_commands_arrived_is_decided_on_again_while_that_helps(monkeypatch, found, last):
    """Before and after the effects of each search; of 400 numbers."""
    rounds = iter(found)

    def search(_, *, pairs):
        assert not pairs
        before, after, unit = next(rounds)
        best = plain([] if unit is None else [unit], 400 * after)
        return None, SimpleNamespace(nominal=plain([], 400 * before), best=best)

    where = "torchrl_bayessim.diagnosis.lost_commands."
    arrivals = SimpleNamespace(decided=lambda logs: logs)
    monkeypatch.setattr(where + "Arrivals", lambda *_: arrivals)
    monkeypatch.setattr(where + "with_other_logs", lambda *_, **__: None)
    law = LossLaw(share=0.2, scatter=1.0, spoiled=0.01, size=16)
    seen = SimpleNamespace(point=Point(np.zeros(1)), law=law, actuators=[0])
    sent = SimpleNamespace(best=plain([], 400 * 100.0))
    prepared = SimpleNamespace(logs={})
    result = _searched(prepared, sent, seen, search=search, generator=np.random.default_rng(0))
    assert (None if result is None else result[1].best.mean_square) == pytest.approx(last)
    assert next(rounds, None) is None


@pytest.mark.parametrize(
    ("name", "apart", "sensed"),
    [("dead_band", True, False), ("sensor_bias", True, False), ("sensor_drift", True, False),
     ("sensor_gain", True, True), ("sensor_lag", False, True), ("action_delay", False, True)],
)  # fmt: skip
def test_losses_are_not_told_beside_what_errs_as_they_do(name, apart, sensed):
    units = units_of([effect(name)], system().robot)
    commands, samples = (
        units_of([effect(random)], system().robot)[0]
        for random in ("packet_drop", "sensor_dropout")
    )
    assert may_be_beside(commands, units) == apart
    assert may_be_beside(samples, units)  # but clearly, beside what errs as they do
    assert _sensed(units) == sensed  # where they have to be clear


@pytest.mark.parametrize(
    ("found", "lasting", "beside"),
    [([], [A], True), ([], [], False), (["losses"], [A], True), (["losses"], [], None)],
)
def test_losses_alone_are_told_where_none_were_found_without_the_commands_that_arrived(
    monkeypatch, found, lasting, beside
):
    where = "torchrl_bayessim.diagnosis.lost_commands."
    (unit,) = units_of([PacketDrop()], system().robot)
    chance = Chance(unit, 0.2, 0.01, gain=900.0, left=np.ones(3), deviance=100.0)
    seen = SimpleNamespace(actuators=[0], without=1000.0)
    selection = SimpleNamespace(best=plain(lasting, 400.0))
    monkeypatch.setattr(where + "fewer", lambda prepared, _: prepared)
    monkeypatch.setattr(where + "evident", lambda _: seen)
    monkeypatch.setattr(where + "_searched", lambda *_, **__: ("arrived", selection))
    monkeypatch.setattr(where + "_needed", lambda *_: (selection, chance))
    alone = [SimpleNamespace(deviance=800.0) for _ in found]
    result = beside_lost_commands(Sought("sent", None, alone, None, None, None))
    assert (None if result is None else result.chance.beside) is beside
    if result is not None:
        assert (result.sent, result.prepared) == ("sent", "arrived")


def test_the_gap_of_the_commands_that_were_sent_is_with_parameters_that_were_fitted_to_these():
    act, _ = jumps(0.3, 3)
    units = units_of([PacketDrop()], system().robot)
    generator = np.random.default_rng(0)
    sent = prepare(system(), logs(6, act=act), units, generator=generator)
    law = LossLaw(share=0.3, scatter=1.0, spoiled=0.01, size=16)
    known = Arrivals(sent, sent.nominal.point, [0], law).decided(sent.logs)
    again = with_other_logs(sent, known, generator=generator)
    selection = SimpleNamespace(
        nominal=SimpleNamespace(fit=again.nominal), best=SimpleNamespace(fit=again.nominal)
    )
    told = Sent.along(again, sent, selection)
    assert told.lost > 200
    test = again.sets["test"]
    history, most = test.segments.history, len(test.segments)
    pieces = again.mode.cut(sent.logs["test"], again.horizon, history=history, most=most)
    points = [sent.nominal.point, again.nominal.point]
    assert [told.refit, told.effects] == pytest.approx(along(test, pieces, points).tolist())
    assert told.refit != pytest.approx(told.effects, rel=0.05)
    other = Point(np.zeros_like(sent.nominal.point.z))
    selection.best.fit = replace(again.nominal, point=other)
    refit, effects = along(test, test.segments, [again.nominal.point, other])
    told = replace(told, refit=4.0 * max(refit, effects), effects=2.0 * max(refit, effects))
    chance = Chance(units[0], 0.3, 0.01, gain=900.0, left=np.full(3, 0.5))
    for left, figures in ((None, (refit, effects)), (0.7 * refit, (0.7 * refit, 0.5))):
        scatter = Scatter([replace(chance, alone=left)], {}, [], Recorded(), sent=told)
        lasting = scatter.lasting(again, selection)
        assert lasting == pytest.approx(1.0 - told.share(*figures))
        assert 0.0 < lasting < 1.0
    assert replace(scatter, sent=None).lasting(again, selection) is None


def test_commands_lost_by_a_robot_whose_contacts_scramble_predictions_soon():
    """Over eight steps of 50 ms feet meet the ground by chance; over three the losses show."""
    system, logs, _ = cheetah(lost=0.3, amplitude=1.0)
    report = diagnose(system, None, logs, effects=("packet_drop", "action_delay"))
    (found,) = report.effects
    assert (found.name, found.where) == ("packet_drop", "bshin")
    assert found.strength == pytest.approx(0.3, abs=0.04)
