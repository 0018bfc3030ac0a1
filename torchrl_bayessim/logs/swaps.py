r"""Are the columns of actions in another order than the actuators?

At every joint that one actuator moves, the regression of `inverse_dynamics` is fitted to a log with
the actuator's own column :math:`a`, and with those of the others, at its own gain,

.. math:: \tau_k = \tau_a + g_a (\bar u_k - \bar u_a) .

A log is named where another order of its columns leaves less at each of the joints that it
concerns, and less than half on (geometric) average, by factors of the actuators near 1. Columns in
order leave several times less than any other. Where half of the logs, or more, say the same, all
are named at once.
"""

from __future__ import annotations

__all__ = ["check_swaps"]

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from .finding import Finding
from .inverse_dynamics import Dynamics, Fit, actuated_joints, fit_terms, held, moves
from .system import System

Array = NDArray[np.float64]
Order = dict[int, int]
_SOME = 0.05  # of the force that the motion takes, which own columns leave
_LESS, _HALF = 0.8, 0.5  # of what own columns leave, at each joint and on average
_NEAR = 3.0  # times the force in the model, or a third of it


def check_swaps(logs: Sequence[Dynamics], system: System, half: int) -> Iterator[Finding]:
    """Yield what logs have their actions in another order, or that all have.

    Args:
        logs: With their forces, in windows of ``2 half + 1`` rows.
        system: The robot.
        half: See above.
    """
    places = _places(system.task.model)
    orders = [_order(one, places, system.task.model, half) for one in logs]
    for order in orders:
        if order and 2 * orders.count(order) >= len(orders):
            yield _finding(order, system)
            return
    named: set[str] = set()
    for one, order in zip(logs, orders, strict=True):
        if order and one.record.name not in named:
            named.add(one.record.name)
            yield _finding(order, system, one)


def _places(model: mujoco.MjModel) -> dict[int, int]:
    """Return the degrees of freedom that one actuator moves by a constant gain, by actuator."""
    dofs = dict(actuated_joints(model))
    on_joints = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    joints = np.where(on_joints, model.actuator_trnid[:, 0], -1).tolist()
    constant = model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED
    return {
        i: dofs[joint]
        for i, joint in enumerate(joints)
        if constant[i] and joint in dofs and joints.count(joint) == 1
    }


def _order(one: Dynamics, places: dict[int, int], model: mujoco.MjModel, half: int) -> Order:
    """Return whose column each actuator needs, of those that need another's; nothing if unclear."""
    if len(places) < 2:
        return {}
    own = {i: _fit(one, (i, i), dof, model=model, half=half) for i, dof in places.items()}
    odd = [i for i, fit in own.items() if fit and _left(one, places[i], fit) > _SOME]
    found, ratios = {}, []
    for i in odd:
        fits = {k: _fit(one, (i, k), places[i], model=model, half=half) for k in odd}
        known = {k: fit for k, fit in fits.items() if fit is not None}
        best = min(known, key=lambda k: known[k].spread)
        ratio = known[best].spread / known[i].spread
        if ratio < _LESS and 1 / _NEAR < known[best].slope < _NEAR:
            found[i] = best
            ratios.append(ratio)
    clear = ratios and np.mean(np.log(ratios)) < np.log(_HALF)
    return found if clear and set(found) == set(found.values()) else {}


def _fit(
    one: Dynamics, columns: tuple[int, int], dof: int, *, model: mujoco.MjModel, half: int
) -> Fit | None:
    """Fit the force at an actuator's degree of freedom, its own column replaced by another."""
    own, other = columns
    needed, actuated, *rest = one.terms(dof)
    if own != other:
        ctrl, gear = one.log.ctrl.numpy(), model.actuator_gear[own, 0]
        low, high = np.inf * np.array([-1.0, 1.0])
        if model.actuator_ctrllimited[own]:
            low, high = model.actuator_ctrlrange[own]
        change = ctrl[:, other].clip(low, high) - ctrl[:, own].clip(low, high)
        force = gear * model.actuator_gainprm[own, 0] * held(change, half)
        actuated = actuated + force[one.free]
    return fit_terms((needed, actuated, *rest), half=half)


def _left(one: Dynamics, dof: int, fit: Fit) -> float:
    """Return the share of the force that the motion takes which a fit leaves."""
    needed, _, bias, speed = one.terms(dof)
    moving = moves(speed)
    left, whole = np.abs(fit.residual[moving]), np.abs(needed - bias)[moving]
    return float(np.median(left) / (np.median(whole) + 1e-12))


def _finding(order: Order, system: System, one: Dynamics | None = None) -> Finding:
    names = system.task.action_names
    *first, last = (system.columns.ctrl[names[i]] for i in sorted(order))
    what = "swapped" if len(order) == 2 else "in another order"
    text = f"actions {', '.join(first)} and {last} {what}? Only so do they explain the motion"
    return Finding(
        kind="action_order",
        file=one.record.name if one else "",
        rows=(0, len(one.record) - 1) if one else (0, 0),
        message=text if one else f"{text}, in most logs",
        severity="error",
    )
