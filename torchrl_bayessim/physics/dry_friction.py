"""Dry friction that turns round with the velocity, and not before.

MuJoCo's ``dof_frictionloss`` is a soft constraint: with its reference ``a = −b v``, impedance ``d``
and ``J`` the inertia that a degree of freedom has, its force is that of Coulomb's law ::

    f = −s clip((b v + v̇) D / s, −1, 1),    D = J d / (1 − d),

with the acceleration beside the velocity. With its defaults (a time constant of 20 ms, so that
``b`` is 105 /s, and ``d`` 0.9) friction turns round where ``v = −v̇ / b``: 10 ms before the joint
does. A joint that is driven to and fro is then off by several times what a good encoder's noise is,
however small the time step. With ``d`` 0.5 and a reference that would stop the joint within one
time step ``h``, ``b = 1 / (d h)``, it turns round within ``d h``, and what sticks creeps no faster
than at ``s h / J``: what friction changes of the velocity in one time step.

Source: MuJoCo's documentation, Modeling, Solver parameters (``solreffriction`` in its direct
format, ``solimpfriction``).
"""

from __future__ import annotations

__all__ = ["FIELDS", "follow_velocity", "reference"]

from collections.abc import Mapping

import mujoco

Column = tuple[str, tuple[int, ...]]
_IMPEDANCE = 0.5  # d: with less, friction lags under Euler's method; with more it leads
_REFERENCE = ("dof_solref", (0,)), ("dof_solref", (1,))
_IMPEDANCES = ("dof_solimp", (0,)), ("dof_solimp", (1,))
FIELDS = frozenset({"dof_frictionloss", "dof_solref", "dof_solimp"})
"""Fields of a model that dry friction in joints depends on."""


def reference(timestep: float) -> Mapping[Column, float]:
    """Return what dry friction is to be solved with under a time step, s, by field and column.

    Example:
        >>> list(reference(0.002).values())
        [-1.0, -500.0, 0.5, 0.5]
    """
    # stiffness acts on a position that friction has not; MuJoCo divides the damping by d
    damping = dict(zip(_REFERENCE, (-1.0, -1.0 / timestep), strict=True))
    return damping | dict.fromkeys(_IMPEDANCES, _IMPEDANCE)


def follow_velocity(model: mujoco.MjModel) -> None:
    """Let dry friction that is added to a model follow the velocity, where it has none of its own.

    Example:
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body><joint/><geom size='0.1'/></body></worldbody></mujoco>")
        >>> follow_velocity(model)
        >>> model.dof_solref.tolist()
        [[-1.0, -500.0]]
    """
    free = model.dof_frictionloss == 0
    for (field, column), value in reference(float(model.opt.timestep)).items():
        getattr(model, field)[free, column[0]] = value
