"""Effects of a model that are one cause together, and are told as one.

The simulator keeps all of them: only the names are fewer.
"""

from __future__ import annotations

__all__ = [
    "dry_friction",
    "dry_friction_alarms",
    "lateness",
    "lateness_alarms",
    "told_together",
]

from collections.abc import Mapping

from ..effects.action import ActionDelay, ActionLag
from ..effects.friction import StribeckFriction
from ..effects.joints import CoulombFriction
from ..effects.robot import Robot
from ..effects.sensors import SensorDelay, SensorLag
from .cells import plain
from .model import Model
from .objective import at_targets

_LAWS = CoulombFriction.name, StribeckFriction.name
_LATE = (ActionLag.name, ActionDelay.name), (SensorLag.name, SensorDelay.name)


def told_together(credit: Mapping[str, float], told: Mapping[str, str]) -> dict[str, float]:
    """Return the credit of effects, that of some with the effect that each is told with.

    Example:
        >>> told_together({"constant_force": 0.75, "periodic_disturbance": 0.25},
        ...               {"periodic_disturbance": "constant_force"})
        {'constant_force': 1.0}
    """
    kept = {name: share for name, share in credit.items() if name not in told}
    for name, other in told.items():
        kept[other] += credit[name]
    return kept


def dry_friction(model: Model, credit: Mapping[str, float], robot: Robot) -> dict[str, str]:
    """Return the law of dry friction that is told with another one, and that other's name.

    The Stribeck curve, ``F_c + (F_s − F_c) e^{−(v/v_s)²}`` (Armstrong-Hélouvry, Dupont & Canudas de
    Wit 1994), is Coulomb friction and what fades with speed: one friction, where both are at the
    same joints, as they are where most of it stays. The law of more credit gives the name, of equal
    ones Coulomb's.

    Args:
        model: With the effects that were found.
        credit: Each effect's share of what all explain.
        robot: Where they act.
    """
    if not set(_LAWS) <= set(model.names):
        return {}
    first, second = sorted(_LAWS, key=lambda name: -credit[name])
    there, others = (_by_target(model, name, robot).keys() for name in (first, second))
    return {second: first} if others <= there else {}


def dry_friction_alarms(model: Model, told: Mapping[str, str], robot: Robot) -> list[str]:
    """Return an alarm for friction that is told as one law and is two in the simulator.

    Args:
        model: With the effects that were found.
        told: What is told with another; by :func:`dry_friction`, and other effects.
        robot: Where they act.
    """
    always, fading = (_by_target(model, name, robot) for name in _LAWS)
    strengths = model.fit.point.strengths
    kept = {
        unit: unit.effect.kinetic * unit.actual(strengths[unit])
        for unit in model.units
        if isinstance(unit.effect, StribeckFriction)
    }
    kinetic = at_targets(kept, robot)
    return [
        f"friction at {joint} fades with speed, from {always[joint] + fading[joint]:.3g} to "
        f"{always[joint] + kinetic[joint]:.3g} {_measure(model, robot)}: in the simulator "
        f"{plain(first)} and {plain(second)} stand for it together"
        for second, first in told.items()
        if second in _LAWS
        for joint in robot.joints
        if joint in always and joint in fading
    ]


def lateness(model: Model, robot: Robot) -> dict[str, str]:
    """Return the delay that is told with a filter, or the other way round, and that other's name.

    What several filters in a row do is nearly one filter and dead time (Skogestad 2003, the half
    rule): one cause, where one of the two is at all actuators or sensors of the other. The one at
    more of them gives the name; at the same ones what makes those later, of equals the filter.

    Args:
        model: With the effects that were found.
        robot: Where they act.
    """
    told: dict[str, str] = {}
    for names in _LATE:
        if set(names) <= set(model.names):
            found = {name: _by_target(model, name, robot) for name in names}
            first, second = sorted(
                names, key=lambda name: (-len(found[name]), -sum(found[name].values()))
            )
            if found[second].keys() <= found[first].keys():
                told[second] = first
    return told


def lateness_alarms(model: Model, told: Mapping[str, str], robot: Robot) -> list[str]:
    """Return an alarm for what is late at one place, filtered and delayed.

    Args:
        model: With the effects that were found.
        told: What is told with another; by :func:`lateness`, and other effects.
        robot: Where they act.
    """
    texts: list[str] = []
    for lag, delay in _LATE:
        if told.get(lag) != delay and told.get(delay) != lag:
            continue
        filtered, delayed = (_by_target(model, name, robot) for name in (lag, delay))
        texts += [
            f"{place} is late by {filtered[place]:.3g} s of a filter and {delayed[place]:.3g} s of "
            f"delay: in the simulator {plain(lag)} and {plain(delay)} stand for it together"
            for place in filtered
            if place in delayed
        ]
    return texts


def _measure(model: Model, robot: Robot) -> str:
    unit = next(unit for unit in model.units if unit.name in _LAWS)
    return unit.measured_in(robot)


def _by_target(model: Model, name: str, robot: Robot) -> dict[str, float]:
    """Return the strength of a law at each target where it acts."""
    strengths = model.fit.point.strengths
    return at_targets({u: u.actual(strengths[u]) for u in model.units if u.name == name}, robot)
