"""Why an effect that explains the data should still not be named without reserve."""

from __future__ import annotations

__all__ = ["alike", "baseless", "doubts", "numerical", "slow", "unsigned"]

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..effects.disturbance import Cogging
from ..effects.joints import Armature, CoulombFriction
from ..effects.robot import Robot
from ..effects.transmission import servo_damping
from ..effects.units import slides
from .cells import plain
from .model import Model, as_good, judged_fits
from .objective import Unit
from .preparation import Prepared
from .report import Finding

_EDGE = 0.98  # of the largest strength that is looked for
_FEWEST = 2  # periods per turn
_ANYTHING = -np.inf, np.inf
_IMPLICIT = mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def doubts(effects: Sequence[Finding], units: Sequence[Unit], prepared: Prepared) -> list[str]:
    """Return what speaks against the causes that were found, in words.

    A strength at the end of what is looked for may stand for another cause, one whose interval
    holds zero for none, and commands that never change excite little of what a robot can do.

    Args:
        effects: What was found.
        units: All that was looked for.
        prepared: The logs.
    """
    if not effects:
        return []
    ends = _ends(units)
    found = [text for effect in effects for text in _of_strength(effect, ends)]
    commands = [o.segments.ctrl for o in prepared.sets.values()]
    least, most = (np.array([f(one, axis=(0, 1)) for one in commands]) for f in (np.min, np.max))
    if least.size and (least.min(0) == most.max(0)).all():
        found.append(
            "no command ever changes: causes that would show under others cannot be told apart"
        )
    return found


def alike(units: Sequence[Unit], robot: Robot) -> list[str]:
    """Return an alarm if two causes act alike at one joint: together they imitate many a third.

    Laws of friction add up, in the usual model too.
    """
    found = {}
    for i, one in enumerate(units):
        for other in units[:i]:
            groups = {one.effect.group, other.effect.group}
            if len(groups) > 1 or CoulombFriction.group in groups or one.name == other.name:
                continue
            if one.joint(robot) == other.joint(robot):
                names = f"{plain(other.name)} and {plain(one.name)}"
                found[names] = f"{names} at {one.where} act alike: they may stand for another cause"
    return list(found.values())


def slow(units: Sequence[Unit], robot: Robot) -> list[str]:
    """Return an alarm for cogging of a hinge with two periods per turn, the fewest looked for.

    One is gravity's, and what a body's mass does beside it repeats once or twice a turn.
    """
    return [
        f"{plain(unit.name)} at {unit.where} was fitted to {_FEWEST} periods per turn, the fewest "
        "that are looked for: it may stand for what a mass or a spring does"
        for unit in units
        if isinstance(unit.effect, Cogging)
        and not slides(robot, unit.joint(robot))
        and unit.effect.number < _FEWEST / _EDGE
    ]


def unsigned(best: Model, prepared: Prepared) -> list[str]:
    """Return an alarm for effects of which the data tell the size, but not the sign.

    Of a tilt along a joint's axis, only its cosine matters.
    """
    point, robot = best.fit.point, prepared.predictor.system.robot
    signed = [unit for unit in best.units if unit.low < 0 and point.strengths[unit]]
    others = [point.beside({u: -point.strengths[u]}) for u in signed]
    train, validation = prepared.sets["train"], prepared.sets["validation"]
    mirrored = judged_fits(train, validation, others, iterations=0)
    sizes = [abs(unit.actual(point.strengths[unit])) for unit in signed]
    return [
        f"{plain(unit.name)} at {unit.where} is {size:.3g} or {-size:.3g} "
        f"{unit.measured_in(robot)}: these data do not tell its sign"
        for unit, size, model in zip(signed, sizes, mirrored, strict=True)
        if as_good(best, model)
    ]


def baseless(effects: Sequence[Finding], units: Sequence[Unit]) -> bool:
    """Return whether every effect may be nothing, and is at the end of what was looked for as well.

    A wide interval alone may be that of a law without slope, such as a play that is all taken up.
    """
    ends = _ends(units)
    return all(
        effect.ci95[0] <= 0 <= effect.ci95[1]
        and all(
            strength == 0 or _at_end(strength, ends.get((effect.name, place), _ANYTHING))
            for place, strength in effect.strengths.items()
        )
        for effect in effects
    )


def numerical(effects: Sequence[Finding], robot: Robot) -> list[str]:
    """Return an alarm if all that was found is what another integrator would add.

    With damping ``d`` and a time step ``h``, integrators that take damping implicitly move a joint
    as if its inertia were larger by ``h d``: it is what a simulator lacks that does not.
    """
    places = {name: i for i, name in enumerate(robot.joints)}
    if robot.model is None or not effects or {e.name for e in effects} != {Armature.name}:
        return []
    most = float(robot.model.opt.timestep) * _explicit_dampings(robot, robot.model)
    strengths = {place: s for effect in effects for place, s in effect.strengths.items()}
    if any(s > most[places[place]] for place, s in strengths.items() if place in places):
        return []
    some = ", ".join(f"{s:.2g} at {place}" for place, s in strengths.items())
    return [
        f"an armature of {some} explains the gap, but is no more than another integrator adds, "
        "the time step times the damping: try a finer time step, or integrator='implicitfast'"
    ]


def _explicit_dampings(robot: Robot, model: mujoco.MjModel) -> NDArray[np.float64]:
    """Return the damping of each joint, and of its servos, that is not taken implicitly."""
    damping = model.dof_damping[list(robot.dof_index)].copy()
    if model.opt.integrator in _IMPLICIT:
        return np.zeros_like(damping)
    euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    if euler and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP:
        damping[:] = 0.0  # of the joints alone
    servos = -servo_damping(robot).numpy() * model.actuator_gear[:, 0] ** 2
    if len(servos) != len(robot.actuators):
        return damping  # actions that a task makes commands of move no joint that is known
    for joint, one in zip(robot.joint_of_actuator, servos, strict=True):
        damping[joint] += one if joint >= 0 else 0.0
    return damping


def _ends(units: Sequence[Unit]) -> dict[tuple[str, str], tuple[float, float]]:
    return {(u.name, u.where): (round(u.actual(u.low), 12), u.actual(u.high)) for u in units}


def _at_end(strength: float, ends: tuple[float, float]) -> bool:
    low, high = ends
    return not (_EDGE * low if low < 0 else -np.inf) < strength < _EDGE * high


def _of_strength(effect: Finding, ends: dict[tuple[str, str], tuple[float, float]]) -> list[str]:
    name, unit = plain(effect.name), effect.unit
    texts = []
    for place, strength in effect.strengths.items():
        low, high = ends.get((effect.name, place), _ANYTHING)
        if _at_end(strength, (low, high)):
            texts.append(
                f"{name} at {place} was fitted to {strength:.3g} {unit}, the end of what is looked "
                f"for, [{low:.3g}, {high:.3g}]: there is more of it, or it stands for another cause"
            )
    low, high = np.round(effect.ci95, 12)
    if low <= 0 <= high:
        texts.append(
            f"{name} at {effect.where} may be nothing: its interval, [{low:.2g}, {high:.2g}] "
            f"{unit}, holds zero"
        )
    return texts
