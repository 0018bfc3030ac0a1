"""Logs are dealt to splits, and anew where what is missing shows in one split alone."""

from dataclasses import replace

import numpy as np
import pytest
from rail_cart import cart, ride

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.splits import dealt_anew, few, split


def rides(force=lambda t, q: 0.0, steps=(200,) * 8, scales=(1.0,) * 8):
    """Return runs of so many steps, with commands so much larger than usual."""
    return [
        replace(
            ride(np.random.default_rng(i), n, force, noise=[0.0005, 0.01], scale=scale),
            name=f"run{i}",
        )
        for i, (n, scale) in enumerate(zip(steps, scales, strict=True))
    ]


def names(logs):
    return [log.name for log in logs]


def test_what_shows_in_two_training_runs_alone_is_dealt_to_all_splits():
    parts = split(rides())
    assert {name: len(logs) for name, logs in parts.items()} == {
        "train": 4, "validation": 2, "test": 2,
    }  # fmt: skip
    left = {
        "train": np.array([9.0, 1.1, 0.9, 30.0]),
        "validation": np.array([1.0, 1.05]),
        "test": np.array([1.2, 1.02]),
    }
    again = dealt_anew(parts, left)
    assert names(again["train"])[0] == names(parts["train"])[3]
    assert names(again["validation"])[0] == names(parts["train"])[0]
    assert names(again["test"])[0] == names(parts["test"])[0]
    assert {name: len(logs) for name, logs in again.items()} == {
        "train": 4, "validation": 2, "test": 2,
    }  # fmt: skip
    dealt = [name for logs in again.values() for name in names(logs)]
    assert sorted(dealt) == sorted(names(rides()))


def test_the_run_in_which_far_more_is_missing_than_in_any_other_trains():
    parts = split(rides())
    shown = {
        "train": np.array([3.0, 2.0, 2.0, 2.0]),
        "validation": np.array([3.0, 2.0]),
        "test": np.array([2.0, 9.0]),
    }
    assert names(dealt_anew(parts, shown)["train"])[0] == names(parts["test"])[1]
    shown["test"][1] = 3.9  # less than half as much again
    assert dealt_anew(parts, shown) is parts
    plenty = {"train": shown["train"] * 40, "validation": shown["validation"] * 90}
    assert dealt_anew(parts, {**shown, **plenty}) is parts


@pytest.mark.parametrize(
    ("train", "validation", "test"),
    [
        ([90.0, 8.0, 9.0, 7.0], [1.0, 1.6], [2.0, 1.0]),
        ([30.0, 1.0, 1.0, 1.0], [1.0, 1.0], [1.0, 1.0]),
        ([1.4, 1.0, 1.0, 1.0], [1.0, 1.0], [1.3, 1.2]),
    ],
    ids=["shows in all", "shows in one run", "shows in none"],
)
def test_runs_stay_where_all_splits_show_a_gap_or_only_one_run_has_it(train, validation, test):
    parts = split(rides())
    left = {"train": np.array(train), "validation": np.array(validation), "test": np.array(test)}
    assert dealt_anew(parts, left) is parts


def test_pieces_of_runs_still_train_and_few_runs_are_known():
    logs = rides()
    rows = {key: getattr(logs[0], key)[:30] for key in ("time", "qpos", "qvel", "ctrl")}
    piece = replace(logs[0], name="piece", **rows)
    parts = split([*logs, piece])
    at = names(parts["train"]).index("piece")
    left = {"train": np.ones(5), "validation": np.ones(2), "test": np.ones(2)}
    left["train"][[at, at - 1, at - 2]] = 40.0
    again = dealt_anew(parts, left)
    assert "piece" in names(again["train"])
    assert names(again["validation"]) != names(parts["validation"])
    assert few(logs[:2])
    assert not few(logs[:3])


def test_a_cause_that_shows_in_two_training_runs_only_is_found():
    steps, scales = (400, 300, 230, 180, 140, 140, 140, 140), (1, 0.01, 0.01, 1, *[0.01] * 4)
    logs = rides(lambda t, q: -2.0 * q, steps, scales)
    assert {"run0", "run3"} <= {*names(split(logs)["train"])}
    report = diagnose(cart(), None, logs, effects=["parallel_spring", "coulomb_friction"])
    assert report.verdict == "named_partial"
    assert [effect.name for effect in report.effects] == ["parallel_spring"]
    assert report.effects[0].strength == pytest.approx(2.0, rel=0.1)
    assert {"run0", "run3"} & {*report.audit["train"]}
    assert {"run0", "run3"} & {*report.audit["validation"]}


@pytest.mark.parametrize("stiffness", [2.0, 8.0])
def test_a_spring_in_two_of_eight_runs_is_a_gap_that_no_cause_explains(stiffness):
    """Wide runs with it, wide runs without it: no one strength explains both."""
    free, bound = rides(), rides(lambda t, q: -stiffness * q)
    logs = [bound[i] if i in {2, 3} else free[i] for i in range(8)]
    report = diagnose(cart(), None, logs, effects=["parallel_spring", "coulomb_friction"])
    assert report.verdict == "unknown"
