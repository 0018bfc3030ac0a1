"""What roboticists bring: other columns, slow sensors, pieces of runs, motors with dynamics."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_diagnose import ARM, BOUNDS, logs, system

from torchrl_bayessim.diagnosis.diagnose import _system, diagnose
from torchrl_bayessim.diagnosis.holds import bridged
from torchrl_bayessim.diagnosis.modes import Trajectories
from torchrl_bayessim.diagnosis.objective import Point, origin, pushes_of
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.shapes import shaped
from torchrl_bayessim.diagnosis.splits import split
from torchrl_bayessim.effects.transmission import servos
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.system import System

POSITIONS = Columns(time="t", qpos={"hinge": ["q"]}, qvel={}, ctrl={"motor": "u"})


def shortened(log, rows):
    arrays = {name: getattr(log, name)[:rows] for name in ("time", "qpos", "qvel", "ctrl")}
    return replace(log, **arrays)


def test_a_prior_for_a_system_leaves_its_columns_noise_and_effects():
    plain = System(
        task=system().task, columns=POSITIONS, noise={"q": 0.01}, effects=["coulomb_friction"]
    )
    found = _system(plain, BoxPrior(BOUNDS))
    assert found.channel_index == (0,)
    assert found.noise == plain.noise
    assert found.effects == plain.effects
    assert tuple(found.prior.names) == tuple(BOUNDS)


def test_logs_of_other_columns_are_refused():
    expected = r"logs in which q were measured, got '2 measured coordinates in run0'"
    with pytest.raises(ValueError, match=expected):
        diagnose(replace(system(), columns=POSITIONS), None, logs())


def test_actuators_with_activations_are_refused():
    lagging = ARM.replace(
        '<motor name="motor" joint="hinge" ctrlrange="-4 4"/>',
        '<position name="servo" joint="hinge" kp="5" timeconst="0.1"/>',
    )
    expected = "actuators without dynamics of their own.*got '1 activations, of servo'.*action_lag"
    with pytest.raises(ValueError, match=expected):
        diagnose(system(lagging), None, logs())
    assert not servos(system(lagging).robot)


def test_a_sensor_that_is_slower_than_the_log_drops_nothing():
    slow = [
        replace(log, qvel=log.qvel[2 * (torch.arange(len(log)) // 2)].clone()) for log in logs()
    ]
    bridges, holds, alarms = bridged(slow, system().robot)
    assert not holds
    (alarm,) = alarms
    assert alarm.startswith("hinge velocity is renewed every 2 rows: ")
    assert (bridges[0].qvel[1::2] != slow[0].qvel[1::2]).float().mean() > 0.9
    report = diagnose(system(), None, slow, effects=["sensor_dropout", "coulomb_friction"])
    assert not report.effects
    assert alarm in report.alarms


def test_a_short_piece_does_not_switch_the_search_for_periods_off():
    data = logs(push=lambda q, v: 0.3 * np.sin(9.0 * q + 1.0))
    point, robot = Point(origin(system().prior)), system().robot
    found, with_piece = (
        shaped(
            Predictor(system()),
            some,
            point=point,
            noise=np.array([0.002, 0.02]),
            pushes=pushes_of(robot),
        )
        for some in (data, [shortened(data[0], 10), *data])
    )
    assert found
    assert [unit.name for unit in with_piece] == [unit.name for unit in found]


def test_pieces_of_runs_train_and_runs_alone_are_counted():
    long, longer, piece = logs(1, 300)[0], logs(1, 280, seed=1)[0], shortened(logs(1)[0], 8)
    parts = split([long, longer, piece])
    assert [len(part) for part in parts.values()] == [3, 2, 2]
    assert min(len(log) for log in parts["test"]) == 70
    report = diagnose(system(), None, [long, longer, piece], effects=["coulomb_friction"])
    assert any("are stretches of the same runs" in alarm for alarm in report.alarms)


def test_windows_know_which_run_they_are_of():
    data = [shortened(logs(1)[0], 90), *logs(2)]
    pieces = Trajectories().cut(data, 150, history=4, most=12)
    assert set(pieces.log.tolist()) == {1, 2}


def test_time_stamps_since_1970_are_seconds_of_the_run(tmp_path):
    from torchrl_bayessim.logs.read import read_logs

    columns = Columns(time="t", qpos={"hinge": ["q"]}, qvel={"hinge": ["v"]}, ctrl={"motor": "u"})
    robot = System(task=system().task, columns=columns)
    for name, begin in ("a", 0.0), ("b", 1.7e9):
        rows = "\n".join(f"{begin + 0.01 * k:.4f},0.1,0.0,{k % 3}" for k in range(30))
        (tmp_path / f"{name}.csv").write_text(f"t,q,v,u\n{rows}\n")
    first, second = read_logs(tmp_path, robot)
    torch.testing.assert_close(first.time, second.time, atol=1e-6, rtol=0)
