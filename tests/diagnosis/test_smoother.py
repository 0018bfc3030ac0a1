"""The smoother against exact conditioning of a linear system, whose states are jointly normal."""

from dataclasses import replace

import mujoco
import numpy as np
import torch

from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.smoother import Beliefs, filtered, smoothed
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

CARTS = """
<mujoco><option timestep=".01" gravity="0 0 0"/><worldbody>
  <body><joint name="first" type="slide" axis="1 0 0" damping=".3" stiffness="8"/>
    <geom size=".1" mass="1" contype="0" conaffinity="0"/>
    <body><joint name="second" type="slide" axis="1 0 0" damping=".1" stiffness="5"/>
      <geom size=".1" mass=".5" contype="0" conaffinity="0"/></body></body>
</worldbody><actuator><motor name="motor" joint="first"/></actuator></mujoco>
"""
NOISE, FORCE, SPREAD = 0.01, 0.02, 0.3  # m, m/s per step, m and m/s
LENGTHS = 30, 22
SHARES = np.array([0.1, 1.0, 10.0])


def system():
    task = Task(model=mujoco.MjModel.from_xml_string(CARTS), frame_skip=5)
    return System(task=task, columns=Columns("t", {"first": ("q",)}, {}, {"motor": "u"}))


def stepped(state, u):
    """Return the state ``(q1, q2, v1, v2)`` one control step later."""
    model = mujoco.MjModel.from_xml_string(CARTS)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state[:2], state[2:], u
    mujoco.mj_step(model, data, 5)
    return np.r_[data.qpos, data.qvel]


def recorded(rng, rows):
    u = rng.normal(size=rows)
    state, states = rng.normal(size=4) * SPREAD, []
    for k in range(rows):
        states.append(state)
        state = stepped(state, u[k]) + np.r_[0, 0, FORCE * rng.normal(size=2)]
    measured = np.array(states)[:, 0] + NOISE * rng.normal(size=rows)
    return Log(
        name="run",
        time=0.05 * torch.arange(rows).double(),
        qpos=torch.from_numpy(np.c_[measured, np.zeros(rows)]),
        qvel=torch.zeros(rows, 2).double(),
        ctrl=torch.from_numpy(u)[:, None],
        velocity_gain=torch.zeros(2).double(),
        measured=torch.tensor([True, False, False, False]),
    )


def exact(log):
    """Return mean and covariance of all states given all measurements, ``(T, 4)`` and ``4 T``."""
    rows, moved = len(log), np.eye(4)
    still = stepped(np.zeros(4), 0.0)
    matrix = np.stack([stepped(moved[i], 0.0) - still for i in range(4)], 1)
    pushed = stepped(np.zeros(4), 1.0)
    mean, spread = np.zeros((rows, 4)), np.zeros((4 * rows, 4 * rows))
    spread[:4, :4] = SPREAD**2 * np.eye(4)
    for k in range(rows - 1):
        now, later = slice(4 * k, 4 * k + 4), slice(4 * k + 4, 4 * k + 8)
        mean[k + 1] = matrix @ mean[k] + pushed * float(log.ctrl[k, 0])
        spread[later, : 4 * k + 4] = matrix @ spread[now, : 4 * k + 4]
        spread[: 4 * k + 4, later] = spread[later, : 4 * k + 4].T
        spread[later, later] = matrix @ spread[now, now] @ matrix.T
        spread[later, later] += np.diag([0, 0, FORCE**2, FORCE**2])
    seen = np.arange(0, 4 * rows, 4)
    gain = spread[:, seen] @ np.linalg.inv(spread[np.ix_(seen, seen)] + NOISE**2 * np.eye(rows))
    mean = mean.ravel() + gain @ (log.qpos[:, 0].numpy() - mean[:, 0])
    return mean.reshape(rows, 4), spread - gain @ spread[seen]


def test_states_and_their_covariances_are_those_of_exact_conditioning():
    rng = np.random.default_rng(0)
    logs = [recorded(rng, rows) for rows in LENGTHS]
    predictor = Predictor(system(), threads=1)
    first = Beliefs(np.zeros((2, 2)), np.zeros((2, 2)), np.tile(SPREAD**2 * np.eye(4), (2, 1, 1)))
    forces = np.tile(np.diag([0, 0, FORCE**2, FORCE**2]), (2, 1, 1))
    given = {"theta": np.zeros(0), "forces": forces, "noise": np.array([NOISE])}
    run = filtered(predictor, logs, first, **given)
    states = smoothed(predictor, run, LENGTHS)
    for i, log in enumerate(logs):
        mean, covariance = exact(log)
        found = np.stack([np.r_[s.qpos[i], s.qvel[i]] for s in states[: len(log)]])
        np.testing.assert_allclose(found, mean, atol=1e-5)
        for k in (0, len(log) // 2, len(log) - 1):
            expected = covariance[4 * k : 4 * k + 4, 4 * k : 4 * k + 4]
            np.testing.assert_allclose(states[k].covariance[i], expected, atol=1e-6)


def likeliest(log):
    """Return which of ``SHARES`` of the true forces makes a log likeliest."""
    predictor = Predictor(system(), threads=1)
    first = Beliefs(np.zeros((3, 2)), np.zeros((3, 2)), np.tile(SPREAD**2 * np.eye(4), (3, 1, 1)))
    forces = SHARES[:, None, None] ** 2 * np.diag([0, 0, FORCE**2, FORCE**2])
    given = {"theta": np.zeros(0), "forces": forces, "noise": np.array([NOISE])}
    run = filtered(predictor, [log] * len(SHARES), first, keep=False, **given)
    return SHARES[run.likelihood.argmax()]


def test_the_likelihood_prefers_forces_as_strong_as_they_were():
    rng = np.random.default_rng(1)
    assert likeliest(recorded(rng, 60)) == 1.0


def test_one_row_that_nobody_expected_does_not_make_all_forces_strong():
    log = recorded(np.random.default_rng(1), 120)
    jump = torch.zeros_like(log.qpos)
    jump[30, 0] = 0.3  # as from a contact
    hit = replace(log, qpos=log.qpos + jump)
    assert likeliest(log) == likeliest(hit) == 1.0
