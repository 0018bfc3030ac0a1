"""Positions of a model as tangent coordinates: joints' as they are, rotations as vectors.

A free joint's orientation has three coordinates, the rotation vector from where the model's axes
are; those of hinges and slides are their positions.
"""

from __future__ import annotations

__all__ = ["coordinates", "displaced", "positions"]

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def coordinates(model: mujoco.MjModel, qpos: Array) -> Array:
    """Return the tangent coordinates of positions, ``(nq,)`` to ``(nv,)``."""
    y = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, y, 1.0, _origin(model), qpos)
    return y


def positions(model: mujoco.MjModel, y: Array) -> Array:
    """Return the positions of tangent coordinates, ``(nv,)`` to ``(nq,)``."""
    qpos = _origin(model)
    mujoco.mj_integratePos(model, qpos, y, 1.0)
    return qpos


def displaced(model: mujoco.MjModel, y: Array, step: Array) -> Array:
    """Return tangent coordinates after a small step from there, in the frame of each body."""
    qpos = positions(model, y)
    mujoco.mj_integratePos(model, qpos, step, 1.0)
    return coordinates(model, qpos)


def _origin(model: mujoco.MjModel) -> Array:
    """Return the positions whose coordinates are 0."""
    qpos = np.zeros(model.nq)
    qpos[model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE] + 3] = 1.0
    return qpos
