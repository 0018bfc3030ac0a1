"""The volumes by which MuJoCo looks for collisions, for a geom whose size has changed.

Before two geoms are tested, their bounding spheres (``geom_rbound``) must meet, and the boxes of
their bodies' trees (``bvh_aabb``, whose leaves contain the geoms' own boxes ``geom_aabb``). The
compiler computes all three and nothing else does: a geom that grew without them would pass
through others.
"""

from __future__ import annotations

__all__ = ["fit_bounds"]

from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import PhysicsError, message

_Vector = NDArray[np.float64]


class _Models(Protocol):
    model: mujoco.MjModel

    def read(self, field: str, indices: tuple[int, ...]) -> _Vector: ...
    def write(
        self, field: str, indices: tuple[int, ...], values: _Vector, rows: NDArray[np.bool_]
    ) -> None: ...


def fit_bounds(models: _Models, geom: int, rows: NDArray[np.bool_]) -> None:
    """Let a geom's bounds follow its size.

    Raises:
        PhysicsError: The geom is a plane, a mesh, a height field or a signed distance field.
    """
    size = _read(models, "geom_size", geom, range(3))
    extents, radius = _bounds(mujoco.mjtGeom(models.model.geom_type[geom]), size)
    models.write("geom_rbound", (geom,), radius, rows)
    _write(models, ("geom_aabb", geom, 3), extents, rows)
    model = models.model
    body = model.geom_bodyid[geom]
    first = model.body_bvhadr[body]
    if first < 0:
        return
    # Children come after their parents: from the last node to the root.
    for node in reversed(range(first, first + model.body_bvhnum[body])):
        if model.bvh_nodeid[node] >= 0:
            box = _geom_box(models, model.bvh_nodeid[node])
        else:
            box = _union(*(_read(models, "bvh_aabb", c, range(6)) for c in model.bvh_child[node]))
        _write(models, ("bvh_aabb", node, 0), box, rows)


def _bounds(kind: mujoco.mjtGeom, size: _Vector) -> tuple[_Vector, _Vector]:
    """Return half extents, shape ``(3, N)``, and the radius of the sphere around."""
    x, y, z = size
    shapes = {
        mujoco.mjtGeom.mjGEOM_SPHERE: ((x, x, x), x),
        mujoco.mjtGeom.mjGEOM_CAPSULE: ((x, x, x + y), x + y),
        mujoco.mjtGeom.mjGEOM_CYLINDER: ((x, x, y), np.hypot(x, y)),
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: ((x, y, z), size.max(0)),
        mujoco.mjtGeom.mjGEOM_BOX: ((x, y, z), np.linalg.norm(size, axis=0)),
    }
    if kind not in shapes:
        available = [shape.name for shape in shapes]
        raise PhysicsError(message("a geom whose size is free", kind.name, available=available))
    extents, radius = shapes[kind]
    return np.stack(extents), radius


def _geom_box(models: _Models, geom: int) -> _Vector:
    """Return centre and half extents of a geom in its body's inertial frame, shape ``(6, N)``."""
    model = models.model
    body, inertial, local = model.geom_bodyid[geom], np.empty(9), np.empty(9)
    mujoco.mju_quat2Mat(inertial, model.body_iquat[body])
    mujoco.mju_quat2Mat(local, model.geom_quat[geom])
    to_inertial = inertial.reshape(3, 3).T
    rotation = to_inertial @ local.reshape(3, 3)
    box = _read(models, "geom_aabb", geom, range(6))
    offset = to_inertial @ (model.geom_pos[geom] - model.body_ipos[body])
    return np.concatenate([offset[:, None] + rotation @ box[:3], np.abs(rotation) @ box[3:]])


def _union(one: _Vector, two: _Vector) -> _Vector:
    low = np.minimum(one[:3] - one[3:], two[:3] - two[3:])
    high = np.maximum(one[:3] + one[3:], two[:3] + two[3:])
    return np.concatenate([(high + low) / 2, (high - low) / 2])


def _read(models: _Models, field: str, row: int, columns: range) -> _Vector:
    return np.stack([models.read(field, (int(row), column)) for column in columns])


def _write(
    models: _Models, start: tuple[str, int, int], values: _Vector, rows: NDArray[np.bool_]
) -> None:
    field, row, first = start
    for column, value in enumerate(values, first):
        models.write(field, (int(row), column), value, rows)
