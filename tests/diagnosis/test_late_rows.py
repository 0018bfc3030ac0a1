"""Logs whose rows hold the command that led to their state."""

from dataclasses import replace

import numpy as np
import pytest
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis.diagnose import diagnose

SOME = ("coulomb_friction", "action_delay", "action_gain", "parallel_spring")


@pytest.mark.parametrize("late", [True, False])
def test_commands_that_stand_a_row_too_late_are_an_alarm(late):
    data = logs(push=lambda q, v: 0.0 if late else -0.6 * np.sin(3 * q) * np.sign(v))
    if late:
        data = [replace(log, ctrl=log.ctrl.roll(1, 0)) for log in data]
    report = diagnose(system(), None, data, effects=SOME)
    assert late == any("with the commands of the row after" in alarm for alarm in report.alarms)
    assert report.verdict != "named"
