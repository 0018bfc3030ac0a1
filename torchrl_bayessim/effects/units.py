"""The unit of a strength at one target: hinges turn, slides move, sensors measure either."""

from __future__ import annotations

__all__ = ["slides", "unit_at"]

import mujoco

from .effect import Effect
from .robot import Robot

_OF_SLIDES = {
    "N m": "N",
    "N m s/rad": "N s/m",
    "N m s²/rad²": "N s²/m²",
    "N m/rad": "N/m",
    "kg m²": "kg",
    "rad": "m",
    "rad/(N m)": "m/N",
}


def unit_at(effect: Effect, robot: Robot, target: int) -> str:
    """Return the unit of an effect's strength at a target.

    Example:
        >>> from torchrl_bayessim.effects.catalogue import effect
        >>> from torchrl_bayessim.effects.robot import robot_of
        >>> from torchrl_bayessim.envs.tasks.catalogue import known_task
        >>> robot = robot_of(known_task("InvertedPendulum-v5"))
        >>> [unit_at(effect("coulomb_friction"), robot, i) for i in (0, 1)]
        ['N', 'N m']
    """
    joint = effect.joint(robot, target)
    if effect.unit.startswith("channel"):
        kind = robot.channel_kind[target]
        if kind not in {"position", "velocity"}:
            return effect.unit
        rates = (kind == "velocity") + effect.unit.endswith("/s")
        return ("m" if slides(robot, joint) else "rad") + ("", "/s", "/s²")[rates]
    if slides(robot, joint):
        return _OF_SLIDES.get(effect.unit, effect.unit)
    return effect.unit


def slides(robot: Robot, joint: int) -> bool:
    """Return whether a joint moves along a line."""
    if robot.model is None or joint < 0:
        return False
    number = robot.model.dof_jntid[robot.dof_index[joint]]
    return bool(robot.model.jnt_type[number] == mujoco.mjtJoint.mjJNT_SLIDE)
