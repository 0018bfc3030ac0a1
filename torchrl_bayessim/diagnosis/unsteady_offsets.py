r"""Offsets that are not constant: one cause, of which another effect simulates the change.

A motor's bias that wanders or an encoder's zero that creeps is no law of the catalogue, which has
constants. What is left of it beside the constant, :math:`\delta(t)` of :math:`b + \delta(t)`, is
explained by what changes slowly at the same joint: a drift of its sensor, or a wave that no run is
long enough to see repeat. Neither is a cause of its own then, if it is a part of the offset: it
stays in the simulator, and is told with the offset. Where a sensor's drift is more than its
constant it is the other way round: a zero that moves need not begin at zero.
"""

from __future__ import annotations

__all__ = ["unrepeated_alarms", "unsteady_offset_alarms", "unsteady_offsets"]

from collections.abc import Mapping, Set

import numpy as np

from ..effects.disturbance import ConstantForce, PeriodicDisturbance
from ..effects.robot import Robot
from ..effects.sensors import SensorBias, SensorDrift
from .cells import plain
from .model import Model
from .objective import Unit
from .segments import Segments

_PART = 0.3  # amplitude of a wave, of the offset that it is a part of
_REPEATS = 2.0  # periods in a run


def unsteady_offsets(model: Model, segments: Segments, robot: Robot) -> dict[str, str]:
    """Return effects that are parts of an offset at the same joint, and that offset's name.

    With ``Δ`` what an effect changes in the innovations, a drift is a part of a constant offset, or
    a sensor's constant of its drift, if it has the smaller ``‖Δ‖``. A wave is one of either if the
    longest run has less than two periods of it, and ``√2 ‖Δ‖`` is less than 0.3 of the offset's.

    Args:
        model: With the effects that were found.
        segments: The training segments.
        robot: Where they act.
    """
    drift = {SensorDrift.name}
    constant = {u.name for u in model.units if u.effect.group == ConstantForce.group} - drift
    told = _parts(model, SensorDrift.name, constant, robot=robot)
    if not told:
        told = _parts(model, SensorBias.name, drift, robot=robot)
    if not _unrepeated(model, segments):
        return told
    # a sine's root mean square, of its amplitude
    waves = _parts(
        model, PeriodicDisturbance.name, constant | drift, robot=robot, most=_PART * np.sqrt(0.5)
    )
    return {name: told.get(offset, offset) for name, offset in waves.items()} | told


def unsteady_offset_alarms(told: Mapping[str, str]) -> list[str]:
    """Return an alarm for each effect that is told as the change of an offset.

    Args:
        told: What is told with another; by `unsteady_offsets`, and other effects.

    Example:
        >>> unsteady_offset_alarms({"sensor_drift": "sensor_bias"})
        ['sensor bias is not constant: in the simulator a sensor drift stands for its change']
        >>> unsteady_offset_alarms({"stribeck_friction": "coulomb_friction"})
        []
    """
    texts = {
        SensorDrift.name: "{1} is not constant: in the simulator a {0} stands for its change",
        SensorBias.name: "{1} does not begin at zero: in the simulator a {0} stands for its start",
        PeriodicDisturbance.name: "{1} wavers, slower than runs can show to repeat: in the "
        "simulator a {0} stands for that",
    }
    return [
        texts[part].format(plain(part), plain(whole))
        for part, whole in told.items()
        if part in texts
    ]


def unrepeated_alarms(model: Model, segments: Segments, told: Mapping[str, str]) -> list[str]:
    """Return an alarm if a wave is named that no run of the fit is long enough to see repeat.

    Args:
        model: With the effects that were found.
        segments: The training segments.
        told: What is told with another; by `unsteady_offsets`, and other effects.
    """
    name = PeriodicDisturbance.name
    if name in told or not _unrepeated(model, segments):
        return []
    wave = plain(name)
    return [f"no run of the fit holds two periods of the {wave}: it may be any force that changes"]


def _unrepeated(model: Model, segments: Segments) -> bool:
    """Return whether there are waves, and no run holds two periods of one."""
    runs = [segments.time[segments.log == log] for log in np.unique(segments.log)]
    longest = max(float(np.ptp(run)) for run in runs)
    waves = [u.effect for u in model.units if isinstance(u.effect, PeriodicDisturbance)]
    return bool(waves) and all(wave.frequency * longest < _REPEATS for wave in waves)


def _parts(
    model: Model, name: str, offsets: Set[str], *, robot: Robot, most: float = 1.0
) -> dict[str, str]:
    """Return an effect and the offset that it is a part of at each of its places, or nothing.

    Args:
        model: With both.
        name: Of the effect.
        offsets: Names of offsets.
        robot: Where they act.
        most: Of what the offset changes.
    """
    wholes: set[str] = set()
    for unit in (unit for unit in model.units if unit.name == name):
        there = [
            other
            for other in model.units
            if other.name in offsets
            and _joints(unit, robot) <= _joints(other, robot)
            and _size(model, unit) < most * _size(model, other)
        ]
        if not there:
            return {}
        wholes.add(max(there, key=lambda other: _size(model, other)).name)
    return {name: wholes.pop()} if len(wholes) == 1 else {}


def _joints(unit: Unit, robot: Robot) -> set[int | str]:
    """Return the joints at which a unit acts, or its targets by name where those are at none."""
    if len(robot.joints) == 1 and -1 not in robot.channel_joint:
        return {0}  # a tilt, too
    targets = unit.effect.targets(robot)
    joints = {at: unit.effect.joint(robot, at) for at in unit.targets}
    return {targets[at] if joint < 0 else joint for at, joint in joints.items()}


def _size(model: Model, unit: Unit) -> float:
    return float(np.linalg.norm(model.fit.change(unit)))
