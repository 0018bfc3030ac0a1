"""Dry friction that is added turns round where the joint does, as Coulomb's law says."""

import mujoco
import numpy as np
import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.fields import ModelFields
from torchrl_bayessim.effects.robot import robot_of
from torchrl_bayessim.envs.additions import rollout_with, steps_with
from torchrl_bayessim.envs.model_batch import ModelBatch
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.stepper import Stepper
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.dry_friction import follow_velocity, reference
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.transforms import ApplyEffect, ApplyPhysics

ARM = """
<mujoco><option timestep="{dt}" integrator="{integrator}" gravity="0 0 0"/>
<worldbody><body name="link"><joint name="hinge" axis="0 1 0" damping="0.3" frictionloss="{own}"/>
  <inertial pos="0 0 -0.2" mass="1" diaginertia="0.024 0.024 0.001"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" contype="0" conaffinity="0"/>
</body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>
"""
INERTIA, FRICTION, SOFT = 0.064, 0.3, 1e-3


def arm(dt=0.0025, *, own=0.0, integrator="RK4"):
    text = ARM.format(dt=dt, own=own, integrator=integrator)
    return mujoco.MjModel.from_xml_string(text)


def driven(model, torques, *, law=None, each=0.02):
    """Return angles and velocities under torques, with a force law of this test's own."""
    data, rows = mujoco.MjData(model), []
    for torque in torques:
        data.ctrl[0] = torque
        for _ in range(round(each / model.opt.timestep)):
            if law is not None:
                data.qfrc_applied[0] = law(data.qvel[0])
            mujoco.mj_step(model, data)
        rows.append((data.qpos[0], data.qvel[0]))
    return np.array(rows)


def errors(friction, integrator):
    """Return how far an arm is off Coulomb's law, as MuJoCo has friction, and as it is added."""
    torques = 2.0 * np.repeat(np.random.default_rng(0).normal(size=20), 4)
    true = driven(arm(1e-4), torques, law=lambda v: -friction * np.tanh(v / SOFT))
    found = []
    for follows in (False, True):
        model = arm(integrator=integrator)
        model.dof_frictionloss[0] = friction
        if follows:
            model.dof_frictionloss[0] = 0.0
            follow_velocity(model)
            model.dof_frictionloss[0] = friction
        found.append(float(np.abs(driven(model, torques) - true)[:, 0].mean()))
    return found


@pytest.mark.parametrize(
    ("integrator", "share"), [("Euler", 0.5), ("RK4", 0.2), ("implicitfast", 0.5)]
)
def test_friction_that_follows_the_velocity_is_coulombs(integrator, share):
    before, after = errors(FRICTION, integrator)
    assert after < 0.004  # rad, of a few rad; most of it is Euler's own where that is used
    assert after < share * before


@pytest.mark.parametrize("timestep", [0.001, 0.0025, 0.01])
def test_what_sticks_creeps_by_a_third_of_what_friction_changes_in_a_time_step(timestep):
    model = arm(timestep)
    follow_velocity(model)
    model.dof_frictionloss[0] = FRICTION
    creep = driven(model, [0.9 * FRICTION] * 50)[-1, 1]
    assert creep == pytest.approx(0.9 * FRICTION * 0.3 * timestep / INERTIA, rel=0.1)
    assert driven(model, [1.5 * FRICTION] * 50)[-1, 1] == pytest.approx(0.5, rel=0.02)  # it slides


def test_friction_of_a_models_own_stays_as_it_is():
    model = arm(own=0.1)
    follow_velocity(model)
    assert model.dof_solref[0].tolist() == [0.02, 1.0]
    models, robot = ModelBatch(model, 1), robot_of(Task(model=model, frame_skip=8))
    fields = ModelFields(models)
    effect("coulomb_friction").write(fields, torch.tensor([[0.2]]).double(), robot)
    assert models.read("dof_frictionloss", (0,)) == pytest.approx([0.3])
    assert models.read("dof_solref", (0, 0)).tolist() == [0.02]


def test_an_effect_that_is_off_changes_nothing_and_one_that_is_on_follows():
    models, robot = ModelBatch(arm(), 2), robot_of(Task(model=arm(), frame_skip=8))
    fields = ModelFields(models)
    effect("coulomb_friction").write(fields, torch.tensor([[0.0], [0.2]]).double(), robot)
    for (name, column), value in reference(0.0025).items():
        own = float(getattr(arm(), name)[0, column[0]])
        assert models.read(name, (0, *column)).tolist() == [own, value]
    fields.restore()
    assert models.read("dof_solref", (0, 0)).tolist() == [0.02, 0.02]


def rub(now):
    return {"dof_frictionloss": torch.full_like(now.qvel, FRICTION)}


