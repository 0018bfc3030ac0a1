"""Motors behind a gap or a spring, of a robot that has rotor and link as bodies of their own."""

import mujoco
import numpy as np
import pytest
import torch
from rotor_and_link import gap, one_body, spring, two_bodies

from torchrl_bayessim.diagnosis.candidates import strength_errors
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.free_numbers import Shift
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.refit import Fit
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.robot import robot_of
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

NOISE = 0.001, 0.01
SOME = (
    "action_delay", "action_gain", "action_lag", "backlash", "coulomb_friction", "dead_band",
    "packet_drop", "series_elasticity", "viscous_friction",
)  # fmt: skip


def logs(shaft, seed):
    model, rng, found = two_bodies(shaft, 5e-5), np.random.default_rng(seed), []
    for _ in range(6):
        data, t = mujoco.MjData(model), 0.02 * np.arange(140)
        waves = rng.uniform(0.2, 0.5, 4), rng.uniform(2.0, 18.0, 4), rng.uniform(0.0, 6.0, 4)
        u = sum(a * np.sin(w * t + p) for a, w, p in zip(*waves, strict=True))
        rows = []
        for command in u:
            rows.append([data.qpos[0], data.qvel[0]])
            data.ctrl[0] = command
            mujoco.mj_step(model, data, 400)
        seen = np.array(rows) + rng.normal(size=(len(t), 2)) * NOISE
        found.append(
            Log(
                name=f"run{len(found)}",
                time=torch.from_numpy(t),
                qpos=torch.from_numpy(seen[:, :1].copy()),
                qvel=torch.from_numpy(seen[:, 1:].copy()),
                ctrl=torch.from_numpy(u[:, None].copy()),
                velocity_gain=torch.zeros(1).double(),
                measured=torch.ones(2, dtype=torch.bool),
            )
        )
    return found


def described():
    return Task(model=one_body(0.002), frame_skip=10)


@pytest.mark.parametrize(
    ("name", "shaft", "within"),
    [
        ("series_elasticity", spring(10.0, 0.2), 0.1),
        pytest.param("series_elasticity", spring(22.0, 0.2), 0.25, marks=pytest.mark.slow),
        pytest.param("backlash", gap(0.05), 0.15, marks=pytest.mark.slow),
    ],
)
def test_what_is_between_rotor_and_link_is_named_with_its_size(name, shaft, within):
    said, size = shaft
    bounds = {"dof_damping[joint]": (0.05, 0.2)}
    system = System(task=described(), physics=MujocoPhysics(*bounds), prior=BoxPrior(bounds))
    report = diagnose(system, None, logs(said, seed=1), effects=SOME)
    assert report.effects[0].name == name
    assert report.effects[0].strength == pytest.approx(size, rel=within)
    assert report.gap.with_effects < 2.0


def test_the_damping_of_a_shaft_is_fitted_in_any_case():
    shift = Shift(units_of([effect("series_elasticity")], robot_of(described()))[0], "damping",
                   0.01, 0.01, 0.9)  # fmt: skip
    assert shift.paid([shift.unit])


def test_a_search_counts_the_compliance_of_a_shaft_by_its_period():
    (unit,) = units_of([effect("series_elasticity")], robot_of(described()))
    assert unit.actual(unit.high) == pytest.approx(unit.high)  # 2 Hz
    assert unit.actual(0.1 * unit.high) == pytest.approx(0.01 * unit.high)  # 20 Hz
    assert unit.actual(0.0) == 0.0
    around = unit.actual(0.301 * unit.high) - unit.actual(0.299 * unit.high)
    assert unit.slope(0.3 * unit.high) == pytest.approx(around / (0.002 * unit.high))


def test_what_is_not_known_of_a_compliance_is_not_nothing_at_zero():
    (unit,) = units_of([effect("series_elasticity")], robot_of(described()))
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(400, 2)) * 5.0
    errors = [
        strength_errors(
            Fit(Point(np.zeros(1), {unit: s}), (unit,), np.zeros((20, 20)), jacobian), 1.0, 1
        )[unit]
        for s in (0.0, 0.1 * unit.high, 0.2 * unit.high)
    ]
    assert 0 < errors[0] < 0.001 * unit.high
    assert errors[2] / errors[1] == pytest.approx(2.0, rel=0.1)  # of a square


def test_fits_reach_as_far_as_the_prior_that_a_report_offers():
    (unit,) = units_of([effect("series_elasticity")], robot_of(described()))
    assert unit.actual(unit.inside(np.inf)) == pytest.approx(2 * unit.high)
