"""Frequency and phase of a periodic force are fitted once it is in the model."""

import mujoco
import numpy as np
import pytest
import torch
from test_diagnose import commands
from test_shapes import BOUNDS, CART

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

SOME = ("cogging", "coulomb_friction", "periodic_disturbance", "sensor_drift", "viscous_friction")
FREQUENCY, PHASE, RATE = 1.37, 0.6, 31.0


def shaken(rng, steps, force):
    """Return a run of a cart that ``force(time, position)`` acts on beside its motor."""
    model = mujoco.MjModel.from_xml_string(CART)
    data = mujoco.MjData(model)
    u, rows = commands(rng, steps), []
    for k in range(steps):
        rows.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = u[k]
        for _ in range(5):
            data.qfrc_applied[0] = force(data.time, data.qpos[0])
            mujoco.mj_step(model, data)
    state = torch.from_numpy(np.array(rows) + rng.normal(size=(steps, 2)) * [0.0002, 0.004])
    return Log(
        name="shaken",
        time=0.01 * torch.arange(steps).double(),
        qpos=state[:, :1],
        qvel=state[:, 1:],
        ctrl=torch.from_numpy(u[:, None].copy()),
        velocity_gain=torch.zeros(1).double(),
        measured=torch.ones(2, dtype=torch.bool),
    )


def diagnosed(force, seed):
    task = Task(model=mujoco.MjModel.from_xml_string(CART), frame_skip=5)
    system = System(task=task, physics=MujocoPhysics(*BOUNDS), prior=BoxPrior(BOUNDS))
    rng = np.random.default_rng(seed)
    logs = [shaken(rng, 300, force) for _ in range(6)]
    return diagnose(system, None, logs, effects=SOME)


def test_a_shaking_force_is_found_with_its_frequency_and_phase_and_nothing_beside_it():
    report = diagnosed(lambda t, q: 0.9 * np.sin(2 * np.pi * FREQUENCY * t + PHASE), 1)
    assert [effect.name for effect in report.effects] == ["periodic_disturbance"]
    (found,) = report.strengths
    assert found.frequency == pytest.approx(FREQUENCY, rel=2e-3)
    assert found.phase == pytest.approx(PHASE, abs=0.03)
    assert report.gap.with_effects < 1.1


def test_magnets_along_a_rail_are_found_with_their_distance_and_phase_and_nothing_beside_them():
    report = diagnosed(lambda t, q: 0.5 * np.sin(RATE * q + PHASE), 2)
    assert [effect.name for effect in report.effects] == ["cogging"]
    (found,) = report.strengths
    assert found.number == pytest.approx(RATE, rel=2e-3)
    assert found.phase == pytest.approx(PHASE, abs=0.03)
    assert report.gap.with_effects < 1.3
