r"""Is one log in other units, or of other signs, than the rest?

What is wrong in all logs shows in each: a velocity that is not the rate of its position, actions
that push the wrong way. What is consistently wrong in one log only shows beside the others. At
every actuated joint the regression over the other logs (see `inverse_dynamics`) foretells the force
that this log's motion takes, and its *misfit* is what that leaves,

.. math:: m = \frac{\operatorname{median} |y - \hat y|}
   {\operatorname{median} |y - c| + \operatorname{median} |\tau|} .

A log is named where its misfit is near 1 and another unit or sign, of its motion or of its actions,
brings it down to that of the others (see `readings`), so that no payload, friction or push is taken
for a unit: what both a unit and a sign would mend is no matter of either. So is a part of a log,
before or after the row where the misfit changes most, of a second or more. The others are those
whose motion takes about the force that their actuators exert, so half of the logs, or more, may be
odd. Actions that never change are named where the motion takes about as much force as actuators
exert in the other logs.

Not to be told are: all logs in other units (`forces` says what can be said of it), factors below 5,
which may be another gain or mass, units at joints that no actuator moves, and, where dynamics are
linear, whether it is the motion or the actions.
"""

from __future__ import annotations

__all__ = ["check_offsets", "check_units"]

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .columns import joint_names
from .finding import Finding
from .inverse_dynamics import (
    Dynamics,
    Terms,
    actuated_joints,
    fit_terms,
    moves,
    regressors,
)
from .kinematics import motions
from .readings import FACTOR, readings, unclamped
from .record import Record, plausible
from .system import System

Array = NDArray[np.float64]
_MISFIT, _AGAINST = 0.5, 0.65  # of 1, where motion has nothing to do with actions, or is opposite
_PUSHED = 0.3  # of what actuators exert in other logs
_KNOWN = 0.12  # misfit of others, beyond which they tell no factor but those of units
_OTHER = 5.0  # times another gain or mass that a factor must be which is of no unit
_FAR = 1e3  # m or rad, and times what is travelled, that logs may be apart


class _Others(NamedTuple):
    """What other logs say of a joint.

    Coefficients, misfit, typical actuation, what is left, and the largest action of each actuator.
    """

    added: Array
    misfit: float
    exerted: float
    left: float
    reach: Array


def check_units(logs: Sequence[Dynamics], system: System, half: int) -> Iterator[Finding]:
    """Yield which logs, or first or last parts of them, are in other units, or hold no actions.

    Args:
        logs: With their forces, in windows of ``2 half + 1`` rows.
        system: The robot.
        half: See above.
    """
    if len({one.record.name for one in logs}) < 2:
        return
    named: set[str] = set()
    for joint, dof in actuated_joints(system.task.model):
        fits = [fit_terms(one.terms(dof), half=half) for one in logs]
        for one in logs:
            known = [
                (other, fit.added)
                for other, fit in zip(logs, fits, strict=True)
                if fit is not None
                and 0.1 < fit.slope < 10  # or it is that one which is odd
                and other.record.name != one.record.name
            ]
            if not known or len(one.log) < 20 * half or one.record.name in named:
                continue
            others = _others([other for other, _ in known], dof, [added for _, added in known])
            for part in (one, *_odd_part(one, dof, others, half)):
                kind, text = _unit(part, joint, system, others=others, half=half)
                if kind:
                    named.add(one.record.name)
                    yield _part(kind, part, text)
                    break


def _odd_part(one: Dynamics, dof: int, others: _Others, half: int) -> Iterator[Dynamics]:
    """Yield the part, before or after the row where it changes most, beside which one fits."""
    if not one.free.any():
        return
    needed, actuated, bias, _ = terms = tuple(force[:, dof] for force in one.forces)
    left = np.abs(needed - actuated - bias - regressors(terms) @ others.added)
    left = np.where(one.free, np.minimum(left, 4 * others.left + np.median(left)), np.nan)
    level = np.nancumsum(left - np.nanmean(left))
    row = int(np.argmax(np.abs(level))) + 1
    parts = [_rows(one, rows) for rows in (slice(row), slice(row, None))]
    if any(_few(part.terms(dof), half) for part in parts):
        return
    misfits = [_misfit(part.terms(dof), others.added) for part in parts]
    if min(misfits) < 1.5 * others.misfit + 0.05:
        yield parts[int(np.argmax(misfits))]


