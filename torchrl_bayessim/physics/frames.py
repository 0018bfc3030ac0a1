"""Short cuts that MuJoCo takes for frames that coincide in the compiled model.

The frame of an inertia, a geom or a site that coincides with its body's, or with that of its body's
inertia, is copied from there: its own place is ignored (``mjtSameFrame``). Whoever writes the place
of a frame has to tell the model that the short cut no longer holds.
"""

from __future__ import annotations

__all__ = ["separate"]

import mujoco

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
        >>> model.geom_sameframe[0] == mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        True
    """
    if field not in _FLAGS:
        return
    none = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    getattr(model, _FLAGS[field])[row] = none
    if _FLAGS[field] == "body_sameframe":  # what coincided with the inertia stays where it is
        model.geom_sameframe[model.geom_bodyid == row] = none
        model.site_sameframe[model.site_bodyid == row] = none
