"""All effects by name."""

from __future__ import annotations

__all__ = ["CATALOGUE", "each_once", "effect"]

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

from ..errors import message
from ..kinds import check_kind
from . import (
    action,
    backlash,
    bodies,
    contacts,
    disturbance,
    friction,
    joints,
    sensors,
    series_elasticity,
    transmission,
)
from .effect import Effect

CATALOGUE = MappingProxyType(
    {
        kind.name: kind
        for kind in (
            action.ActionDelay,
            action.ActionLag,
            action.DeadBand,
            action.Saturation,
            action.ActionGain,
            action.ActionBias,
            transmission.TorqueSpeedLimit,
            action.BatterySag,
            action.PacketDrop,
            action.ActionJitter,
            action.ActionQuantization,
            backlash.Backlash,
            joints.CoulombFriction,
            friction.StribeckFriction,
            joints.ViscousFriction,
            friction.QuadraticDrag,
            friction.LoadDependentFriction,
            friction.DirectionalFriction,
            joints.ParallelSpring,
            series_elasticity.SeriesElasticity,
            bodies.GravityTilt,
            disturbance.ConstantForce,
            disturbance.PeriodicDisturbance,
            disturbance.Cogging,
            bodies.Payload,
            bodies.ComShift,
            joints.Armature,
            contacts.ContactFriction,
            contacts.ContactSoftness,
            bodies.LinkLength,
            bodies.TimeScale,
            sensors.SensorDelay,
            sensors.SensorBias,
            sensors.SensorGain,
            sensors.SensorNoise,
            sensors.SensorQuantization,
            sensors.SensorLag,
            sensors.SensorDrift,
            sensors.SensorDropout,
        )
    }
)
"""The kinds of effects, by name."""


def effect(name: str, **options: Any) -> Effect:
    """Return an effect of the catalogue.

    Args:
        name: Its name.
        **options: Of its kind, such as the ``frequency`` of a ``periodic_disturbance``.

    Example:
        >>> effect("stribeck_friction", speed=0.1)
        StribeckFriction(speed=0.1, presliding=0.0, kinetic=0.0)

    Raises:
        KeyError: The catalogue has no such effect.
    """
    if name not in CATALOGUE:
        raise KeyError(message("an effect of the catalogue", name, available=CATALOGUE))
    return CATALOGUE[name].law(**options)


def each_once(effects: Sequence[str | Effect]) -> None:
    """Check that no effect is asked for twice.

    Raises:
        ValueError: One is.
        TypeError: They are no sequence of names and effects.
    """
    check_kind("a sequence of effects", effects, tuple, list)
    for one in effects:
        check_kind("an effect or the name of one", one, str, Effect)
    twice = next((one for one in effects if effects.count(one) > 1), None)
    if twice is not None:
        raise ValueError(message("each effect once", twice))
