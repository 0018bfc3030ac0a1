r"""Is one log in other units, or of other signs, than the rest?

What is wrong in all logs shows in each: a velocity that is not the rate of its position, actions
that push the wrong way. What is consistently wrong in one log only shows beside the others. At
every actuated joint the regression over the other logs (see `inverse_dynamics`) foretells the force
that this log's motion takes, and its *misfit* is what that leaves,

.. math:: m = \frac{\operatorname{median} |y - \hat y|}
   {\operatorname{median} |y - c| + \operatorname{median} |\tau|} .

A log is named where its misfit is near 1 and just one other unit or sign brings it down to that of
the others, so that no payload, friction or push is taken for a unit: what many units would mend is
no matter of units. Actions that never change
are named where the motion takes about as much force as actuators exert in the other logs.
"""

from __future__ import annotations

__all__ = ["check_offsets", "check_units"]

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from .columns import joint_names
from .finding import Finding
from .inverse_dynamics import (
    Dynamics,
    Terms,
    actuated_joints,
    dynamics,
    fit_terms,
    moves,
    regressors,
)
from .kinematics import motions
from .log import Log
from .record import Record, plausible
from .system import System

Array = NDArray[np.float64]
_CLEAR = 3.0  # times what other logs leave
_MISFIT, _AGAINST = 0.5, 0.65  # of 1, where motion has nothing to do with actions, or is opposite
_ANGLES = {np.pi / 180: "in degrees", 2 * np.pi: "in turns", -1.0: "of opposite sign"}
_LENGTHS = {1e-3: "in thousandths", -1.0: "of opposite sign"}
_ACTIONS = {1e-3: "in thousandths", 1e3: "in thousands", -1.0: "of opposite sign"}
_FAR = 1e3  # m or rad, and times what is travelled, that logs may be apart


class _Others(NamedTuple):
    """What other logs say of a joint: coefficients, misfit, typical actuation, what is left."""

    added: Array
    misfit: float
    exerted: float
    left: float


def check_units(logs: Sequence[Dynamics], system: System, half: int) -> Iterator[Finding]:
    """Yield which logs are in other units than the rest, or hold no actions.

    Args:
        logs: With their forces, in windows of ``2 half + 1`` rows.
        system: The robot.
        half: See above.
    """
    if len({one.record.name for one in logs}) < 2:
        return
    model = system.task.model
    named: set[str] = set()
    for joint, dof in actuated_joints(model):
        fits = [fit_terms(one.terms(dof), half=half) for one in logs]
        for one in logs:
            known = [
                (other.terms(dof), fit.added)
                for other, fit in zip(logs, fits, strict=True)
                if fit is not None and other.record.name != one.record.name
            ]
            if not known or _few(one.terms(dof), half) or one.record.name in named:
                continue
            others = _others([terms for terms, _ in known], [added for _, added in known])
            if not 0.1 < 1 + others.added[0] < 10:  # it is they that are odd
                continue
            kind, text = _unit(one, joint, system, others=others, half=half)
            if kind:
                named.add(one.record.name)
                yield _whole(kind, one.record, text)


def _others(logs: Sequence[Terms], added: Sequence[Array]) -> _Others:
    common = np.median(added, axis=0)
    parts = np.median([_parts(terms, common) for terms in logs], axis=0)
    left, needed, exerted = (float(part) for part in parts)
    return _Others(common, left / (needed + exerted), exerted, left)


def _parts(terms: Terms, added: Array) -> tuple[float, float, float]:
    """Return medians of the force left, needed and exerted, where the joint moves."""
    needed, actuated, bias, speed = terms
    left = needed - actuated - bias - regressors(terms) @ added
    parts = (part[moves(speed)] for part in (left, needed - bias, actuated))
    sizes = [float(np.median(np.abs(part))) for part in parts]
    return sizes[0], sizes[1], sizes[2] + 1e-12


def _few(terms: Terms, half: int) -> bool:
    return len(terms[0]) < 20 * half or moves(terms[-1]).sum() < 4 * half


