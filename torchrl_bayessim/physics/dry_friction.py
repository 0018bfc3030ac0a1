"""Dry friction that turns round with the velocity.

MuJoCo's ``dof_frictionloss`` is a soft constraint: with its reference ``a = −b v``, impedance ``d``
and ``J`` the inertia of a degree of freedom (``1 / dof_invweight0``, of the reference pose), its
force is that of Coulomb's law with the acceleration beside the velocity ::

    f = −s clip((b v + v̇) D / s, −1, 1),    D = J d / (1 − d).

With its defaults (a time constant of 20 ms, so that ``b`` is 105 /s, and ``d`` 0.9) friction turns
round where ``v = −v̇ / b``: 10 ms before the joint does. A joint that is driven to and fro is then
off by several times what a good encoder's noise is, however small the time step. With ``d`` 0.7
and a reference that would stop the joint within one time step ``h``, ``b = 1 / (d h)``, friction
turns round within ``d h``. What sticks creeps at up to ``s (1 − d) h / J``, a third of what
friction changes of the velocity in one time step: less than by default under time steps below 3 ms,
more above. Larger ``d`` creep less and turn round earlier: under the method of Runge and Kutta 0.5
is nearer to Coulomb's law, under Euler's at 10 ms there is little to choose.

Only where nobody has said how: degrees of freedom of which the model has no dry friction, and
MuJoCo's default time constant. To have friction that was found in an MJCF, write ``frictionloss``
with ``solreffriction="-1 -1/h"`` and ``solimpfriction="0.7 0.7"``.

Source: MuJoCo's documentation, Modeling, Solver parameters (``solreffriction`` in its direct
format, ``solimpfriction``).
"""

from __future__ import annotations

__all__ = ["FIELDS", "follow_velocity", "may_follow", "reference"]

from collections.abc import Collection, Mapping
from typing import TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Column = tuple[str, tuple[int, ...]]
_IMPEDANCE = 0.7  # d
_DIRECT = ("dof_solref", (0,)), ("dof_solref", (1,))
_IMPEDANCES = ("dof_solimp", (0,)), ("dof_solimp", (1,))
_DEFAULT = 0.02  # s, the time constant that a model has if nobody has said another
FIELDS = frozenset({"dof_frictionloss", "dof_solref", "dof_solimp"})
"""Fields of a model that dry friction in joints depends on."""


_A = TypeVar("_A", NDArray[np.float64], Tensor)


def may_follow(frictionloss: _A, time_constant: _A) -> _A:
    """Return where added dry friction may follow: there is none, and nobody has said how.

    Args:
        frictionloss: ``dof_frictionloss`` before anything is added, of any shape.
        time_constant: The first column of ``dof_solref``, likewise.

    Example:
        >>> may_follow(np.array([0.0, 0.1, 0.0]), np.array([0.02, 0.02, -1.0])).tolist()
        [True, False, False]
    """
    return (frictionloss == 0) & (time_constant == _DEFAULT)  # type: ignore[return-value]


def reference(timestep: float) -> Mapping[Column, float]:
    """Return what dry friction is to be solved with under a time step, s, by field and column.

    Example:
        >>> list(reference(0.002).values())
        [-1.0, -500.0, 0.7, 0.7]
    """
    # stiffness acts on a position that friction has not; MuJoCo divides the damping by d
    damping = dict(zip(_DIRECT, (-1.0, -1.0 / timestep), strict=True))
    return damping | dict.fromkeys(_IMPEDANCES, _IMPEDANCE)


def follow_velocity(model: mujoco.MjModel, *, but: Collection[int] = ()) -> None:
    """Let dry friction that is added to a model follow the velocity, where it has none of its own.

    Args:
        model: It is changed.
        but: Degrees of freedom that are left as they are.

    Example:
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body><joint/><geom size='0.1'/></body></worldbody></mujoco>")
        >>> follow_velocity(model)
        >>> model.dof_solref.tolist()
        [[-1.0, -500.0]]
    """
    free = may_follow(model.dof_frictionloss, model.dof_solref[:, 0])
    free &= ~np.isin(np.arange(model.nv), list(but))
    for (field, column), value in reference(float(model.opt.timestep)).items():
        getattr(model, field)[free, column[0]] = value
