"""Which column of a log holds which quantity of a MuJoCo model.

A joint has as many position columns as numbers in ``qpos`` (hinge and slide 1, ball 4, free 7, with
quaternions ``w, x, y, z``) and as many velocity columns as numbers in ``qvel`` (1, 3, 6; the
angular velocity of balls and free joints is in the frame of the body, as in MuJoCo). Measured
values are compared in the tangent space of the positions, where a rotation has three coordinates;
each measured tangent coordinate is a *channel*.
"""

from __future__ import annotations

__all__ = ["Channel", "Columns", "channels", "default_columns", "joint_names"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import mujoco

from ..envs.task import Task
from ..errors import message

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_POSITIONS = {_FREE: ("x", "y", "z", "qw", "qx", "qy", "qz"), _BALL: ("qw", "qx", "qy", "qz")}
_VELOCITIES = {_FREE: ("vx", "vy", "vz", "wx", "wy", "wz"), _BALL: ("wx", "wy", "wz")}


@dataclass(frozen=True)
class Columns:
    """Names of columns.

    Attributes:
        time: Seconds; ``None`` where rows follow each other at the control step.
        qpos: By joint, one name per number; joints that were not measured are missing.
        qvel: By joint; where missing, velocities are estimated from positions.
        ctrl: By actuator, of all actuators; of a task that converts its actions, by ``action0``
            and so on.
    """

    time: str | None
    qpos: Mapping[str, tuple[str, ...]]
    qvel: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    ctrl: Mapping[str, str] = field(default_factory=dict)

    def check(self, task: Task) -> None:
        """Check the names of joints and actuators against a simulator.

        Raises:
            ValueError: There is no such joint or actuator, one has another number of columns, an
                actuator or all positions are missing, or a column is named twice.
        """
        model = task.model
        joints, actuators = joint_names(model), task.action_names
        for kind, given in ("qpos", self.qpos), ("qvel", self.qvel):
            widths = _POSITIONS if kind == "qpos" else _VELOCITIES
            for joint, names in given.items():
                if joint not in joints:
                    raise ValueError(message(f"a joint in columns.{kind}", joint, available=joints))
                width = len(widths.get(int(model.jnt_type[joints.index(joint)]), "q"))
                if len(names) != width:
                    expected = f"{width} column(s) for joint {joint!r} in columns.{kind}"
                    raise ValueError(message(expected, list(names)))
        for actuator in self.ctrl:
            if actuator not in actuators:
                expected = "an actuator in columns.ctrl"
                raise ValueError(message(expected, actuator, available=actuators))
        missing = [name for name in actuators if name not in self.ctrl]
        if missing:
            raise ValueError(message("a column for every actuator", f"none for {missing[0]}"))
        if not self.qpos:
            expected = "the columns of at least one joint's position"
            raise ValueError(message(expected, "none", available=joints))
        used = self.used()
        twice = [name for name in used if used.count(name) > 1]
        if twice:
            raise ValueError(message("each column once", twice[0]))

    def used(self) -> list[str]:
        """Return the names of all columns."""
        names = [] if self.time is None else [self.time]
        for group in (*self.qpos.values(), *self.qvel.values()):
            names += group
        return names + list(self.ctrl.values())


class Channel(NamedTuple):
    """One measured coordinate: its name, the joint's number, and where it is among ``2 nv``."""

    name: str
    joint: int
    index: int


def joint_names(model: mujoco.MjModel) -> list[str]:
    """Return the joints' names, ``joint3`` for the nameless fourth."""
    return [model.joint(j).name or f"joint{j}" for j in range(model.njnt)]


def default_columns(task: Task) -> Columns:
    """Return columns that are named after joints and actuators, and ``time``.

    Example:
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body><joint name='knee'/><geom size='.1'/></body></worldbody>"
        ...     "<actuator><motor name='motor' joint='knee'/></actuator></mujoco>")
        >>> default_columns(Task(model=model, frame_skip=1)).used()
        ['time', 'knee position', 'knee velocity', 'motor']
    """
    model = task.model
    qpos, qvel = {}, {}
    for j, name in enumerate(joint_names(model)):
        kind = int(model.jnt_type[j])
        qpos[name] = tuple(f"{name} {c}" for c in _POSITIONS.get(kind, ("position",)))
        qvel[name] = tuple(f"{name} {c}" for c in _VELOCITIES.get(kind, ("velocity",)))
    return Columns("time", qpos, qvel, {name: name for name in task.action_names})


def channels(model: mujoco.MjModel, columns: Columns) -> list[Channel]:
    """Return the measured coordinates, positions first, in the order of the model.

    A channel has its column's name; of a quaternion there are three, ``JOINT rotation x``, ``y``,
    ``z``, in the frame of the body.

    Example:
        >>> ball = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body><joint name='hip' type='ball'/><geom size='.1'/></body>"
        ...     "</worldbody></mujoco>")
        >>> [channel.name for channel in channels(ball, Columns("t", {"hip": tuple("wxyz")}))]
        ['hip rotation x', 'hip rotation y', 'hip rotation z']
    """
    found = []
    for j, joint in enumerate(joint_names(model)):
        names: Sequence[str] = columns.qpos.get(joint, ())
        if len(names) > 1:
            names = (*names[:-4], *(f"{joint} rotation {axis}" for axis in "xyz"))
        found += [Channel(n, j, model.jnt_dofadr[j] + i) for i, n in enumerate(names)]
    for j, joint in enumerate(joint_names(model)):
        start = model.nv + model.jnt_dofadr[j]
        names = columns.qvel.get(joint, ())
        found += [Channel(n, j, start + i) for i, n in enumerate(names)]
    return [Channel(name, joint, int(index)) for name, joint, index in found]
