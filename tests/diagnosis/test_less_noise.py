"""What a missing effect does within a few steps looks like noise, until it is found."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.diagnosis.prepared_anew import with_less_noise
from torchrl_bayessim.diagnosis.selection import select
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

BENCHMARKS = Path(__file__).parents[2] / "recipes" / "benchmarks"
NOISE = np.repeat([0.002, 0.012], 2)
BOUNDS = {"body_mass[fore]": (0.4, 1.1)}
ROWS, DAMPING = 120, 2.0


@pytest.fixture(scope="module")
def system():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        from arm import TWO_LINKS
    task = Task(model=mujoco.MjModel.from_xml_string(TWO_LINKS), frame_skip=4)
    return System(task=task, physics=MujocoPhysics(*BOUNDS), prior=BoxPrior(BOUNDS))


def logged(system, seed, *, damping):
    """Return a log of two links, the first of which has more damping, under steps of torque."""
    rng, model = np.random.default_rng(seed), system.task.model.__copy__()
    model.dof_damping[0] += damping
    data, rows = mujoco.MjData(model), []
    commands = rng.uniform(-1, 1, (ROWS // 4, 2)).repeat(4, 0) * [8.0, 2.0]
    for command in commands:
        rows.append(np.r_[data.qpos, data.qvel] + NOISE * rng.standard_normal(4))
        data.ctrl[:] = command
        mujoco.mj_step(model, data, 4)
    state = torch.from_numpy(np.array(rows))
    return Log(
        name=f"run{seed}",
        time=system.control_dt * torch.arange(ROWS).double(),
        qpos=state[:, :2],
        qvel=state[:, 2:],
        ctrl=torch.from_numpy(commands),
        velocity_gain=torch.zeros(2).double(),
        measured=torch.ones(4, dtype=torch.bool),
    )


def prepared_and_units(system, damping):
    logs = [logged(system, seed, damping=damping) for seed in range(6)]
    units = units_of([effect("viscous_friction"), effect("action_bias")], system.robot)
    generator = np.random.default_rng(0)
    return prepare(system, logs, units, generator=generator, horizon=20), units


@pytest.fixture(scope="module")
def searched(system):
    prepared, units = prepared_and_units(system, DAMPING)
    sets = prepared.sets["train"], prepared.sets["validation"]
    generator = np.random.default_rng(0)
    return prepared, units, select(*sets, prepared.nominal, units, generator=generator)


def test_beside_an_effect_noise_is_that_of_the_sensors(searched):
    prepared, _, found = searched
    assert (prepared.noise / NOISE).max() > 1.5
    quieter = with_less_noise(prepared, found.best.fit.point, generator=np.random.default_rng(1))
    assert quieter.noise == pytest.approx(NOISE, rel=0.15)
    assert "beside the effects" in quieter.noise_source
    # what was alarmed of the noise before is not true any more
    assert not any("noise" in alarm for alarm in quieter.alarms)


def test_a_search_that_goes_on_finds_what_one_from_the_beginning_does(searched):
    prepared, units, found = searched
    rng = np.random.default_rng(1)
    quieter = with_less_noise(prepared, found.best.fit.point, generator=rng)
    sets = quieter.sets["train"], quieter.sets["validation"]
    anew, on = (
        select(*sets, quieter.nominal, units, known=known, generator=np.random.default_rng(0))
        for known in (None, found)
    )
    assert [str(unit) for unit in on.best.units] == ["viscous_friction[shoulder]"]
    assert on.best.units == anew.best.units
    (strength,) = on.best.fit.point.strengths.values()
    (from_the_beginning,) = anew.best.fit.point.strengths.values()
    assert strength == pytest.approx(from_the_beginning, rel=0.01)
    assert strength == pytest.approx(DAMPING, rel=0.05)
    assert on.p_values[0] == anew.p_values[0] < 1e-6
    rivals = [
        {u.name for m in s.alternatives["viscous_friction"] for u in m.units} for s in (on, anew)
    ]
    assert rivals[0] == rivals[1] == {"action_bias"}


def test_where_nothing_was_found_noise_stays_as_it_is(system):
    prepared, _ = prepared_and_units(system, 0.0)
    nominal = prepared.nominal.point
    assert with_less_noise(prepared, nominal, generator=np.random.default_rng(1)) is None


def test_where_the_noise_was_right_it_stays(system):
    prepared, units = prepared_and_units(system, 0.0)
    none = Point(prepared.nominal.point.z, {units[0]: 1e-4})
    assert with_less_noise(prepared, none, generator=np.random.default_rng(1)) is None
