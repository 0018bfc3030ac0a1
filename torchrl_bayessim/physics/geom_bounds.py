"""The volumes by which MuJoCo looks for collisions, where geoms have grown or moved.

Before two geoms are tested, their bounding spheres (``geom_rbound``) must meet, and the boxes of
their bodies' trees (``bvh_aabb``, in the frame of the body's inertia, whose leaves contain the
geoms' own boxes ``geom_aabb``), within the largest margin of the body's geoms (``body_margin``).
The compiler computes all these and nothing else does: a geom that grew or moved without them would
pass through others.
"""

from __future__ import annotations

__all__ = ["fit_bounds"]

from collections.abc import Iterable
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import PhysicsError, message
from .consequences import BOUNDS

_Vector = NDArray[np.float64]
_Place = tuple[str, tuple[int, ...]]
_QUATERNIONS = "body_quat", "body_iquat", "geom_quat", "site_quat"
_MARGINS = "geom_margin", "geom_gap"


class _Models(Protocol):
    model: mujoco.MjModel

    def read(self, field: str, indices: tuple[int, ...]) -> _Vector: ...
    def put(
        self, field: str, indices: tuple[int, ...], values: _Vector, rows: NDArray[np.bool_]
    ) -> None: ...


def fit_bounds(models: _Models, written: Iterable[_Place], rows: NDArray[np.bool_]) -> None:
    """Let the bounds follow the entries that were ``written``, in the environments ``rows``.

    Raises:
        PhysicsError: A quaternion among them is not of unit length.
    """
    model = models.model
    places = {(field, indices[0]) for field, indices in written if indices}
    for field, row in places:
        if field in _QUATERNIONS:
            _check_unit(models, field, row, rows)
    bounded = {(field, row) for field, row in places if field in BOUNDS}
    for geom in sorted({row for field, row in bounded if field == "geom_size"}):
        size = _read(models, "geom_size", geom, range(3))
        extents, radius = _bounds(mujoco.mjtGeom(model.geom_type[geom]), size)
        models.put("geom_rbound", (geom,), radius, rows)
        _write(models, ("geom_aabb", geom, 3), extents, rows)
    bodies: dict[int, set[str]] = {}
    for field, row in sorted(bounded):
        body = row if field.startswith("body") else int(model.geom_bodyid[row])
        bodies.setdefault(body, set()).add(field)
    for body, fields in bodies.items():
        if not fields.isdisjoint(_MARGINS):
            geoms = np.flatnonzero(model.geom_bodyid == body).tolist()
            margins, gaps = (
                np.stack([models.read(field, (g,)) for g in geoms]) for field in _MARGINS
            )
            models.put("body_margin", (body,), (margins + gaps).max(axis=0), rows)
        if not fields <= set(_MARGINS):
            _fit_tree(models, body, rows)


def _check_unit(models: _Models, field: str, row: int, rows: NDArray[np.bool_]) -> None:
    length = np.linalg.norm(_read(models, field, row, range(4)), axis=0)[rows]
    if (np.abs(length - 1.0) > 1e-5).any():
        hint = "set all four numbers"
        got = float(length[np.abs(length - 1.0).argmax()])
        raise PhysicsError(message(f"{field}[{row}] of length 1", got, hint=hint))


def _fit_tree(models: _Models, body: int, rows: NDArray[np.bool_]) -> None:
    """Refit the tree of boxes of one body."""
    model = models.model
    first = model.body_bvhadr[body]
    if first < 0:
        return
    frame = (
        _matrix(_read(models, "body_iquat", body, range(4))),
        _read(models, "body_ipos", body, range(3)),
    )
    # Children come after their parents: from the last node to the root.
    for node in reversed(range(first, first + model.body_bvhnum[body])):
        if model.bvh_nodeid[node] >= 0:
            box = _geom_box(models, model.bvh_nodeid[node], frame)
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
    extents, radius = shapes[kind]
    return np.stack(extents), radius


def _matrix(quaternion: _Vector) -> _Vector:
    """Return rotation matrices, ``(4, N) -> (3, 3, N)``."""
    w, x, y, z = quaternion
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def _geom_box(models: _Models, geom: int, frame: tuple[_Vector, _Vector]) -> _Vector:
    """Return centre and half extents of a geom in its body's inertial frame, shape ``(6, N)``."""
    inertial, centre = frame
    local = _matrix(_read(models, "geom_quat", geom, range(4)))
    box = _read(models, "geom_aabb", geom, range(6))
    rotation = np.einsum("jin,jkn->ikn", inertial, local)
    offset = _read(models, "geom_pos", geom, range(3)) - centre
    middle = np.einsum("jin,jn->in", inertial, offset) + np.einsum("ijn,jn->in", rotation, box[:3])
    return np.concatenate([middle, np.einsum("ijn,jn->in", np.abs(rotation), box[3:])])


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
        models.put(field, (int(row), column), value, rows)
