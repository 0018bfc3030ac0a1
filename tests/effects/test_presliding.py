"""Dry friction that gives way before it slides, against Dahl's equation and dry friction."""

import math

import mujoco
import numpy as np
import pytest
import torch
from apparatus import driven
from scipy.integrate import solve_ivp

from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.forcing import Forcing
from torchrl_bayessim.effects.friction import PreslidingFriction
from torchrl_bayessim.effects.robot import robot_of
from torchrl_bayessim.envs.task import Readings, Task

INERTIA, FRICTION = 0.05, 0.4  # kg m², N m
WHEEL = f"""<mujoco><option timestep="{{dt}}" gravity="0 0 0"/><worldbody><body>
  <joint name="axle" axis="0 0 1" damping="{{damping}}"/>
  <inertial pos="0 0 0" mass="1" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/></body></worldbody>
  <actuator><motor name="motor" joint="axle" ctrlrange="-2 2"/></actuator></mujoco>"""


def wheel(dt, damping=0.0):
    return mujoco.MjModel.from_xml_string(WHEEL.format(dt=dt, damping=damping))


def turned(model, laws, torque, seconds):
    """Return the angles of a wheel that rubs, at the ends of time steps."""
    dt = model.opt.timestep
    commands = np.array([[torque(k * dt)] for k in range(round(seconds / dt))])
    active = [(law, torch.tensor([FRICTION]).double()) for law in laws]
    robot = robot_of(Task(model=model, frame_skip=1))
    return np.array([data.qpos[0] for data in driven(model, robot, active, commands)])


def to_and_fro(t):
    """Return a torque that turns the wheel one way and the other."""
    return 1.2 * FRICTION * math.sin(5 * t) + 0.3 * math.sin(13 * t)


def solved(rates, seconds, dt):
    """Return the angles of the differential equation of angle, speed and bristles, from rest."""
    ends = np.arange(1, round(seconds / dt) + 1) * dt
    found = solve_ivp(
        rates, (0, seconds), [0, 0, 0], t_eval=ends, rtol=1e-9, atol=1e-10, method="LSODA"
    )
    return found.y[0]


@pytest.mark.parametrize("share", [0.2, 0.7])
def test_what_sticks_gives_way_by_as_much_as_dahl_says(share):
    way = 0.03
    law = effect("coulomb_friction", presliding=way)
    angles = turned(wheel(0.001, damping=1.5), [law], lambda _: share * FRICTION, 6.0)
    assert angles[-1] == pytest.approx(-way * math.log(1 - share), rel=1e-3)


@pytest.mark.parametrize("way", [0.005, 0.1])
def test_a_wheel_follows_the_differential_equation(way):
    def rates(t, state):
        _, v, z = state
        held = FRICTION * z / way
        return v, (to_and_fro(t) - held) / INERTIA, v - abs(v) * z / way

    seconds, dt = 2.0, 0.0005
    true = solved(rates, seconds, dt)
    law = effect("coulomb_friction", presliding=way)
    angles = turned(wheel(dt), [law], to_and_fro, seconds)
    largest = np.abs(true).max()
    assert np.abs(angles - true).max() < 0.01 * largest
    other = turned(wheel(dt), [PreslidingFriction(2 * way)], to_and_fro, seconds)
    assert np.abs(other - true).max() > 0.02 * largest


@pytest.mark.parametrize(("speed", "kinetic"), [(0.2, 0.0), (0.6, 0.0), (0.2, 0.3)])
def test_a_wheel_whose_friction_fades_follows_the_differential_equation(speed, kinetic):
    way = 0.02

    def rates(t, state):
        _, v, z = state
        level = way * (kinetic + (1 - kinetic) * math.exp(-((v / speed) ** 2)))
        bent = v - abs(v) * z / level if level > 1e-6 * way else -1e3 * z
        return v, (to_and_fro(t) - FRICTION * z / way) / INERTIA, bent

    seconds, dt = 1.0, 0.0005
    true = solved(rates, seconds, dt)
    largest = np.abs(true).max()
    law = effect("stribeck_friction", speed=speed, presliding=way, kinetic=kinetic)
    angles = turned(wheel(dt), [law], to_and_fro, seconds)
    assert np.abs(angles - true).max() < 0.01 * largest
    for form, least in (({"presliding": 0.0}, 0.05), ({"kinetic": kinetic + 0.1}, 0.03)):
        another = effect("stribeck_friction", **{**law.form, **form})
        other = turned(wheel(dt), [another], to_and_fro, seconds)
        assert np.abs(other - true).max() > least * largest


