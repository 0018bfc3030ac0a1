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
        return Journal(tmp_path / "rounds.json", resume=resume, logger=logger)

    return make


def entry(*returns):
    return {"curve": [{"frames": 8.0 * k, "return": r} for k, r in enumerate(returns)]}


def test_a_resumed_journal_logs_every_round_once(journal, tmp_path):
    before = journal("broken", resume=False)
    before.add(0, entry(1.5))
    before.add(1, entry(2.5, math.nan))
    again = journal("resumed", resume=True)
    again.add(1, entry(2.5, math.nan))  # which was broken off while it was told
    again.add(2, entry(3.5))
    lines = (tmp_path / "resumed/scalars/train/return.csv").read_text().split()
    assert lines == ["0,1.5", "0,2.5", "8,nan", "0,3.5"]
    assert len(again.rounds) == 3
    anew = journal("anew", resume=False)
    assert anew.rounds == []


def test_tensorboard_is_told_the_same(journal, tmp_path):
    pytest.importorskip("tensorboard")
    from rounds import Journal
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logger = get_logger("tensorboard", logger_name=str(tmp_path), experiment_name="log")
    told = Journal(tmp_path / "rounds.json", resume=False, logger=logger)
    told.add(0, entry(1.5, 2.5))
    logger.experiment.close()
    events = EventAccumulator(str(tmp_path / "log")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("train/return")] == [(0, 1.5), (8, 2.5)]
