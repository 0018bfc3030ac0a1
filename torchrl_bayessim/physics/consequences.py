"""What follows from an entry of a MuJoCo model, and which entries cannot be set: one table.

MuJoCo's compiler works out more than it is asked for: constants, short cuts, bounding volumes.
Whoever writes an entry of the finished model has to bring these up to date, or is refused where
that is impossible, or where the entry would have no effect.

=====================  ==============================================================  ============
what follows           from what                                                       what is done
=====================  ==============================================================  ============
constants              `CONSTANTS` (engine_setconst.c)                                 mj_setConst
bounds of geoms        `BOUNDS`: sizes, places and margins of geoms, frames of         `geom_bounds`
                       inertias, in which the trees of boxes are given
copied frames          places of frames that coincide with another                     `frames`
skipped computations   `SKIPPED`: not computed while all are zero in the model         `frames`
simple bodies          `_SIMPLE`: their mass matrix is taken to be constant            refused
sparsity               `_SPARSE`: the compiler has left no room if zero                refused
nothing                `idle`: no limit, muscle, friction, … in the model               refused
what is itself so      `RESULTS`                                                       refused
=====================  ==============================================================  ============
"""

from __future__ import annotations

__all__ = [
    "BOUNDS",
    "CONSTANTS",
    "DERIVED_FROM",
    "RESULTS",
    "SKIPPED",
    "check_settable",
    "check_values",
    "lowest",
]

from collections.abc import Container

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import PhysicsError, message
from .idle import Place, check_acts

SKIPPED = frozenset({
    "body_gravcomp", "geom_surfacevel", "geom_adhesion", "pair_adhesion",
    "actuator_damping", "actuator_dampingpoly", "actuator_armature",
})  # fmt: skip
CONSTANTS = SKIPPED | {
    "body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat",
    "dof_armature", "jnt_pos", "jnt_axis", "site_pos", "site_quat", "geom_pos", "geom_size",
    "actuator_gear", "actuator_cranklength", "tendon_stiffness", "tendon_damping",
    "tendon_armature", "eq_data",
}  # fmt: skip
BOUNDS = frozenset({
    "geom_size", "geom_pos", "geom_quat", "geom_margin", "geom_gap", "body_ipos", "body_iquat",
})  # fmt: skip
DERIVED_FROM = CONSTANTS | BOUNDS
"""Fields whose writing must be followed by a refresh."""
RESULTS = frozenset({
    "body_subtreemass", "body_invweight0", "body_margin", "dof_invweight0", "dof_M0",
    "dof_length", "geom_rbound", "geom_aabb", "bvh_aabb", "tendon_length0", "tendon_invweight0",
    "actuator_acc0", "actuator_length0", "flexedge_length0", "flexedge_invweight0",
    "stat.meaninertia",
})  # fmt: skip
_SIMPLE = {"body_ipos", "body_iquat", "jnt_pos", "jnt_axis"}
_SPARSE = {"tendon_armature"}
_FREE = (
    mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_BOX,
)  # fmt: skip
_NOT_NEGATIVE = {
    "body_mass", "body_inertia", "dof_armature", "dof_frictionloss", "tendon_armature",
    "tendon_frictionloss", "geom_size", "geom_friction", "pair_friction", "opt.density",
    "opt.viscosity",
}  # fmt: skip
_POSITIVE = {"opt.timestep", "opt.impratio"}


def lowest(field: str) -> float:
    """Return the least value that the entries of a field may have.

    Example:
        >>> lowest("body_mass"), lowest("opt.gravity")
        (0.0, -inf)
    """
    if field in _POSITIVE:
        return float(np.finfo(np.float64).tiny)
    return 0.0 if field in _NOT_NEGATIVE else -np.inf


def check_values(place: tuple[str, tuple[int, ...]], values: NDArray[np.float64]) -> None:
    """Refuse values of an entry that are not finite, or negative where they cannot be.

    Raises:
        PhysicsError: One of them is.
    """
    good = np.isfinite(values) & (values >= lowest(place[0]))
    if not good.all():
        raise bad_value(place, float(values[good.argmin()]))


def bad_value(place: tuple[str, tuple[int, ...]], got: float) -> PhysicsError:
    """Return the error for a value that an entry cannot have."""
    field, indices = place
    kind = "finite" if np.isinf(lowest(field)) else "finite and not negative"
    kind = "finite and positive" if field in _POSITIVE else kind
    entry = field + (str(list(indices)) if indices else "")
    return PhysicsError(message(f"{entry} to be {kind}", got))


def check_settable(
    model: mujoco.MjModel,
    field: str,
    indices: tuple[int, ...],
    *,
    along: Container[Place] = (),
) -> None:
    """Refuse an entry that cannot be set, or to no effect without those that are set along.

    Raises:
        PhysicsError: The message says why, and what to do instead.
    """
    row = indices[0] if indices else 0
    if field in RESULTS:
        expected = "an entry that nothing else determines (MuJoCo computes this one)"
        raise PhysicsError(message(expected, field))
    if field in _SIMPLE:
        body = row if field.startswith("body") else int(model.jnt_bodyid[row])
        if model.body_simple[body]:
            hint = "give the body simple='false' in the MJCF"
            expected = f"a body whose mass matrix may change, to set {field}"
            raise PhysicsError(message(expected, model.body(body).name, hint=hint))
    if field in _SPARSE and not _nominal(model, field)[row]:
        hint = "a small one in the MJCF makes room in the mass matrix"
        raise PhysicsError(
            message(f"{field} that is not zero in the nominal model", row, hint=hint)
        )
    check_acts(model, (field, indices), along)
    override = model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE
    if field.startswith("opt.o_") and not override:
        hint = '<flag override="enable"/> in the MJCF'
        raise PhysicsError(
            message(f"a model that overrides contacts, to set {field}", "none", hint=hint)
        )
    if field == "geom_size" and (kind := mujoco.mjtGeom(model.geom_type[row])) not in _FREE:
        available = [shape.name for shape in _FREE]
        raise PhysicsError(message("a geom whose size is free", kind.name, available=available))


def _nominal(model: mujoco.MjModel, field: str) -> np.ndarray:
    return np.asarray(getattr(model, field))
