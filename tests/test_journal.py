"""A resumed run tells its logger every round once."""

import math
from pathlib import Path

import pytest
from torchrl.record.loggers import get_logger

RECIPES = Path(__file__).parent.parent / "recipes"


@pytest.fixture
def journal(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(RECIPES)
    from rounds import Journal

    def make(name, *, resume):
        logger = get_logger("csv", logger_name=str(tmp_path), experiment_name=name)
        return Journal(tmp_path / "rounds.json", resume=resume, logger=logger, names=NAMES)

    return make


NAMES = ("mass", "length")


def entry(*returns, index=0):
    return {
        "curve": [{"frames": 8.0 * k, "return": r} for k, r in enumerate(returns)],
        "posterior_mean": [2.0 + index, 0.5],
        "posterior_sd": [0.25, 0.125],
        "real_return": 10.0 * index,
        "frames": 100 * (index + 1),
    }


def test_a_resumed_journal_logs_every_round_once(journal, tmp_path):
    before = journal("broken", resume=False)
    before.add(0, entry(1.5))
    before.add(1, entry(2.5, math.nan, index=1))
    again = journal("resumed", resume=True)
    again.add(1, entry(2.5, math.nan, index=1))  # which was broken off while it was told
    again.add(2, entry(3.5, index=2))
    scalars = tmp_path / "resumed/scalars"
    lines = (scalars / "train/return.csv").read_text().split()
    assert lines == ["0,1.5", "0,2.5", "8,nan", "0,3.5"]
    lines = (scalars / "real/return.csv").read_text().split()
    assert lines == ["100,0.0", "200,10.0", "300,20.0"]
    lines = (scalars / "posterior/mass.csv").read_text().split()
    assert lines == ["100,2.0", "200,3.0", "300,4.0"]
    assert (scalars / "posterior/length_sd.csv").read_text().split()[-1] == "300,0.125"
    assert len(again.rounds) == 3
    anew = journal("anew", resume=False)
    assert anew.rounds == []


@pytest.mark.parametrize("content", ['[{"round": 1', "", "{}", "[1]"])
def test_a_damaged_journal_is_named(content, journal, tmp_path):
    (tmp_path / "rounds.json").write_text(content)
    with pytest.raises(ValueError, match=r"a list in JSON.*rounds\.json: .*anew in another folder"):
        journal("damaged", resume=True)


def test_tensorboard_is_told_the_same(journal, tmp_path):
    pytest.importorskip("tensorboard")
    from rounds import Journal
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logger = get_logger("tensorboard", logger_name=str(tmp_path), experiment_name="log")
    told = Journal(tmp_path / "rounds.json", resume=False, logger=logger, names=NAMES)
    told.add(0, entry(1.5, 2.5))
    logger.experiment.close()
    events = EventAccumulator(str(tmp_path / "log")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("train/return")] == [(0, 1.5), (8, 2.5)]
