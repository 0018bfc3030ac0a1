r"""Does a body turn as its angular velocity says?

Where the orientation of a free body or a ball and its angular velocity were both measured,
:math:`\int \omega\,dt` over a stretch of rows must be the turns from row to row, all in the frame
of the body. The three axes are compared together: with a quaternion in another order, or an angular
velocity in another frame, the angle is right and the axis is not.
"""

from __future__ import annotations

__all__ = ["check_rotations"]

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .columns import joint_names
from .finding import Finding
from .kinematics import meaning, over, stretch, white_noise
from .record import Record, usable_rows
from .system import System

Array = NDArray[np.float64]
_CLEAR = 10.0  # times the noise that a turn must be for what it says to count
_ALIKE = 0.8  # cosine; 0.99 of 80 tosses of a real cube, and of robots simulated with impacts
_FEWEST = 20  # rows
_GAP = 2.5  # times the usual step


def check_rotations(record: Record, system: System) -> Iterator[Finding]:
    """Yield what is wrong with the orientations and angular velocities of a record."""
    model, columns = system.task.model, system.columns
    known = usable_rows(record, system) & np.isfinite(record.time)
    rows = np.flatnonzero(known & (np.diff(record.time, prepend=-np.inf) > 0))
    for j, joint in enumerate(joint_names(model)):
        names = columns.qpos.get(joint, ())
        if len(names) < 4 or joint not in columns.qvel or len(rows) < _FEWEST:
            continue
        begin = model.jnt_qposadr[j] + len(names) - 4
        speed = model.jnt_dofadr[j] + len(names) - 4
        found = _disagreement(
            Rotation.from_quat(record.qpos[rows, begin : begin + 4], scalar_first=True),
            record.qvel[rows, speed : speed + 3],
            np.diff(record.time[rows]),
        )
        if found is not None:
            kind, text = found
            yield Finding(
                kind=kind,
                file=record.name,
                rows=(0, len(record) - 1),
                message=f"{joint} rotation: {text}",
                severity="error",
            )


def _disagreement(at: Rotation, speed: Array, steps: Array) -> tuple[str, str] | None:
    """Return the kind and the text of what is wrong, if anything is."""
    change = (at[:-1].inv() * at[1:]).as_rotvec()
    travelled = steps[:, None] * (speed[1:] + speed[:-1]) / 2
    gaps = steps > _GAP * np.median(steps)  # in which a body may turn by any number of turns
    change[gaps] = travelled[gaps] = 0.0
    span = stretch(steps, len(steps))
    turned, integrated = over(change, span), over(travelled, span)
    sizes = float(np.linalg.norm(turned)), float(np.linalg.norm(integrated))
    noises = (
        white_noise(np.cumsum(change, axis=0)),
        np.median(steps) * white_noise(speed) * span**0.5,
    )
    root = turned.size**0.5
    if any(size / root < _CLEAR * noise + 1e-9 for size, noise in zip(sizes, noises, strict=True)):
        return None
    cosine, ratio = float((turned * integrated).sum() / np.prod(sizes)), sizes[0] / sizes[1]
    if cosine < -_ALIKE:
        return "velocity_sign", "the angular velocity has the opposite sign"
    if cosine > _ALIKE:
        text = meaning(ratio)
        return ("velocity_scale", text) if text else None
    reach = min(10, len(turned) // 10)  # of filters, which delay a velocity
    late = (np.roll(integrated, lag, 0)[reach:-reach] for lag in range(-reach, reach + 1))
    inner = turned[reach:-reach]
    sums = [(inner * one).sum() / np.linalg.norm(inner) / np.linalg.norm(one) for one in late]
    if max(sums) > _ALIKE:
        return None
    hint = "quaternions are w, x, y, z, angular velocities in the frame of the body"
    return "velocity_mismatch", f"does not turn as its angular velocity says: {hint}"