def _rows(one: Dynamics, rows: slice) -> Dynamics:
    columns = {name: getattr(one.log, name)[rows] for name in ("time", "qpos", "qvel", "ctrl")}
    forces = tuple(force[rows] for force in one.forces)
    return Dynamics(one.record, replace(one.log, **columns), forces, one.free[rows])


def _others(logs: Sequence[Dynamics], dof: int, added: Sequence[Array]) -> _Others:
    common = np.median(added, axis=0)
    parts = np.median([_parts(log.terms(dof), common) for log in logs], axis=0)
    left, needed, exerted = (float(part) for part in parts)
    reach = np.median([_reach(log) for log in logs], axis=0)
    return _Others(common, left / (needed + exerted), exerted, left, reach)


def _reach(one: Dynamics) -> Array:
    return one.log.ctrl.abs().amax(0).numpy()


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


def _own(
    one: Dynamics, system: System, dof: int, *, others: _Others, half: int
) -> tuple[tuple[float, float, float], float]:
    """Return a log's medians (see `_parts`) and misfit.

    Actions that the model would clip count as they are, if those of the others are within limits.
    The misfit is 1 where most rows are at limits of joints: in its own units they may not be.
    """
    terms = one.terms(dof)
    if _few(terms, half):
        return (0.0, 0.0, 0.0), float(one.free.mean() < 0.5)
    model = system.task.model
    limit = 1.5 * np.abs(model.actuator_ctrlrange).max(1)
    limit[model.actuator_ctrllimited == 0] = np.inf
    if (_reach(one) > limit).any() and (others.reach <= limit).all():
        terms = unclamped(one, system, half)(1.0).terms(dof)
    own = _parts(terms, others.added)
    return own, own[0] / (own[1] + own[2])


def _unit(
    one: Dynamics, joint: int, system: System, *, others: _Others, half: int
) -> tuple[str, str]:
    """Return the kind and text of what makes a log fit the others, or nothing."""
    model = system.task.model
    dof, name = int(model.jnt_dofadr[joint]), joint_names(model)[joint]
    own, misfit = _own(one, system, dof, others=others, half=half)
    if misfit < _MISFIT:
        return "", ""
    enough = min(misfit / 2, 1.5 * others.misfit + 0.05)
    likely: dict[str, str] = {}

    def left(terms: Terms) -> float:
        return np.inf if _few(terms, half) else _misfit(terms, others.added)

    gain = 1 + float(others.added[0])
    least = _OTHER * max(gain, 1 / gain) if others.misfit < _KNOWN else np.inf
    for kind, text, terms in readings(one, joint, system, half=half, misfit=left, least=least):
        if left(terms) < enough and (misfit >= _AGAINST or not kind.endswith("_sign")):
            likely.setdefault(text, kind)
    units = {text: kind for text, kind in likely.items() if FACTOR not in text}
    likely = units or likely  # rather than any number
    kinds = set(likely.values())
    alike = {"motion_sign", "action_sign"}, {"motion_scale", "action_scale"}
    if len(likely) == 1 or kinds in alike:
        text = f"{' or '.join(likely)}? Only so does {name} move as in the other logs"
        return next(iter(likely.values())), text
    still = np.ptp(one.log.ctrl.numpy(), axis=0).max(initial=0.0) == 0
    if still and own[0] > others.left + _PUSHED * others.exerted:
        names = " and ".join(system.columns.ctrl.values())
        text = f"{names} never changed, but {name} moves as if pushed: were actions recorded?"
        return "no_actions", text
    return "", ""


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


def _part(kind: str, part: Dynamics, text: str) -> Finding:
    """Return what is found in the rows of a log."""
    ends = (float(part.log.time[row]) for row in (0, -1))
    first, last = (int(np.nanargmin(np.abs(part.record.time - time))) for time in ends)
    return replace(_whole(kind, part.record, text), rows=(first, last), parts=((first, last),))


def _whole(kind: str, record: Record, text: str) -> Finding:
    rows = 0, len(record) - 1
    return Finding(kind=kind, file=record.name, rows=rows, message=text, severity="error")
