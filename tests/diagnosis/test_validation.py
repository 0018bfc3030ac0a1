"""Where test runs hardly show a gap, validation runs may, if they do so surely."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rail_cart import cart, ride

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.shrinkage import Shrinkage
from torchrl_bayessim.diagnosis.splits import split
from torchrl_bayessim.diagnosis.validation import enough, hardly_shown, share_on_validation


def on_validation(before, after, values=2000):
    """Return a search that found effects with these mean squared innovations."""
    models = [SimpleNamespace(validation=np.full((20, values // 20), g**0.5))
              for g in (before, after)]  # fmt: skip
    return SimpleNamespace(nominal=models[0], best=models[1])


@pytest.mark.parametrize(
    ("before", "after", "values", "share"),
    [
        (3.0, 1.5, 2000, 0.75),
        (3.0, 0.9, 2000, 1.0),
        (1.1, 0.95, 2000, 1.0),  # the floor is lower than it was thought
        (1.1, 1.02, 2000, 0.8),
        (1.1, 0.95, 200, 0.0),  # as chance does in so few
        (1.0, 1.0, 2000, 0.0),
        (0.9, 1.1, 2000, 0.0),
    ],
)
def test_the_share_is_of_what_is_above_the_floor(before, after, values, share):
    assert share_on_validation(on_validation(before, after, values)) == pytest.approx(share)


@pytest.mark.parametrize(
    ("refit", "interval", "validated", "hardly"),
    [
        (1.1, (0.0, 0.1), 0.9, True),
        (5.0, (-0.5, 0.9), 1.0, True),
        (5.0, (0.1, 0.5), 0.9, False),
        (1.3, (-0.2, 0.7), 0.6, True),
        (1.3, (-0.2, 0.7), 0.75, False),
    ],
)
def test_test_runs_that_exclude_what_validation_runs_say_say_so(refit, interval, validated, hardly):
    measured = Shrinkage(9.0, refit, 1.0, 0.05, interval, (0.0, 9.0), (0.0, 1.0))
    assert hardly_shown(measured, validated) is hardly


def test_a_doubtful_gap_needs_a_larger_share():
    assert enough(1e-12) < enough(0.01)


def test_what_validation_runs_say_is_the_share_that_is_told():
    """Of a force that pushes in no test run: the share of their gap would be one of nothing."""

    def runs(push):
        drawn = (np.random.default_rng(i) for i in range(8))
        rides = [ride(rng, 200, lambda *_: push, noise=[0.0005, 0.01], finer=4) for rng in drawn]
        return [replace(log, name=f"run{i}") for i, log in enumerate(rides)]

    pushed, calm = runs(0.08), runs(0.0)
    test = {log.name for log in split(pushed)["test"]}
    logs = [calm[i] if log.name in test else log for i, log in enumerate(pushed)]
    report = diagnose(cart(), None, logs, effects=("constant_force", "viscous_friction"))
    assert "on validation runs" in str(report)
    (force,) = report.effects
    assert force.share_of_gap == pytest.approx(report.gap.explained_fraction)
    assert report.gap.explained_fraction > 0.9
    assert report.gap.ci95 == (0.0, 1.0)
