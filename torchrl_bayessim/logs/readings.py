r"""A log as it would be in other units or of other signs.

Scales are not tried one by one from a list of units: each is the factor :math:`f` of a log's
motion, or of its actions, that leaves least of the force which its motion takes, found on a grid of
:math:`10^{-4}` to :math:`10^4` and refined. It has the name of the unit next to it, within a tenth.
"""

from __future__ import annotations

__all__ = ["FACTOR", "Reading", "readings", "unclamped"]

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from .columns import joint_names
from .inverse_dynamics import Dynamics, Terms, dynamics
from .log import Log
from .system import System

_FACTORS = np.linspace(np.log(1e-4), np.log(1e4), 47)
_ALIKE = 0.1  # of a unit: degrees and gradians are as far apart
FACTOR = "by a factor of about"  # which says that it is no unit
_DIVERGED = 1e30  # of a misfit: as bad as any
_ROWS = 1000  # in which a factor is sought
_ANGLES = {np.pi / 180: "in degrees", np.pi / 200: "in gradians", 2 * np.pi: "in turns"}
_LENGTHS = {0.01: "in hundredths", 0.0254: "in inches"}
_THOUSANDTHS = {1e-3: "in thousandths"}
_ACTIONS = {0.01: "in hundredths", 1e3: "in thousands"}


class Reading(NamedTuple):
    """What a log would be: kind of the finding, columns and unit, and its forces at the joint."""

    kind: str
    text: str
    terms: Terms


def readings(
    one: Dynamics,
    joint: int,
    system: System,
    *,
    half: int,
    misfit: Callable[[Terms], float],
    least: float,
) -> Iterator[Reading]:
    """Yield a log of opposite signs, and in the units of its motion and actions that fit best.

    Args:
        one: The log.
        joint: Which moves it.
        system: The robot.
        half: See `dynamics`.
        misfit: Of the forces at the joint; infinite where they say nothing.
        least: Factor below which one that is of no unit may be of another gain or mass.
    """
    model, columns = system.task.model, system.columns
    dof, name = int(model.jnt_dofadr[joint]), joint_names(model)[joint]
    motion = " and ".join((*columns.qpos[name], *columns.qvel.get(name, ())))
    actions = " and ".join(columns.ctrl.values())
    kinds = model.jnt_type
    alike = np.flatnonzero(kinds == kinds[joint])
    sets = [alike] if len(alike) == 1 else [alike, np.array([joint])]

    def forces(log: Log) -> Terms:
        return dynamics(model, one.record, log, half).terms(dof)

    for joints in sets:
        log = _moved(one.log, joints, -1.0, model)
        yield Reading("motion_sign", f"{motion} of opposite sign", forces(log))
    log = replace(one.log, ctrl=-one.log.ctrl)
    yield Reading("action_sign", f"{actions} of opposite sign", forces(log))
    part = _first(one.log)
    found = []
    for joints in sets:
        factor = _best(lambda f, joints=joints: misfit(forces(_moved(part, joints, f, model))))
        terms = forces(_moved(one.log, joints, factor, model))
        found.append((misfit(terms), factor, terms))
    _, factor, terms = min(found, key=lambda each: each[0])
    hinge = kinds[joint] == mujoco.mjtJoint.mjJNT_HINGE
    units = _THOUSANDTHS | (_ANGLES if hinge else _LENGTHS)
    if text := _named(factor, units, least):
        yield Reading("motion_scale", f"{motion} {text}", terms)
    scaled = unclamped(one, system, half)
    factor = _best(lambda f: misfit(scaled(f).terms(dof)))
    if text := _named(factor, _THOUSANDTHS | _ACTIONS, least):
        log = replace(one.log, ctrl=factor * one.log.ctrl)
        yield Reading("action_scale", f"{actions} {text}", forces(log))


def unclamped(one: Dynamics, system: System, half: int) -> Callable[[float], Dynamics]:
    """Return what gives the forces of a log with all actions times a factor, beyond any limit."""
    model = copy(system.task.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    model.actuator_forcelimited[:] = 0
    full = dynamics(model, one.record, one.log, half)
    none = dynamics(model, one.record, replace(one.log, ctrl=0 * one.log.ctrl), half).forces[1]

    def scaled(factor: float) -> Dynamics:
        needed, actuated, *rest = full.forces
        return full._replace(forces=(needed, none + factor * (actuated - none), *rest))

    return scaled


def _moved(log: Log, joints: NDArray[np.intp], factor: float, model: mujoco.MjModel) -> Log:
    """Return a log with positions and velocities of joints times a factor."""
    qpos, qvel = log.qpos.clone(), log.qvel.clone()
    qpos[:, model.jnt_qposadr[joints]] *= factor
    qvel[:, model.jnt_dofadr[joints]] *= factor
    return replace(log, qpos=qpos, qvel=qvel)


def _first(log: Log) -> Log:
    parts = {name: getattr(log, name)[:_ROWS] for name in ("time", "qpos", "qvel", "ctrl")}
    return replace(log, **parts)


def _best(misfit: Callable[[float], float]) -> float:
    """Return the factor of the least misfit, 1 where it has none within the grid."""
    values = [misfit(float(np.exp(x))) for x in _FACTORS]
    best = int(np.argmin(values))
    if best in {0, len(values) - 1}:  # nothing is left of what hardly moves
        return 1.0
    near, step = _FACTORS[best], _FACTORS[1] - _FACTORS[0]
    bounds = (near - step, near + step)
    found: float = minimize_scalar(
        lambda x: min(misfit(float(np.exp(x))), _DIVERGED),
        bounds=bounds,
        method="bounded",
        options={"xatol": 1e-3},
    ).x  # pyright: ignore[reportAttributeAccessIssue]
    return float(np.exp(found))


def _named(factor: float, units: dict[float, str], least: float) -> str:
    """Return what a unit is called; nothing where it may be none."""
    unit = min(units, key=lambda one: abs(np.log(factor / one)))
    if abs(np.log(factor / unit)) < _ALIKE:
        return units[unit]
    if abs(np.log(factor)) < np.log(least):
        return ""
    wrong = "large" if factor < 1 else "small"
    return f"too {wrong} {FACTOR} {max(factor, 1 / factor):.2g}"
