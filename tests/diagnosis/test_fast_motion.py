"""Velocities of a robot that swings its legs within few rows: polynomials cannot tell them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from test_chance_contacts import NOISE, PHYSICS, running
from test_diagnose import ARM
from test_diagnose import logs as arm_logs
from test_diagnose import system as arm

from torchrl_bayessim.diagnosis import fast_motion as module
from torchrl_bayessim.diagnosis.fast_motion import FastMotion, fast_motion
from torchrl_bayessim.diagnosis.modes import Mode
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.diagnosis.velocity_errors import with_velocity_errors
from torchrl_bayessim.diagnosis.whitening import start_noise
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.columns import default_columns
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.logs.velocity import Windows, velocity

MARGIN = 3  # rows that polynomials need at both ends
TRUE, WRONG = np.array([6.0, 3.0]), np.array([6.6, 6.0])


def system():
    task = known_task("HalfCheetah-v5")
    prior = BoxPrior({"body_mass[torso]": (4.5, 9.0), "dof_damping[bfoot]": (1.0, 10.0)})
    columns = replace(default_columns(task), qvel={})
    return System(task=task, columns=columns, physics=PHYSICS, prior=prior)


def without_velocities(log):
    """Return a log with velocities that polynomials make of its positions."""
    windows, positions = Windows(log.time.numpy()), log.qpos.numpy()
    guesses = [velocity(windows, positions[:, d])[:2] for d in range(9)]
    inner = slice(MARGIN, len(log) - MARGIN)
    return replace(
        log,
        time=log.time[inner],
        qpos=log.qpos[inner],
        qvel=torch.from_numpy(np.stack([slope for slope, _ in guesses], -1)[inner]),
        ctrl=log.ctrl[inner],
        velocity_gain=torch.tensor([gain for _, gain in guesses]).double(),
        measured=torch.arange(18) < 9,
    )


def polynomials(logs):
    return [without_velocities(log) for log in logs]


@pytest.fixture(scope="module")
def robot():
    """Return the simulator, logs without velocities, and the measured ones."""
    logs = running(3)[:6]
    speeds = [log.qvel[MARGIN:-MARGIN].numpy() for log in logs]
    predictor = Predictor(system(), threads=1)
    return predictor, with_velocity_errors(predictor, polynomials(logs), TRUE), speeds


@pytest.mark.parametrize(("theta", "better"), [(TRUE, 3.0), (WRONG, 1.7)], ids=["true", "wrong"])
def test_a_simulator_tells_velocities_that_polynomials_cannot(robot, theta, better):
    predictor, logs, speeds = robot
    motion = fast_motion(predictor, logs)
    assert motion.dofs == tuple(range(9))
    found = motion.estimated(predictor, logs, theta=theta, noise=NOISE[:9])
    wrong, guessed = (
        np.concatenate([log.qvel.numpy() - true for log, true in zip(some, speeds, strict=True)])
        for some in (found, logs)
    )
    ratios = np.median(np.abs(guessed), 0) / np.median(np.abs(wrong), 0)
    assert ratios.min() > better
    deviations = torch.cat([log.uncertainty for log in found]).diagonal(dim1=1, dim2=2).sqrt()
    within = np.abs(wrong) < 2 * deviations[:, 9:].numpy() + 0.05  # what is measured has noise, too
    assert within.mean() > 0.9
    assert not deviations[:, :9].any()
    for log in found:
        assert not log.velocity_gain.any()
        assert not log.velocity_error.any()
    assert "too fast for 20 rows a second" in motion.note(found)


def test_unknown_forces_are_those_of_the_logs_that_the_simulator_is_fitted_to(robot):
    predictor, logs, _ = robot
    given = {"theta": WRONG, "noise": NOISE[:9]}
    motion = fast_motion(predictor, logs).settled(predictor, logs[:4], **given)
    together = motion.estimated(predictor, logs, **given)
    alone = motion.estimated(predictor, logs[4:5], **given)
    deviations = [one.uncertainty.diagonal(dim1=1, dim2=2).sqrt() for one in (together[4], *alone)]
    np.testing.assert_allclose(deviations[0][1:], deviations[1][1:], rtol=0.3, atol=1e-3)


@pytest.mark.parametrize(
    "body", ["", '<body name="ball" pos="5 0 2"><freejoint/><geom size=".1"/></body>']
)
def test_of_free_bodies_no_error_is_known_and_none_is_asked_for(body):
    arm_and_body = ARM.replace("</worldbody>", body + "</worldbody>")
    task = Task(model=mujoco.MjModel.from_xml_string(arm_and_body), frame_skip=10)
    predictor, size = Predictor(System(task=task), threads=1), task.model.nv
    log = arm_logs()[0]
    rows = torch.ones(len(log), 1, dtype=torch.float64)
    fast = replace(
        log,
        qpos=rows * torch.from_numpy(task.model.qpos0.copy()),
        qvel=torch.sin(torch.arange(len(log)).double())[:, None].expand(-1, size).contiguous(),
        velocity_gain=torch.full((size,), 30.0).double(),
        velocity_error=torch.eye(size)[list(predictor.system.robot.dof_index)].sum(0).double(),
    )
    assert fast_motion(predictor, [fast]).dofs == tuple(range(size))


def test_rows_that_the_simulator_does_not_expect_make_estimates_less_sure(robot):
    predictor, logs, _ = robot
    motion = fast_motion(predictor, logs)
    log = logs[0]
    jump = torch.zeros_like(log.qpos)
    jump[30, 3] = 0.2
    both = motion.estimated(
        predictor, [log, replace(log, qpos=log.qpos + jump)], theta=TRUE, noise=NOISE[:9]
    )
    still, hit = (one.uncertainty.diagonal(dim1=1, dim2=2)[:, 9:].sum(1) for one in both)
    assert float(hit[30] / still[30]) > 10.0
    assert float(hit[10] / still[10]) == pytest.approx(1.0, abs=0.1)


def test_slow_motion_is_left_to_polynomials():
    predictor = Predictor(arm(), threads=1)
    logs = arm_logs()
    gain = torch.full_like(logs[0].velocity_gain, 30.0)
    for error, told in ((0.001, ()), (10.0, (0,))):
        guessed = [replace(g, velocity_gain=gain, velocity_error=error + 0 * gain) for g in logs]
        assert fast_motion(predictor, guessed).dofs == told


def test_what_no_simulator_tells_stays_as_it_is(robot, monkeypatch):
    predictor, logs, _ = robot
    monkeypatch.setattr(module, "likeliest_share", lambda *_, **__: 30.0)
    motion = FastMotion(tuple(range(9)), 20.0)
    found = motion.estimated(predictor, logs[:1], theta=TRUE, noise=NOISE[:9])
    assert found[0].uncertainty is None
    assert found[0].qvel is logs[0].qvel


def test_velocities_that_are_too_fast_are_estimated_before_anything_is_fitted():
    logs = polynomials(running(3))
    prepared = prepare(system(), logs, [], generator=np.random.default_rng(0))
    assert type(prepared.mode) is Mode
    assert any("too fast for 20 rows a second" in alarm for alarm in prepared.alarms)
    assert prepared.sets["train"].segments.uncertainty is not None
    assert not prepared.sets["train"].segments.velocity_gain.any()
    assert prepared.nominal.mean_square < 1.5
    fitted = prepared.sets["train"].theta(prepared.nominal.point.z[None])[0]
    np.testing.assert_allclose(fitted, TRUE, rtol=0.15)


def test_velocities_know_nothing_of_the_rows_that_are_predicted_from_them(robot):
    predictor, logs, _ = robot
    motion, row = FastMotion(tuple(range(9)), 20.0, share=0.01), 20
    later = torch.zeros_like(logs[0].qpos)
    later[row + 1 :, 3:] = 0.1
    moved = replace(logs[0], qpos=logs[0].qpos + later)
    one, other = motion.estimated(predictor, [logs[0], moved], theta=TRUE, noise=NOISE[:9])
    assert torch.equal(one.qvel[: row + 1], other.qvel[: row + 1])
    assert not torch.equal(one.qvel[row + 1 :], other.qvel[row + 1 :])
    assert not one.smoothed


def test_an_error_that_was_carried_here_counts_less_than_one_that_was_fitted(robot):
    predictor, logs, _ = robot
    motion = FastMotion(tuple(range(9)), 20.0, share=0.01)
    given = {"theta": TRUE, "noise": NOISE[:9]}
    segments = cut(motion.estimated(predictor, logs[:1], **given), 5)
    carried = start_noise(predictor, segments, NOISE[:9])
    fitted = start_noise(predictor, replace(segments, smoothed=True), NOISE[:9])
    ratio = fitted[..., 9:].std(0) / carried[..., 9:].std(0)
    np.testing.assert_allclose(ratio, 1.5)
    np.testing.assert_allclose(fitted[:9], carried[:9])
