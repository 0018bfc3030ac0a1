"""Short cuts that MuJoCo takes because of the nominal values of a model.

The frame of an inertia, a geom or a site that coincides with its body's, or with that of its body's
inertia, is copied from there: its own place is ignored (``mjtSameFrame``). And what is zero
everywhere, such as compensation of gravity, is not computed at all. Whoever writes such entries
has to tell the model that the short cut no longer holds.
"""

from __future__ import annotations

__all__ = ["separate", "unskip"]

from collections.abc import Iterable

import mujoco
import numpy as np

from .consequences import SKIPPED
from .derived import VIEW, derive

_FLAGS = {
    "body_ipos": "body_sameframe",
    "body_iquat": "body_sameframe",
    "geom_pos": "geom_sameframe",
    "geom_quat": "geom_sameframe",
    "site_pos": "site_sameframe",
    "site_quat": "site_sameframe",
}


def separate(model: mujoco.MjModel, field: str, row: int) -> None:
    """Let the frame in this row of a field move by itself; nothing for fields of other kinds.

    Example:
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body><geom size='.1'/></body></worldbody></mujoco>")
        >>> separate(model, "geom_pos", 0)
        >>> bool(model.geom_sameframe[0] == mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        True
    """
    if field not in _FLAGS:
        return
    none = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    getattr(model, _FLAGS[field])[row] = none
    if _FLAGS[field] == "body_sameframe":  # what coincided with the inertia stays where it is
        model.geom_sameframe[model.geom_bodyid == row] = none
        model.site_sameframe[model.site_bodyid == row] = none


def unskip(model: mujoco.MjModel, places: Iterable[tuple[str, tuple[int, ...]]]) -> None:
    """Let MuJoCo compute what entries in these places add, though they may be zero now.

    ``mj_setConst`` decides what is skipped, so it is called while they are not zero; all numbers
    are then what they were before.

    Example:
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body><geom size='.1'/></body></worldbody></mujoco>")
        >>> unskip(model, [("body_gravcomp", (1,))])
        >>> model.ngravcomp, model.body_gravcomp.tolist()
        (1, [0.0, 0.0])
    """
    skipped = [(field, indices) for field, indices in places if field in SKIPPED]
    if not skipped:
        return
    names = [name for name in dir(model) if isinstance(getattr(model, name), np.ndarray)]
    arrays = [getattr(model, name) for name in names]
    numbers = [array for array in arrays if np.issubdtype(array.dtype, np.floating)]
    before = [array.copy() for array in numbers]
    for field, indices in skipped:
        getattr(model, field)[indices] = 1.0
    derive(model, mujoco.MjData(model), keep=(*VIEW, "meaninertia"))
    for array, old in zip(numbers, before, strict=True):
        array[...] = old
