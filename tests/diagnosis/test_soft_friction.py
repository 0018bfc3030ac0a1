"""Friction under load that begins over a speed: found where there is one, and only there."""

import mujoco
import numpy as np
import pytest
from test_diagnose import ARM, FINER, as_log, commands, system

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.effects.effect import Reach
from torchrl_bayessim.effects.friction import LoadDependentFriction

NOISE = 0.001, 0.01  # rad, rad/s
SOME = "load_dependent_friction", "coulomb_friction", "viscous_friction", "action_gain", "payload"


def driven(rng, steps, *, share, onset):
    """Return what is measured of an arm whose joint rubs by a share of what its motor exerts."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.opt.timestep /= FINER
    model.dof_solref[:, 0] = 2 * model.opt.timestep  # not 10 ms before the joint turns round
    data = mujoco.MjData(model)
    data.qpos[0] = rng.normal(scale=0.5)
    u, measured, each = commands(rng, steps), [], 5 * FINER
    for k in range(steps * each):
        if k % each == 0:
            measured.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = u[k // each]
        load, speed = abs(data.ctrl[0]) * model.actuator_gear[0, 0], abs(data.qvel[0])
        begun = -np.expm1(-speed / onset) if onset else 1.0
        model.dof_frictionloss[0] = share * load * begun
        mujoco.mj_step(model, data)
    return np.array(measured) + rng.normal(size=(steps, 2)) * NOISE, u


@pytest.mark.parametrize("onset", [0.0, 0.4])
def test_the_speed_over_which_friction_under_load_begins_is_found(onset):
    rng = np.random.default_rng(0)
    data = [as_log(f"run{i}", *driven(rng, 200, share=0.2, onset=onset)) for i in range(6)]
    report = diagnose(system(), None, data, effects=SOME)
    assert [effect.name for effect in report.effects] == ["load_dependent_friction"]
    assert report.effects[0].strength == pytest.approx(0.2, rel=0.05)
    assert report.effects[0].form.get("onset", 0.0) == pytest.approx(onset, rel=0.25)


def test_a_speed_that_no_time_step_resolves_is_none():
    now = Reach(position=1.0, velocity=1.0, time=10.0, slides=False)
    width, least, most = LoadDependentFriction(onset=0.5).free(now)["onset"]
    assert width == pytest.approx(0.025)
    assert (least, most) == (0.0, 0.5)  # what it has is within it
    # the first step is one that shows
    assert LoadDependentFriction().free(now)["onset"] == (0.02, 0.0, 0.1)
