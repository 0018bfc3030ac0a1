r"""Which force at each joint would explain a segment's residual.

Over a few steps a force that is missing is nearly constant. With innovations :math:`r_s` of segment
:math:`s` and their derivatives :math:`P_s` with respect to a constant force at each joint, the
forces that explain most together, and each as if it were the only one, are

.. math::
    \hat f_s = -(P_s^\top P_s)^{-1} P_s^\top r_s, \qquad
    \hat f_{sj} = -P_{sj}^\top r_s / \|P_{sj}\|^2.

The second is the matched filter of one cause. About contacts, or where a robot's root counts as
joints too, what several forces do in a few steps is nearly the same: together they are ten times
less sure, while of several causes each alone is told what the others do.
"""

from __future__ import annotations

__all__ = ["Forces", "missing_forces"]

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .objective import Objective, Point, Unit

Array = NDArray[np.float64]
_SIZE = 0.05  # of the largest force, by which derivatives are taken


class Forces(NamedTuple):
    """Missing forces and how sure they are.

    About contacts the variances differ a thousandfold: a foot in the air shows a force that the
    same foot on the ground hides.

    Attributes:
        forces: In each segment, at each joint, shape ``(S, J)``.
        variances: Of these, where nothing but noise is beside them, shape ``(S, J)``.
    """

    forces: Array
    variances: Array


def missing_forces(
    objective: Objective, point: Point, pushes: Sequence[Unit]
) -> tuple[Forces, Forces]:
    """Return the constant forces that explain most of each segment, together and each alone.

    Args:
        objective: Segments and whitening.
        point: What is in the model already.
        pushes: A constant force at each of ``J`` joints.
    """
    sizes = [_SIZE * unit.high for unit in pushes]
    points = [point.more(u, s) for u, s in zip(pushes, sizes, strict=True)]
    innovations, *changed = objective([point, *points])
    slopes = (np.stack(changed) - innovations) / np.array(sizes)[:, None, None]
    normal = np.einsum("ism,jsm->sij", slopes, slopes)
    ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None] + 1e-12
    right = -np.einsum("ism,sm->si", slopes, innovations)
    covariance = np.linalg.inv(normal + ridge[..., None] * np.eye(len(pushes)))
    together = np.einsum("sij,sj->si", covariance, right)
    alone = 1.0 / (np.diagonal(normal, axis1=1, axis2=2) + ridge)
    return (
        Forces(together, np.diagonal(covariance, axis1=1, axis2=2)),
        Forces(alone * right, alone),
    )