def test_friction_that_is_added_in_every_time_step_follows_and_leaves_nothing_behind():
    torques = np.random.default_rng(1).normal(size=30)
    model = arm()
    follow_velocity(model)
    model.dof_frictionloss[0] = FRICTION
    lasting = driven(model, torques)

    stepper = Stepper(arm(), 1, threads=1)
    added = rollout_with(stepper, [rub], torques[None, :, None], substeps=8)
    np.testing.assert_allclose(added[0, :, :2], lasting, atol=1e-9)
    assert stepper.models.read("dof_solref", (0, 0)).tolist() == [0.02]

    single, rows = arm(), []
    data = mujoco.MjData(single)
    for torque in torques:
        data.ctrl[0] = torque
        steps_with(single, data, [rub], count=8)
        rows.append((data.qpos[0], data.qvel[0]))
    np.testing.assert_allclose(rows, lasting, atol=1e-9)
    assert single.dof_solref[0].tolist() == [0.02, 1.0]
    assert single.dof_solimp[0, :2].tolist() == [0.9, 0.95]


def test_an_addition_that_raises_leaves_nothing_behind():
    def breaks(now):
        if float(now.time.max()) > 0.01:
            raise RuntimeError("out of friction")
        return rub(now)

    stepper = Stepper(arm(), 1, threads=1)
    with pytest.raises(RuntimeError, match="out of friction"):
        rollout_with(stepper, [breaks], np.ones((1, 3, 1)), substeps=8)
    assert stepper.models.read("dof_frictionloss", (0,)).tolist() == [0.0]
    assert stepper.models.read("dof_solref", (0, 0)).tolist() == [0.02]


def test_a_reference_that_somebody_has_chosen_stays():
    text = ARM.format(dt=0.0025, own=0.0, integrator="RK4")
    text = text.replace("frictionloss=", 'solreffriction="-1 -50" frictionloss=')
    model = mujoco.MjModel.from_xml_string(text)
    follow_velocity(model)
    assert model.dof_solref[0].tolist() == [-1.0, -50.0]
    models = ModelBatch(model, 1)
    robot = robot_of(Task(model=model, frame_skip=8))
    effect("coulomb_friction").write(ModelFields(models), torch.tensor([[0.2]]).double(), robot)
    assert models.read("dof_solref", (0, 1)).tolist() == [-50.0]
    stepper = Stepper(model, 1, threads=1)
    torques = np.random.default_rng(1).normal(size=20)
    added = rollout_with(stepper, [rub], torques[None, :, None], substeps=8)
    model.dof_frictionloss[0] = FRICTION
    np.testing.assert_allclose(added[0, :, :2], driven(model, torques), atol=1e-9)


TWO = """
<mujoco><option timestep="0.0025" integrator="RK4"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" contype="0" conaffinity="0"/>
  <body name="lower" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" contype="0" conaffinity="0"/>
</body></body></worldbody>
<actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>
"""


@pytest.mark.parametrize(
    "name", ["coulomb_friction", "stribeck_friction", "load_dependent_friction"]
)
@pytest.mark.parametrize("parameter", ["body_mass[upper]", "dof_frictionloss[shoulder]"])
def test_replay_and_environment_agree_joint_by_joint(name, parameter):
    """Friction among the parameters is that of the user's simulator, of that joint alone."""
    parts = MujocoPhysics(parameter), BoxPrior({parameter: (0.05, 5.0)})
    task = Task(model=mujoco.MjModel.from_xml_string(TWO), frame_skip=8)
    theta = np.array([[1.5 if "mass" in parameter else 0.1]])
    rubbing = ApplyEffect(name, {"shoulder": 0.0, "elbow": 0.1})
    env = TransformedEnv(BatchedMujocoEnv(task, 1), Compose(ApplyPhysics(parts[0]), rubbing))
    generator = torch.Generator().manual_seed(0)
    start = env.full_state_spec.zero().set("theta", torch.from_numpy(theta))
    now, rows = env.reset(start), []
    for _ in range(30):
        action = torch.randn(1, 2, generator=generator, dtype=torch.float64)
        rows.append((now["observation"][0].double().numpy(), action[0].numpy()))
        now = env.step(now.set("action", action.to(env.action_spec.dtype)))["next"]
    state, ctrl = (np.stack(part) for part in zip(*rows, strict=True))
    log = Log(
        name="run", time=torch.arange(30).double() * task.dt, ctrl=torch.from_numpy(ctrl),
        qpos=torch.from_numpy(state[:, :2].copy()), qvel=torch.from_numpy(state[:, 2:].copy()),
        velocity_gain=torch.zeros(2).double(), measured=torch.ones(4, dtype=torch.bool),
    )  # fmt: skip
    predictor = Predictor(System(task=task, physics=parts[0], prior=parts[1]))
    predictor.exactly()
    pieces = cut([log], 25, history=1, stride=25)
    strengths = {effect(name): np.array([[0.0, 0.1]])}
    assert np.abs(predictor.residuals(pieces, theta, strengths)).max() < 1e-4  # single precision
