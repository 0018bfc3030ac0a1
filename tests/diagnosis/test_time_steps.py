"""A search takes no more time steps than the data can tell."""

import mujoco
import numpy as np
import torch

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.objective import units_of
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.diagnosis.time_steps import with_fewest_steps
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

ARM = """
<mujoco><option timestep="{dt}" integrator="{integrator}"/><worldbody>
  <body name="link"><joint name="hinge" axis="0 1 0" damping=".05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1"/></body>
</worldbody><actuator><motor name="motor" joint="hinge" ctrlrange="-5 5"/></actuator></mujoco>
"""
NOISE = np.array([0.001, 0.02])


def system(integrator, *, dt=0.0025, frame_skip=8):
    model = mujoco.MjModel.from_xml_string(ARM.format(dt=dt, integrator=integrator))
    return System(task=Task(model=model, frame_skip=frame_skip))


def runs(integrator="RK4", *, count=4, friction=0.0):
    """Return logs of a finely simulated arm."""
    model = mujoco.MjModel.from_xml_string(ARM.format(dt=0.00125, integrator=integrator))
    model.dof_frictionloss[:] = friction
    rng, logs = np.random.default_rng(0), []
    for i in range(count):
        data, rows = mujoco.MjData(model), []
        wave = rng.uniform(1, 3) * np.sin(0.02 * rng.uniform(2, 8) * np.arange(120))
        for u in wave:
            rows.append((data.qpos[0], data.qvel[0]))
            data.ctrl[:] = u
            mujoco.mj_step(model, data, 16)
        state = torch.tensor(rows) + torch.from_numpy(NOISE * rng.normal(size=(120, 2)))
        logs.append(
            Log(
                name=f"run{i}",
                time=0.02 * torch.arange(120).double(),
                qpos=state[:, :1],
                qvel=state[:, 1:],
                ctrl=torch.from_numpy(wave)[:, None],
                velocity_gain=torch.zeros(1).double(),
                measured=torch.ones(2, dtype=torch.bool),
            )
        )
    return logs


def fewest(robot, names=("coulomb_friction", "action_lag")):
    units = units_of([effect(name) for name in names], robot.robot)
    segments = cut(runs(), 20, history=8, most=8)
    predictor = Predictor(robot, threads=1)
    return with_fewest_steps(predictor, segments, units, z=np.zeros(1), noise=NOISE)


def test_a_smooth_arm_needs_few_steps_of_an_integrator_of_high_order():
    robot = system("RK4")
    found = fewest(robot)
    assert found.substeps in {2, 4}
    segments = cut(runs(), 20, history=8, most=8)
    few, own = (p.residuals(segments, np.zeros((1, 0))) for p in (found, Predictor(robot)))
    np.testing.assert_allclose(few, own, atol=0.02 * NOISE.min())


def test_others_keep_the_steps_of_their_model():
    assert fewest(system("Euler")).substeps == 8


def test_what_is_found_is_fitted_with_the_steps_of_the_model():
    predictor = Predictor(system("RK4"), substeps=2)
    finer = predictor.finer
    assert (predictor.substeps, finer.substeps) == (2, 4)
    predictor.exactly()
    assert (predictor.substeps, predictor.finer.substeps) == (8, 16)
    segments = cut(runs(), 20, history=8, most=8)
    own = Predictor(system("RK4")).residuals(segments, np.zeros((1, 0)))
    np.testing.assert_array_equal(predictor.residuals(segments, np.zeros((1, 0))), own)


def test_a_control_step_of_one_long_time_step_is_one_step():
    robot = system("RK4", dt=0.02, frame_skip=1)
    report = diagnose(robot, None, runs(friction=0.2), effects=["coulomb_friction", "armature"])
    assert [e.name for e in report.effects] == ["coulomb_friction"]
