"""Systems that the tests of logs share."""

import mujoco
import pytest

from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.system import System

PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="RK4"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
BOX = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="box" pos="0 0 1">
      <freejoint name="free"/>
      <geom type="box" size=".1 .1 .2" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="session")
def pendulum():
    """A hinge with a motor at 100 Hz: columns t, q, qd, tau."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    columns = Columns("t", {"hinge": ("q",)}, {"hinge": ("qd",)}, {"motor": "tau"})
    return System(task=Task(model=model, frame_skip=5), columns=columns)


@pytest.fixture(scope="session")
def pendulum_without_velocity(pendulum):
    """The same without velocities."""
    columns = Columns("t", {"hinge": ("q",)}, {}, {"motor": "tau"})
    return System(task=pendulum.task, columns=columns)


@pytest.fixture(scope="session")
def box():
    """A free box at 100 Hz, with pose and velocity."""
    model = mujoco.MjModel.from_xml_string(BOX)
    return System(task=Task(model=model, frame_skip=5))
