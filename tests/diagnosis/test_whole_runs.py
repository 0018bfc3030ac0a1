"""What shows over whole runs only is not hidden behind a few control steps."""

import numpy as np
import pytest
from rail_cart import cart, ride

from torchrl_bayessim.diagnosis.diagnose import diagnose


@pytest.mark.parametrize(("drag", "shown"), [(0.15, True), (0.0, False)])
def test_a_small_force_that_adds_up_over_whole_runs_is_told(drag, shown):
    rng = np.random.default_rng(4)
    logs = [
        ride(rng, 300, lambda t, q: drag * np.sin(0.8 * t), noise=[0.002, 0.04]) for _ in range(6)
    ]
    report = diagnose(cart(), None, logs, effects=["action_delay"], horizon=3)
    assert report.verdict == "none"
    alarms = [a for a in report.alarms if "no parameters explain the test runs" in a]
    assert bool(alarms) == shown
    if shown:
        assert "though 3 steps show no gap. Diagnose with horizon=299" in alarms[0]
        again = diagnose(cart(), None, logs, effects=["action_delay"], mode="trajectories")
        assert again.verdict == "unknown"