def test_ways_that_no_time_step_resolves_are_none():
    assert effect("stribeck_friction", presliding=4e-4) == effect("stribeck_friction")
    least = effect("stribeck_friction", presliding=5e-4)
    assert least.form == {"speed": 0.2, "presliding": 5e-4, "kinetic": 0.0}

    def torque(t):
        return 2 * FRICTION * math.sin(5 * t)

    dry = turned(wheel(0.001), [effect("stribeck_friction")], torque, 2.0)
    assert np.abs(turned(wheel(0.001), [least], torque, 2.0) - dry).max() < 0.05 * np.ptp(dry)


def test_what_friction_that_fades_may_not_be():
    with pytest.raises(ValueError, match="presliding, a way before friction slides"):
        effect("stribeck_friction", presliding=-0.1)
    with pytest.raises(ValueError, match="speed at which friction fades"):
        effect("stribeck_friction", speed=0.0)
    for share in (-0.1, 1.1):
        with pytest.raises(ValueError, match="kinetic, a share of friction"):
            effect("stribeck_friction", kinetic=share)


def test_bristles_that_spring_back_as_friction_fades_do_not_drive_the_joint():
    """Bent by all of the way at rest, and moving fast at once: negative damping otherwise."""
    law, now = effect("stribeck_friction", presliding=0.01), torch.tensor([[0.3]]).double()
    state = Readings(qpos=now, qvel=now, ctrl=now, time=now)
    forcing = Forcing(robot_of(Task(model=wheel(0.001), frame_skip=1)))
    active = [(law, torch.tensor([[FRICTION]]).double())]
    added, (memory,) = forcing(active, [{"bent": torch.tensor([[0.01]]).double()}], state)
    assert added["dof_damping"].item() == 0.0
    assert added["qfrc_applied"].item() == pytest.approx(-FRICTION * memory["bent"].item() / 0.01)
    assert 0.0 < memory["bent"].item() < 0.01


@pytest.mark.parametrize("dt", [0.001, 0.01])
def test_with_hardly_any_presliding_it_is_dry_friction(dt):
    def torque(t):
        return 2 * FRICTION * math.sin(5 * t)

    rubbing = wheel(dt)
    rubbing.dof_frictionloss[:] = FRICTION
    dry = turned(rubbing, [], torque, 2.0)
    law = effect("coulomb_friction", presliding=1e-5)
    angles = turned(wheel(dt), [law], torque, 2.0)
    assert np.abs(angles - dry).max() < 0.05 * np.ptp(dry)


def test_what_presliding_makes_of_the_name():
    law = effect("coulomb_friction", presliding=0.01)
    assert law == PreslidingFriction(0.01)
    assert law.name == "coulomb_friction"
    assert effect(law.name, **law.form) == law
    assert effect("coulomb_friction").forms(9.0) == (
        effect("coulomb_friction"),
        PreslidingFriction(),
    )
    with pytest.raises(ValueError, match="presliding, a way before friction slides"):
        effect("coulomb_friction", presliding=0.0)
    with pytest.raises(TypeError, match="speed"):
        effect("coulomb_friction", speed=1.0)


@pytest.mark.parametrize(
    "law", [PreslidingFriction(), effect("stribeck_friction", presliding=0.01)]
)
def test_without_strength_it_is_nothing(law):
    now = torch.tensor([[0.3], [0.0]]).double()
    state = Readings(qpos=now, qvel=now, ctrl=now, time=now)
    forcing = Forcing(robot_of(Task(model=wheel(0.01), frame_skip=1)))
    active = [(law, torch.zeros(2, 1).double())]
    added, _ = forcing(active, forcing.start(active, state), state)
    assert not any(values.any() for values in added.values())
