"""Differences of states, and small steps from a state, where positions include rotations.

A position ``qpos`` may hold unit quaternions, which cannot be subtracted. Differences live in the
tangent space, ``nv`` numbers: ``difference(a, b)`` is the velocity that leads from ``a`` to ``b``
in one second, and ``displace(a, difference(a, b)) = b``; as MuJoCo's ``mj_differentiatePos`` and
``mj_integratePos``, but for whole batches.
"""

from __future__ import annotations

__all__ = ["Tangent"]

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)


class Tangent:
    """The tangent space of a model's positions.

    Example:
        >>> xml = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody>"
        >>> xml += "</mujoco>"
        >>> tangent = Tangent(mujoco.MjModel.from_xml_string(xml))
        >>> start = np.array([0.0, 0, 0, 1, 0, 0, 0])
        >>> turned = tangent.displace(start, np.array([0.0, 0, 0, np.pi / 2, 0, 0]))
        >>> turned.round(3)
        array([0.   , 0.   , 0.   , 0.707, 0.707, 0.   , 0.   ])
        >>> tangent.difference(start, turned).round(3)
        array([0.   , 0.   , 0.   , 1.571, 0.   , 0.   ])

    Args:
        model: The model.

    Attributes:
        size: Its dimension ``nv``.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._nq, self.size = model.nq, model.nv
        quaternions, plain_q, plain_v = [], [], []
        for joint in range(model.njnt):
            q, v, kind = model.jnt_qposadr[joint], model.jnt_dofadr[joint], model.jnt_type[joint]
            linear = {_FREE: 3, _BALL: 0}.get(int(kind), 1)
            plain_q += range(q, q + linear)
            plain_v += range(v, v + linear)
            if kind in (_FREE, _BALL):
                quaternions.append((q + linear, v + linear))
        self._quaternions = quaternions
        self._q, self._v = np.array(plain_q, dtype=int), np.array(plain_v, dtype=int)

    def difference(self, a: Array, b: Array) -> Array:
        """Return the tangent vector from ``a`` to ``b``, shapes ``(*, nq)`` to ``(*, nv)``."""
        result = np.empty((*np.broadcast_shapes(a.shape, b.shape)[:-1], self.size))
        result[..., self._v] = b[..., self._q] - a[..., self._q]
        for q, v in self._quaternions:
            conjugate = a[..., q : q + 4] * np.array([1.0, -1, -1, -1])
            turn = _product(conjugate, b[..., q : q + 4])
            result[..., v : v + 3] = _logarithm(turn)
        return result

    def displace(self, a: Array, step: Array) -> Array:
        """Return the position that ``step`` leads to from ``a``, ``(*, nq)`` and ``(*, nv)``."""
        shape = np.broadcast_shapes(a.shape[:-1], step.shape[:-1])
        result = np.broadcast_to(a, (*shape, self._nq)).copy()
        result[..., self._q] += step[..., self._v]
        for q, v in self._quaternions:
            turn = _exponential(step[..., v : v + 3])
            result[..., q : q + 4] = _product(result[..., q : q + 4], turn)
        return result


def _product(a: Array, b: Array) -> Array:
    """Return the product of quaternions ``(w, x, y, z)``."""
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], -1)


def _logarithm(quaternion: Array) -> Array:
    """Return the rotation vector, at most half a turn long."""
    quaternion = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternion[..., :1])
    return quaternion[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def _exponential(vector: Array) -> Array:
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    half = 0.5 * np.sinc(angle / (2 * np.pi))  # sin(angle / 2) / angle
    return np.concatenate([np.cos(angle / 2), vector * half], -1)
