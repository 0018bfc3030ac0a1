"""Masses, places and lengths of bodies, and the direction of gravity.

Strengths add to the model's own values or scale them. Only bodies that move have targets.
"""

from __future__ import annotations

__all__ = ["ComShift", "GravityTilt", "LinkLength", "Payload", "TimeScale"]

import math
from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import message
from .effect import Effect, Fields, ModelEffect, Reach
from .robot import Robot

_ALONG = 1e-3  # of a length: how far a body's end may lie beside its axis


class Payload(ModelEffect):
    """Mass ``s`` is added to a body, spread as its own or at its far end; kg, up to its mass.

    Spread, the inertia grows in proportion. At the end, as in a gripper, it is a point at
    ``r = c − a`` from the centre of mass ``c``, as far again from the joint's anchor ``a``: the
    centre moves by ``r s / (m + s)``, and about it the inertia grows by
    ``(|r|² I − r rᵀ) m s / (m + s)`` (parallel axes). Bodies for which that is not along their
    principal axes have no end.

    What is held beside the end is at ``r + a w × r``, ``w`` the axis of the first hinge: in the
    plane in which the body swings. About other axes it then has products of inertia, which are
    left out.

    Args:
        at_end: Where it is.
        aside: ``a``, only at the end. A diagnosis fits it.

    Raises:
        ValueError: It is to be beside an end at which it is not.
    """

    name, unit, group = "payload", "kg", "inertia"

    def __init__(self, *, at_end: bool = False, aside: float = 0.0) -> None:
        if aside and not at_end:
            expected = "a payload that is aside at the end (spread ones are where the body is)"
            got = f"aside={aside:g}, at_end=False"
            raise ValueError(message(expected, got, hint="at_end=True"))
        self.at_end, self.aside = at_end, aside

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return both places."""
        del seconds
        return Payload(), Payload(at_end=True)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return how far aside it is, at the end."""
        del reach
        return {"aside": (0.02, -1.0, 1.0)} if self.at_end else {}

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of bodies that move and have a mass (and an end)."""
        return tuple(_name(robot, b) for b in self._bodies(robot))

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and the body's mass."""
        mass = _values([robot.require_model().body_mass[b] for b in self._bodies(robot)])
        return torch.zeros_like(mass), mass

    def joint(self, robot: Robot, target: int) -> int:
        """Return the joint that moves the body."""
        return _joint_of(robot, self._bodies(robot)[target])

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Add to the masses, and move the centres."""
        for i, body in enumerate(self._bodies(robot)):
            entry, added = ("body_mass", (body,)), strength[..., i]
            mass = fields[entry]
            inertia = [fields["body_inertia", (body, axis)] for axis in range(3)]
            fields[entry] = mass + added
            if not self.at_end:
                continue
            share, reach, arm = added / (mass + added), *_end(robot, body, self.aside)
            for axis in range(3):
                place, about = ("body_ipos", (body, axis)), ("body_inertia", (body, axis))
                fields[place] = fields[place] + share * float(reach[axis])
                further = float(arm @ arm - arm[axis] ** 2)
                fields[about] = inertia[axis] + share * mass * further

    def _bodies(self, robot: Robot) -> list[int]:
        heavy = _heavy(robot)
        return [b for b in heavy if _has_end(robot, b)] if self.at_end else heavy


class ComShift(ModelEffect):
    """The centre of mass moves by ``s`` along an axis of its body; m, up to 20 % of its length.

    Targets are a body and an axis: ``link x``. Bodies whose centre of mass MuJoCo takes to be
    their origin for good (``body_simple``) have none.
    """

    name, unit, group = "com_shift", "m", "inertia"

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of bodies with each axis."""
        return tuple(f"{_name(robot, b)} {a}" for b in self._bodies(robot) for a in "xyz")

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return ±20 % of the length of the rod that has the body's mass and inertia."""
        lengths = []
        for body in self._bodies(robot):
            inertia = (
                robot.require_model().body_inertia[body].max()
                / robot.require_model().body_mass[body]
            )
            lengths += 3 * [math.sqrt(12 * inertia)]
        return -0.2 * _values(lengths), 0.2 * _values(lengths)

    def joint(self, robot: Robot, target: int) -> int:
        """Return the joint that moves the body."""
        return _joint_of(robot, self._bodies(robot)[target // 3])

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Add to the places of the bodies' inertial frames."""
        for i, body in enumerate(self._bodies(robot)):
            for axis in range(3):
                entry = "body_ipos", (body, axis)
                fields[entry] = fields[entry] + strength[..., 3 * i + axis]

    def _bodies(self, robot: Robot) -> list[int]:
        return [b for b in _heavy(robot) if not robot.require_model().body_simple[b]]


class LinkLength(ModelEffect):
    """The distance of a body from the one that carries it is scaled: ``(1 + s) ℓ``; ±0.1.

    Only between bodies that both move; shapes and masses stay.
    """

    name, unit, group = "link_length", "fraction", "geometry"

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of the bodies at the links' ends."""
        return tuple(_name(robot, b) for b in self._bodies(robot))

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return ±0.1."""
        one = torch.ones(len(self._bodies(robot)), dtype=torch.float64)
        return -0.1 * one, 0.1 * one

    def joint(self, robot: Robot, target: int) -> int:
        """Return the joint that moves the link."""
        body = self._bodies(robot)[target]
        return _joint_of(robot, int(robot.require_model().body_parentid[body]))

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Scale the places of the bodies in their parents."""
        for i, body in enumerate(self._bodies(robot)):
            for axis in range(3):
                entry = "body_pos", (body, axis)
                fields[entry] = fields[entry] * (1 + strength[..., i])

    def _bodies(self, robot: Robot) -> list[int]:
        model = robot.model
        if model is None:
            return []
        return [
            b
            for b in _moving(robot)
            if model.body_weldid[model.body_parentid[b]] and model.body_pos[b].any()
        ]


class GravityTilt(ModelEffect):
    """Gravity is rotated by ``s`` about the world's x and y axes; rad, up to 0.35 (20°)."""

    name, unit, group = "gravity_tilt", "rad", "offset"

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the two axes, none without gravity."""
        gravity = robot.model is not None and robot.model.opt.gravity.any()
        return ("x", "y") if gravity else ()

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return ±20°."""
        del robot
        high = torch.full((2,), math.radians(20.0), dtype=torch.float64)
        return -high, high

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Rotate about x, then about y."""
        del robot
        x, y, z = (fields["opt.gravity", (axis,)] for axis in range(3))
        about_x, about_y = strength[..., 0], strength[..., 1]
        y, z = about_x.cos() * y - about_x.sin() * z, about_x.sin() * y + about_x.cos() * z
        x, z = about_y.cos() * x + about_y.sin() * z, about_y.cos() * z - about_y.sin() * x
        for axis, value in enumerate((x, y, z)):
            fields["opt.gravity", (axis,)] = value


class TimeScale(ModelEffect):
    """Time runs at another speed: the time step is ``(1 + s) h``; a fraction, −0.2 to 0.2."""

    name, unit, group = "time_scale", "fraction", "inertia"

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return ``all``."""
        return () if robot.model is None else ("all",)

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return ±0.2."""
        del robot
        return torch.tensor([-0.2]).double(), torch.tensor([0.2]).double()

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Scale the time step."""
        del robot
        fields["opt.timestep", ()] = fields["opt.timestep", ()] * (1 + strength[..., 0])


def _values(numbers: list[float]) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def _name(robot: Robot, body: int) -> str:
    return robot.require_model().body(body).name or f"body{body}"


def _moving(robot: Robot) -> list[int]:
    """Return the bodies that are not welded to the world."""
    model = robot.model
    return [] if model is None else [b for b in range(1, model.nbody) if model.body_weldid[b]]


def _heavy(robot: Robot) -> list[int]:
    return [b for b in _moving(robot) if robot.require_model().body_mass[b] > 0]


def _end(
    robot: Robot, body: int, aside: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ``r``, from a body's centre of mass to its end, in its own and its principal axes.

    Or to what is beside the end, by so many lengths of ``r``.
    """
    model = robot.require_model()
    anchor, axis = np.zeros(3), np.zeros(3)
    if model.body_jntnum[body]:
        first = int(model.body_jntadr[body])
        kinds = model.jnt_type[first : first + model.body_jntnum[body]]
        hinge = first + int((kinds == mujoco.mjtJoint.mjJNT_HINGE).argmax())
        anchor, axis = model.jnt_pos[first], model.jnt_axis[hinge]
    reach, arm, back = model.body_ipos[body] - anchor, np.zeros(3), np.zeros(4)
    reach = reach + aside * np.cross(axis, reach)
    mujoco.mju_negQuat(back, model.body_iquat[body])
    mujoco.mju_rotVecQuat(arm, reach, back)
    return reach, arm


def _has_end(robot: Robot, body: int) -> bool:
    """Return whether a body turns about something beside its centre, along a principal axis."""
    model = robot.require_model()
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    turns = mujoco.mjtJoint.mjJNT_HINGE in model.jnt_type[first : first + count]
    lengths = np.sort(np.abs(_end(robot, body)[1]))
    along = lengths[1] <= _ALONG * lengths[2]
    return bool(turns and lengths[2] > 0 and along and not model.body_simple[body])


def _joint_of(robot: Robot, body: int) -> int:
    """Return the hinge or slide nearest to a body, towards the world; -1 for none."""
    model = robot.require_model()
    while body:
        for dof in reversed(range(model.nv)):
            if model.dof_bodyid[dof] == body and dof in robot.dof_index:
                return robot.dof_index.index(dof)
        body = int(model.body_parentid[body])
    return -1
