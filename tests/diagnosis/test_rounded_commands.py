"""Rounded commands are found at their step where the missing force does not show it."""

import mujoco
import numpy as np
import pytest
import torch
from plain_models import A, plain

from torchrl_bayessim.diagnosis import shapes
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.objective import Unit
from torchrl_bayessim.diagnosis.rounded_commands import _told_apart, steps_between
from torchrl_bayessim.diagnosis.screening import Screen
from torchrl_bayessim.diagnosis.search import _may_be_rounded
from torchrl_bayessim.effects.action import ActionQuantization
from torchrl_bayessim.envs.task import Task, uniform_reset
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

STEP = 0.093  # of commands within 1: between all strengths that every effect is tried at
ARM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom name="link" type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="hinge" gear="3" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def arm():
    model = mujoco.MjModel.from_xml_string(ARM)
    prior = BoxPrior({"dof_damping[hinge]": (0.05, 0.2)})
    task = Task(model=model, frame_skip=1, reset=uniform_reset(model, 0.3))
    return System(task=task, physics=MujocoPhysics(*prior.names), prior=prior)


def moved(rng, *, step, noise, rows=200):
    """Return the log of an arm whose commands are rounded."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qpos[:] = rng.uniform(-0.5, 0.5)
    frequency, phase = rng.uniform(0.3, 2.0, 3), rng.uniform(0, 6, 3)
    seen = []
    for k in range(rows):
        command = 0.3 * np.sin(2 * np.pi * frequency * 0.01 * k + phase).sum()
        measured = np.r_[data.qpos, data.qvel] + rng.standard_normal(2) * noise
        seen.append([*measured, command])
        data.ctrl[:] = step * np.round(command / step) if step else command
        mujoco.mj_step(model, data)
    qpos, qvel, ctrl = torch.tensor(np.array(seen)).T.unsqueeze(-1)
    return Log(
        name="run",
        time=0.01 * torch.arange(rows, dtype=torch.float64),
        qpos=qpos,
        qvel=qvel,
        ctrl=ctrl,
        velocity_gain=torch.zeros(1, dtype=torch.float64),
        measured=torch.ones(2, dtype=torch.bool),
    )


@pytest.mark.parametrize(("noise", "seed"), [((0.002, 0.02), 2), ((0.004, 0.04), 1)])
def test_rounded_commands_are_found_between_the_strengths_that_all_effects_are_tried_at(
    noise, seed, monkeypatch
):
    # as where contacts hide what single rows do
    monkeypatch.setattr(shapes, "_rounding", lambda *_, **__: None)
    rng = np.random.default_rng(seed)
    logs = [moved(rng, step=STEP, noise=noise) for _ in range(6)]
    report = diagnose(arm(), None, logs)
    (found,) = report.effects
    assert (found.name, found.where) == ("action_quantization", "motor")
    assert found.strength == pytest.approx(STEP, rel=0.005)
    assert report.verdict in {"named", "named_partial"}


@pytest.mark.parametrize(("left", "little"), [(800.0, True), (500.0, False)])
def test_a_step_is_looked_for_where_what_was_found_explains_less_than_half(left, little):
    """Of 400 numbers, of which a base leaves twice and a half the noise: 600 beyond it."""
    assert _may_be_rounded(plain([], 1000.0), plain([A], left)) == little
    assert _may_be_rounded(plain([], 1000.0), None)


def test_steps_are_as_close_as_the_largest_command_tells_them_apart():
    steps = steps_between(0.02, 0.2, 0.6)
    assert (steps[0], steps[-1] >= 0.2) == (0.02, True)
    # the multiple of a step that is nearest to the largest command, of the next step
    multiples = np.round(0.6 / steps[:-1])
    assert (multiples * np.diff(steps) <= 0.3 * steps[:-1]).all()
    few = steps_between(0.02, 0.2, 0.0)  # nothing is commanded, nothing to tell apart
    assert len(few) < 50


def test_of_large_commands_only_steps_are_tried_that_so_many_tell_apart():
    few = steps_between(_told_apart(0.2, 1.0), 0.2, 1.0)
    many = steps_between(_told_apart(0.2, 300.0), 0.2, 300.0)
    assert len(few) == pytest.approx(600, rel=0.05)
    assert len(many) == pytest.approx(600, rel=0.05)


def test_a_step_is_not_scaled_by_how_much_of_its_signature_fits():
    quantization = ActionQuantization()
    assert not quantization.graded
    unit = Unit(quantization, "motor", (1.0,), 0.0, 0.2)
    seen = Screen(
        units=(unit,),
        strengths=np.array([0.08]),
        norms=np.array([10.0]),
        sizes=np.array([10.0]),
        scores=np.array([7.0]),
        correlation=np.eye(1),
        swallowed=np.zeros(1),
        residual=100.0,
        effective=100,
        changes=(np.zeros((1, 1), np.float32),),
        growth=np.ones(1),
    )
    assert seen.best(1.0) == {unit: (49.0, 0.08)}
