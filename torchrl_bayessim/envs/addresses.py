"""Where the numbers of a MuJoCo model are in memory."""

from __future__ import annotations

__all__ = ["SCALARS", "address", "attribute"]

from typing import Any

import mujoco
import numpy as np

# Scalars of mjOption and mjStatistic have no array in Python: their distance, in numbers, from
# one that has (the order of the structs in mjmodel.h).
SCALARS = {
    "opt.timestep": ("opt.gravity", -7),
    "opt.impratio": ("opt.gravity", -6),
    "opt.tolerance": ("opt.gravity", -5),
    "opt.ls_tolerance": ("opt.gravity", -4),
    "opt.noslip_tolerance": ("opt.gravity", -3),
    "opt.ccd_tolerance": ("opt.gravity", -2),
    "opt.density": ("opt.gravity", 9),
    "opt.viscosity": ("opt.gravity", 10),
    "opt.o_margin": ("opt.gravity", 11),
    "stat.meaninertia": ("stat.center", -4),
}


def attribute(model: mujoco.MjModel, field: str) -> Any:
    """Return a field of a model, its options or statistics, such as ``opt.gravity``."""
    value: Any = model
    for part in field.split("."):
        value = getattr(value, part)
    return value


def address(model: mujoco.MjModel, field: str, indices: tuple[int, ...]) -> int:
    """Return the address of one number of ``model``."""
    if field in SCALARS:
        anchor, offset = SCALARS[field]
        return np.asarray(attribute(model, anchor)).ctypes.data + 8 * offset
    array = np.asarray(attribute(model, field))
    return array.ctypes.data + sum(
        i * stride for i, stride in zip(indices, array.strides, strict=True)
    )
