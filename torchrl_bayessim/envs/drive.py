"""How commands enter a simulation."""

from __future__ import annotations

__all__ = ["Drive", "Resolved", "resolved"]

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import message

Resolved = tuple[NDArray[np.int64], int, NDArray[np.int64], NDArray[np.int64], bool]
"""The same for compiled code: addresses of ``relative``, ``weld``, ``pinned`` and of sites read."""


@dataclass(frozen=True)
class Drive:
    """How a command enters the simulation, and what follows each control step.

    A command is ``ctrl`` (``nu`` numbers) and, with ``weld``, the step of the first mocap body
    from that body's present pose (3 + 4 numbers), which is how the Fetch arms are moved.

    Attributes:
        relative: Actuators whose control is added to the position of their joint.
        weld: The body that the mocap body drags.
        pinned: Joints whose position is set to zero after each control step; the places of bodies
            and sites, but no forces, are then evaluated anew.
        contact_forces: Compute ``cfrc_ext`` after each control step (``mj_rnePostConstraint``).
    """

    relative: tuple[int, ...] = ()
    weld: str | None = None
    pinned: tuple[str, ...] = ()
    contact_forces: bool = False


def resolved(model: mujoco.MjModel, drive: Drive, sites: list[str]) -> Resolved:
    """Return the ``drive`` argument of the kernels: names replaced by addresses."""
    relative = np.full(model.nu, -1, dtype=np.int64)
    for actuator in drive.relative:
        relative[actuator] = model.jnt_qposadr[model.actuator_trnid[actuator, 0]]
    if drive.weld is not None and not model.nmocap:
        expected = f"a model with a mocap body, to which {drive.weld!r} is welded"
        raise ValueError(message(expected, "none", hint='<body mocap="true"> in the MJCF'))
    weld = -1 if drive.weld is None else model.body(drive.weld).id
    pinned = [model.joint(name).qposadr[0] for name in drive.pinned]
    site_ids = [model.site(name[len("site_velocity[") : -1]).id for name in sites]
    return (
        relative,
        weld,
        np.array(pinned, dtype=np.int64),
        np.array(site_ids, dtype=np.int64),
        drive.contact_forces,
    )
