"""Late sensors show at first what was measured before a segment: that explains nothing."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_diagnose import logs, system

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.late_sensors import _no_more, _steps
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.effects.sensors import SensorDelay, SensorLag

CHECKED = np.arange(6, 21, 2)
GROWING = np.repeat((1.0 + CHECKED**2)[:, None], 2, axis=1)


@pytest.mark.parametrize(
    ("steps", "left", "free"),
    [
        ((4.0, 0.0), 1.0, False),  # only noise is left
        ((4.0, 0.0), 1.0 + (CHECKED - 4.0) ** 2, True),  # as it was four steps before
        ((14.0, 0.0), 0.1, True),  # most rows are no predictions
        ((0.0, 0.0), 1.0, False),
    ],
)
def test_an_error_as_large_as_it_was_so_many_steps_before_is_not_explained(steps, left, free):
    after = GROWING.copy()
    after[:, 0] = left
    assert _no_more(GROWING, after, np.array(steps), CHECKED) == free


@pytest.mark.parametrize(("left", "free"), [(1.0, False), (1.2985, True)])
def test_a_sensor_that_is_hardly_late_has_little_for_nothing_although_noise_is_left(left, free):
    """A twentieth of a step before, an error of 1.3 was 1.29; what is explained is a quarter."""
    before = np.repeat(np.linspace(1.0, 1.6, len(CHECKED))[:, None], 2, axis=1)
    after = before.copy()
    after[:, 0] = np.linspace(1.0, 2 * left - 1.0, len(CHECKED))
    assert _no_more(before, after, np.array([0.05, 0.0]), CHECKED) == free


@pytest.mark.parametrize("horizon", [1, 3])
def test_over_few_steps_no_gap_is_that_of_sensors_that_show_what_was_before(horizon):
    damped = logs(push=lambda q, v: -1.5 * np.sin(9 * q) * v)
    some = "sensor_delay", "sensor_lag", "sensor_bias"
    report = diagnose(system(), None, damped, effects=some, horizon=horizon)
    assert report.verdict == "unknown"
    assert any("sensors that are late were left out" in alarm for alarm in report.alarms)


def test_a_delay_of_every_channel_is_late_commands_and_a_filter_is_late_by_its_mean():
    robot = system().robot
    objective = SimpleNamespace(predictor=SimpleNamespace(system=SimpleNamespace(robot=robot)))
    units = {str(u): u for u in units_of([SensorDelay(), SensorLag()], robot)}
    units |= {f"two {u}": u for u in units_of([SensorLag(0.5)], robot)}

    def late(name, where, seconds):
        point = Point(np.zeros(1), {units[f"{name}[{where}]"]: seconds})
        return _steps(objective, point)

    first, dt = robot.channels[0], robot.dt
    assert late("sensor_delay", "all", 2 * dt).tolist() == [0.0, 0.0]
    assert late("sensor_delay", first, 2 * dt) == pytest.approx([2.0, 0.0])
    kept = np.exp(-1 / 3)
    mean = sum(k * (1 - kept) * kept**k for k in range(200))
    assert late("sensor_lag", first, 3 * dt) == pytest.approx([mean, 0.0])
    kept = np.exp(-2 / 3)
    mean = sum(k * (1 - kept) * kept**k for k in range(200))
    assert late("two sensor_lag", first, 3 * dt) == pytest.approx([2 * mean, 0.0])
