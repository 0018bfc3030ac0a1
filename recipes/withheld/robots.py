"""The robots of the blind check: nominal models, priors, sensors, and how they are moved.

Models of our own are integrated by fourth-order Runge-Kutta, so that a finer step changes nothing
that a sensor could see: what the diagnosis finds is then the effect and not the integrator. Robots
with contacts keep their time step: how contacts give way depends on it, visibly.
"""

from __future__ import annotations

__all__ = ["ROBOTS", "Robot", "entry_value", "nominal_model", "write_entry"]

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import mujoco

from .fetch_push import COMMANDS, EFFECTS, NOISE, SIMULATOR, fetch_push_model

ARM = """<mujoco model="arm">
  <option timestep="0.0025" integrator="RK4"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="link">
    <joint name="hinge" axis="0 1 0" damping="0.3" armature="0.01"/>
    <inertial pos="0 0 -0.2" mass="1" diaginertia="0.014 0.014 0.001"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/>
  </body></worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-4 4" ctrllimited="true"/></actuator>
</mujoco>
"""

TWO_LINKS = """<mujoco model="two links">
  <option timestep="0.0025" integrator="RK4"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="upper">
    <joint name="shoulder" axis="0 1 0" damping="0.6" armature="0.02"/>
    <inertial pos="0 0 -0.17" mass="1.2" diaginertia="0.013 0.013 0.001"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.35" size="0.03"/>
    <body name="fore" pos="0 0 -0.35">
      <joint name="elbow" axis="0 1 0" damping="0.2" armature="0.008"/>
      <inertial pos="0 0 -0.15" mass="0.7" diaginertia="0.006 0.006 0.0005"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.025"/>
    </body>
  </body></worldbody>
  <actuator>
    <motor name="shoulder motor" joint="shoulder" ctrlrange="-10 10" ctrllimited="true"/>
    <motor name="elbow motor" joint="elbow" ctrlrange="-3 3" ctrllimited="true"/>
  </actuator>
</mujoco>
"""

CART_POLE = """<mujoco model="cart-pole">
  <option timestep="0.0025" integrator="RK4"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="cart">
    <joint name="rail" type="slide" axis="1 0 0" damping="2"/>
    <geom type="box" size="0.1 0.05 0.05" mass="1"/>
    <body name="pole">
      <joint name="pivot" axis="0 1 0" damping="0.01"/>
      <inertial pos="0 0 -0.25" mass="0.3" diaginertia="0.0063 0.0063 0.0001"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02"/>
    </body>
  </body></worldbody>
  <actuator><motor name="drive" joint="rail" ctrlrange="-15 15" ctrllimited="true"/></actuator>
</mujoco>
"""


@dataclass(frozen=True)
class Robot:
    """A nominal model and what is uncertain about it.

    Attributes:
        name: Its name.
        simulator: As ``system.yaml`` names it.
        xml: The model's text, or the file's name in Gymnasium; of a dragged hand nothing.
        control_dt: Seconds between actions.
        masses: Prior bounds of masses, kg.
        dampings: Prior bounds of damping, N m s/rad or N s/m.
        amplitude: Of commands, as a share of the actuators' range.
        reach: Of the reference of closed loops, rad or m.
        spread: Of initial positions, rad or m.
        refinement: Time steps of the generator per time step of the model.
        steps: Control steps of a trajectory, least and most.
        commands: Names of commands that drag a hand; of none the actuators are commanded.
        noise: Of each tangent coordinate, times that which is drawn; one for all, or ``nv``.
        effects: Names that the diagnosis may consider; nothing for all.
    """

    name: str
    simulator: str
    xml: str
    control_dt: float
    masses: Mapping[str, tuple[float, float]]
    dampings: Mapping[str, tuple[float, float]]
    amplitude: float
    reach: float
    spread: float
    refinement: int = 4
    steps: tuple[int, int] = (150, 250)
    commands: tuple[str, ...] = ()
    noise: tuple[float, ...] = (1.0,)
    effects: tuple[str, ...] | None = None


ROBOTS = {
    robot.name: robot
    for robot in (
        Robot(
            "arm", "robot.xml", ARM, 0.02,
            {"body_mass[link]": (0.6, 1.6)}, {"dof_damping[hinge]": (0.15, 0.6)},
            amplitude=0.7, reach=0.9, spread=0.6,
        ),
        Robot(
            "two_links", "robot.xml", TWO_LINKS, 0.02,
            {"body_mass[upper]": (0.8, 1.8), "body_mass[fore]": (0.4, 1.1)},
            {"dof_damping[shoulder]": (0.3, 1.2), "dof_damping[elbow]": (0.1, 0.4)},
            amplitude=0.7, reach=0.8, spread=0.5,
        ),
        Robot(
            "cart_pole", "robot.xml", CART_POLE, 0.02,
            {"body_mass[cart]": (0.6, 1.6), "body_mass[pole]": (0.15, 0.5)},
            {"dof_damping[rail]": (1.0, 4.0), "dof_damping[pivot]": (0.005, 0.02)},
            amplitude=0.5, reach=0.5, spread=0.4,
        ),
        Robot(
            "hopper", "gymnasium:Hopper-v5", "hopper.xml", 0.008,
            {"body_mass[torso]": (2.5, 5.0)}, {"dof_damping[thigh_joint]": (0.5, 2.0)},
            amplitude=0.4, reach=0.3, spread=0.01, refinement=1, steps=(120, 160),
        ),
        Robot(
            "half_cheetah", "gymnasium:HalfCheetah-v5", "half_cheetah.xml", 0.05,
            {"body_mass[torso]": (4.5, 9.0)}, {"dof_damping[bthigh]": (3.0, 10.0)},
            amplitude=0.5, reach=0.3, spread=0.05, refinement=1, steps=(60, 80),
        ),
        Robot(
            "fetch_push", SIMULATOR, "", 0.04,
            {"body_mass[object0]": (1.2, 3.2)}, {},
            amplitude=1.0, reach=0.0, spread=0.0, refinement=1, steps=(45, 60),
            commands=COMMANDS, noise=NOISE, effects=EFFECTS,
        ),
    )
}  # fmt: skip


def nominal_model(robot: Robot) -> mujoco.MjModel:
    """Return the model that the diagnosis is given, in its nominal physics."""
    if robot.commands:
        return fetch_push_model()
    if robot.xml.endswith(".xml"):
        folder = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
        return mujoco.MjModel.from_xml_path(str(folder / robot.xml))
    return mujoco.MjModel.from_xml_string(robot.xml)


def _place(entry: str) -> tuple[str, str]:
    found = re.fullmatch(r"(body_mass|dof_damping)\[(\w+)\]", entry)
    if found is None:
        raise ValueError(f"expected body_mass[BODY] or dof_damping[JOINT], got {entry!r}")
    return found[1], found[2]


def entry_value(model: mujoco.MjModel, entry: str) -> float:
    """Return a parameter of the model."""
    kind, name = _place(entry)
    if kind == "body_mass":
        return float(model.body(name).mass[0])
    return float(model.dof_damping[model.joint(name).dofadr[0]])


def write_entry(model: mujoco.MjModel, entry: str, value: float) -> None:
    """Set a parameter; a body's inertia scales with its mass."""
    kind, name = _place(entry)
    if kind == "body_mass":
        body = model.body(name).id
        model.body_inertia[body] *= value / model.body_mass[body]
        model.body_mass[body] = value
        mujoco.mj_setConst(model, mujoco.MjData(model))
    else:
        model.dof_damping[model.joint(name).dofadr[0]] = value
