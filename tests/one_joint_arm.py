"""A one-joint arm with logs of its motion, and its diagnosis by the recipe, in this process."""

import csv
import io
import sys
from contextlib import redirect_stdout
from pathlib import Path

import mujoco
import numpy as np
import pytest

RECIPES = Path(__file__).parent.parent / "recipes"
ARM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="link">
      <joint name="hinge" axis="0 1 0" damping="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
SYSTEM = """
simulator: robot.xml
control_dt: 0.01
columns:
  time: t
  qpos: {hinge: q}
  qvel: {hinge: qd}
  ctrl: {motor: tau}
parameters:
  body_mass[link]: [0.3, 0.8]
noise: {q: 0.001, qd: 0.02}
"""
FEW = ["effects=coulomb_friction,action_bias,action_gain", "horizon=20", "progress=false"]
FRICTION = 0.15  # N m


def motion(seed, *, rows=160, friction=0.0, amplitude=0.6, push=0.0):
    """Return rows t, q, qd, tau of an arm that is driven by a sum of sines, and pushed once."""
    generator = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(ARM)
    model.dof_frictionloss[:] = friction
    data = mujoco.MjData(model)
    data.qpos[0] = generator.uniform(-0.5, 0.5)
    frequency, phase = generator.uniform(0.5, 3.0, 4), generator.uniform(0.0, 6.0, 4)
    found = []
    for k in range(rows):
        torque = amplitude * np.sin(2 * np.pi * frequency * 0.01 * k + phase).sum()
        q, qd = data.qpos[0], data.qvel[0]
        noise = generator.standard_normal(2) * (0.001, 0.02)
        found.append([0.01 * k, q + noise[0], qd + noise[1], torque])
        data.ctrl[0] = torque
        data.qfrc_applied[0] = push if 80 <= k < 90 else 0.0
        mujoco.mj_step(model, data, 2)
    return found


def save(path, rows, header=("t", "q", "qd", "tau")):
    path.parent.mkdir(exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


def describe(folder, *, arm=ARM, system=SYSTEM):
    (folder / "robot.xml").write_text(arm)
    (folder / "robot.yaml").write_text(system)


def diagnose(folder, *arguments):
    """Run the recipe in this process; return what it printed."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as printed:
        patch.syspath_prepend(RECIPES)
        patch.chdir(folder)
        import diagnose
        import recipe

        given = ["system=robot.yaml", "data=logs", "out=report", *FEW]
        keys = [argument.partition("=")[0] for argument in arguments]
        kept = [one for one in given if one.partition("=")[0] not in keys]
        patch.setattr(sys, "argv", ["diagnose.py", *kept, *arguments])
        recipe.main(diagnose.Diagnosis, diagnose.job)
    return printed.getvalue()
