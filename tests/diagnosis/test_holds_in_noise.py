"""Held positions are told by measured velocities, though noise was added to them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_diagnose import logs, system
from test_lost_values import shown_again

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.holds import bridged
from torchrl_bayessim.diagnosis.holds_in_noise import held_in_noise, with_motion

DT, GENERATOR = 0.02, torch.Generator().manual_seed(0)


def motion(seed=0, rows=300):
    rng = np.random.default_rng(seed)
    t = DT * np.arange(rows)
    rates, sizes = rng.uniform(1, 6, 3), rng.normal(size=3)
    return (sizes @ np.sin(np.outer(rates, t)), (sizes * rates) @ np.cos(np.outer(rates, t)), rng)


def shown(angle, lost, rng, noise=1e-3):
    last = np.maximum.accumulate(np.where(lost, 0, np.arange(len(angle))))
    return angle[last] + noise * rng.standard_normal(len(angle))


@pytest.mark.parametrize(("share", "gain"), [(0.03, 1.0), (0.15, 0.8), (0.15, -1.0), (0.4, 1.0)])
def test_most_held_samples_of_a_moving_joint_are_found_and_put_right(share, gain):
    """Whatever gain its velocity has."""
    data = []
    for seed, rows in enumerate((300, 220, 300)):  # of several lengths
        angle, speed, rng = motion(seed, rows)
        lost = rng.random(rows) < share
        lost[0] = False
        data.append((angle, gain * speed, lost, shown(angle, lost, rng)))
    found = held_in_noise([one[3] for one in data], [one[1] for one in data], DT)
    assert abs(found.share - share) < 3 * np.sqrt(share / found.count)
    assert found.gain == pytest.approx(1 / gain, rel=0.005)
    for (angle, speed, lost, seen), rows in zip(data, found.rows, strict=True):
        moving = np.abs(speed) > 1.0 * abs(gain)
        assert (rows != lost)[moving].mean() < 0.02
        right = with_motion(seen, found.gain * speed, rows, DT * np.arange(len(angle)))
        before, after = (np.abs(one - angle)[moving].mean() for one in (seen, right))
        assert after < min(0.7 * before, 2e-3)
        assert np.array_equal(right[~rows], seen[~rows])


@pytest.mark.parametrize("rows", [300, 4000])
def test_nothing_is_held_by_a_sensor_that_is_late_or_has_play_or_a_robot_that_is_struck(rows):
    """However long the logs."""
    angle, speed, rng = motion(1, rows)
    noise = 1e-3 * rng.standard_normal(len(angle))
    assert held_in_noise([angle + noise], [speed], DT) is None
    late = np.interp(np.arange(len(angle)) - 1.4, np.arange(len(angle)), angle)
    assert held_in_noise([late + noise], [speed], DT) is None
    shaken = np.interp(np.arange(rows) - rng.random(rows), np.arange(rows), angle)
    assert held_in_noise([shaken + noise], [speed], DT) is None
    play = angle.copy()
    for k in range(1, len(play)):  # follows within 0.05
        play[k] = np.clip(play[k - 1], angle[k] - 0.05, angle[k] + 0.05)
    assert held_in_noise([play + noise], [speed], DT) is None
    struck = speed * np.where(rng.random(len(speed)) < 0.1, rng.normal(size=len(speed)), 1.0)
    assert held_in_noise([DT * np.cumsum(struck) + noise], [speed], DT) is None
    still = np.zeros(50)
    assert held_in_noise([still], [still], DT) is None


def test_only_positions_beside_measured_velocities_are_looked_at():
    rng = np.random.default_rng(2)
    data = [shown_again(log, 0.2, rng) for log in logs(3)]
    _, (hold,), (note,) = bridged(data, system().robot)
    assert hold.share == pytest.approx(0.2, abs=3 * hold.error)
    assert "samples of hinge position are taken not to have been renewed" in note
    guessed = [replace(log, measured=torch.tensor([True, False])) for log in data]
    same, holds, alarms = bridged(guessed, system().robot)
    assert same == guessed
    assert not holds
    assert not alarms


def test_a_joint_that_rests_a_row_that_is_there_twice_and_a_short_log_hide_nothing():
    rng = np.random.default_rng(4)
    data = [shown_again(log, 0.2, rng) for log in logs(3)]
    data = [twice_and_at_rest(log, 300, rng) for log in data]
    short = replace(data[0], **{
        name: getattr(data[0], name)[:9] for name in ("time", "qpos", "qvel", "ctrl")
    })  # fmt: skip
    found, (hold,), (note,) = bridged([*data, short], system().robot)
    assert hold.share == pytest.approx(0.2, abs=3 * hold.error)
    assert "are taken not to have been renewed" in note
    assert len(found[-1]) == 9


@pytest.mark.parametrize("rows", [1, 2, 5, 9])
def test_logs_of_a_few_rows_say_nothing(rows):
    names = "time", "qpos", "qvel", "ctrl"
    data = [replace(log, **{name: getattr(log, name)[:rows] for name in names}) for log in logs(2)]
    assert bridged(data, system().robot) == (data, [], [])
    assert bridged([], system().robot) == ([], [], [])


def twice_and_at_rest(log, rows, rng):
    """Return a log of which the first row is there twice, and that goes on at rest."""
    tail = torch.from_numpy(rng.normal(scale=0.0005, size=(rows, 1)))
    qpos = torch.cat([log.qpos, log.qpos[-1:] + tail])
    qpos[1] = qpos[0]
    return replace(
        log,
        time=0.01 * torch.arange(len(log) + rows).double(),
        qpos=qpos,
        qvel=torch.cat([log.qvel, 0.02 * torch.randn(rows, 1, generator=GENERATOR).double()]),
        ctrl=torch.cat([log.ctrl, torch.zeros(rows, 1).double()]),
    )


def named_beside_held(cause, push, *, share, seed):
    """Return what is named, where angles are held, too, and that it is the cause and those."""
    rng = np.random.default_rng(seed)
    data = [shown_again(log, share, rng) for log in logs(8, push=push)]
    some = (cause, "viscous_friction", "sensor_dropout", "sensor_delay", "action_lag")
    report = diagnose(system(), None, data, effects=some)
    found = {effect.name: effect for effect in report.effects}
    assert set(found) == {cause, "sensor_dropout"}
    return found[cause], found["sensor_dropout"]


def test_a_few_are_named_beside_an_effect_that_does_a_hundred_times_as_much():
    force, held = named_beside_held("constant_force", lambda q, v: 0.3, share=0.04, seed=6)
    assert force.strength == pytest.approx(0.3, rel=0.05)
    assert held.strength == pytest.approx(0.04, rel=0.5)
    assert held.share_of_gap < 0.01


def test_friction_is_found_beside_them():
    def friction(q, v):
        return -0.1 * np.tanh(v / 0.01)

    dry, held = named_beside_held("coulomb_friction", friction, share=0.2, seed=3)
    assert dry.strength == pytest.approx(0.1, rel=0.1)
    assert held.strength == pytest.approx(0.2, rel=0.2)
