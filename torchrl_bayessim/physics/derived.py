"""What MuJoCo derives from a model, such as inverse weights, without what the user says of it."""

from __future__ import annotations

__all__ = ["VIEW", "derive"]

from collections.abc import Iterable

import mujoco
import numpy as np

VIEW = ("center", "extent", "meansize", "meanmass")
"""Statistics that show the model in the viewer, and may be set in the XML."""


def derive(model: mujoco.MjModel, data: mujoco.MjData, keep: Iterable[str] = VIEW) -> None:
    """Call ``mj_setConst``, which leaves ``data`` at ``qpos0``, and keep some statistics.

    Example:
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><statistic extent='7'/><worldbody><body><joint/><geom size='.1'/></body>"
        ...     "</worldbody></mujoco>")
        >>> before = model.dof_invweight0.copy()
        >>> model.body_mass[1] *= 2
        >>> model.body_inertia[1] *= 2
        >>> derive(model, mujoco.MjData(model))
        >>> (before / model.dof_invweight0).round(6).tolist(), model.stat.extent
        ([2.0], 7.0)
    """
    before = {name: np.copy(getattr(model.stat, name)) for name in keep}
    mujoco.mj_setConst(model, data)
    for name, value in before.items():
        setattr(model.stat, name, value if value.ndim else float(value))