def _misfit(terms: Terms, added: Array) -> float:
    left, needed, exerted = _parts(terms, added)
    return left / (needed + exerted)


def _unit(
    one: Dynamics, joint: int, system: System, *, others: _Others, half: int
) -> tuple[str, str]:
    """Return the kind and text of what makes a log fit the others, or nothing."""
    model = system.task.model
    dof, name = int(model.jnt_dofadr[joint]), joint_names(model)[joint]
    own = _parts(one.terms(dof), others.added)
    misfit = own[0] / (own[1] + own[2])
    if misfit < max(_MISFIT, _CLEAR * others.misfit):
        return "", ""
    likely: dict[str, str] = {}
    for kind, text, log in _readings(one.log, joint, system):
        terms = dynamics(model, one.record, log, half).terms(dof)
        if kind.endswith("_sign") and misfit < _AGAINST:
            continue
        enough = min(misfit / 2, 1.5 * others.misfit + 0.05)
        if not _few(terms, half) and _misfit(terms, others.added) < enough:
            likely.setdefault(text, kind)
    if len(likely) == 1 or set(likely.values()) == {"motion_sign", "action_sign"}:
        text = f"{' or '.join(likely)}? Only so does {name} move as in the other logs"
        return next(iter(likely.values())), text
    still = np.ptp(one.log.ctrl.numpy(), axis=0).max(initial=0.0) == 0
    if still and own[0] > max(_CLEAR * others.left, 0.3 * others.exerted):
        names = " and ".join(system.columns.ctrl.values())
        text = f"{names} never changed, but {name} moves as if pushed: were actions recorded?"
        return "no_actions", text
    return "", ""


def _readings(log: Log, joint: int, system: System) -> Iterator[tuple[str, str, Log]]:
    """Yield a log as it would be in other units: kind, text, log."""
    model, columns = system.task.model, system.columns
    kinds = model.jnt_type
    name = joint_names(model)[joint]
    motion = " and ".join((*columns.qpos[name], *columns.qvel.get(name, ())))
    hinge = kinds[joint] == mujoco.mjtJoint.mjJNT_HINGE
    for factor, unit in (_ANGLES if hinge else _LENGTHS).items():
        for alike in (np.flatnonzero(kinds == kinds[joint]), np.array([joint])):
            qpos, qvel = log.qpos.clone(), log.qvel.clone()
            qpos[:, model.jnt_qposadr[alike]] *= factor
            qvel[:, model.jnt_dofadr[alike]] *= factor
            kind = "motion_sign" if factor < 0 else "motion_scale"
            yield kind, f"{motion} {unit}", replace(log, qpos=qpos, qvel=qvel)
    for factor, unit in _ACTIONS.items():
        kind = "action_sign" if factor < 0 else "action_scale"
        text = f"{' and '.join(columns.ctrl.values())} {unit}"
        yield kind, text, replace(log, ctrl=factor * log.ctrl)


def check_offsets(records: Sequence[Record], system: System) -> Iterator[Finding]:
    """Yield logs whose positions are absurdly far from those of all others."""
    known = [{m.name: m.position for m in motions(record, system)} for record in records]
    for name in known[0]:
        places = [values[name][plausible(values[name])] for values in known]
        centres = np.array([np.median(v) if len(v) else np.nan for v in places])
        far = _FAR * max(1.0, *(float(np.ptp(v)) for v in places if len(v)), 0.0)
        for i, (record, centre) in enumerate(zip(records, centres, strict=True)):
            away = np.abs(np.delete(centres, i) - centre)
            away = away[np.isfinite(away)]
            if len(away) > 1 and np.median(away) > far and (away > far / 2).all():
                text = f"{name} is {np.median(away):.3g} from where it is in other logs"
                yield _whole("offset", record, f"{text}: another zero?")


def _whole(kind: str, record: Record, text: str) -> Finding:
    rows = 0, len(record) - 1
    return Finding(kind=kind, file=record.name, rows=rows, message=text, severity="error")
