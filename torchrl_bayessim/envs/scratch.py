"""Where MuJoCo derives constants from the entries of a model."""

from __future__ import annotations

__all__ = ["Scratch", "derived_places"]

import copy

import mujoco
import numpy as np

from .addresses import SCALARS, attribute
from .fatal_errors import FAULT_SIZE

# What mj_setConst derives from masses, inertias and geometry (engine_setconst.c); the visual
# constants of cameras and lights, which it recomputes too, do not enter the dynamics.
_DERIVED = (
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "tendon_length0",
    "tendon_invweight0",
    "actuator_acc0",
    "actuator_length0",
    "flexedge_length0",
    "flexedge_invweight0",
    "stat.meaninertia",
)


def derived_places(model: mujoco.MjModel) -> list[tuple[str, tuple[int, ...]]]:
    """Return the numbers that mj_setConst derives: also where loops close (``eq_data``)."""
    places: list[tuple[str, tuple[int, ...]]] = []
    for field in _DERIVED:
        shape = () if field in SCALARS else np.shape(attribute(model, field))
        places += [(field, indices) for indices in np.ndindex(shape)]
    connects = model.eq_type == mujoco.mjtEq.mjEQ_CONNECT
    connects &= model.eq_objtype == mujoco.mjtObj.mjOBJ_BODY
    rows = np.flatnonzero(connects).tolist()
    return places + [("eq_data", (row, column)) for row in rows for column in (3, 4, 5)]


class Scratch:
    """What one thread refreshes with: a model and data of its own."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self.fault = np.zeros(FAULT_SIZE, dtype=np.uint8)
        addresses = self.fault.ctypes.data, self.model._address, self.data._address
        self.owned = np.array(addresses, dtype=np.int64)
        self.columns = np.empty(0, dtype=np.int64)  # addresses of the table's columns
        self.derived = self.columns  # which columns are derived from others
