"""Names of the report's language, and the classes that the scores go by.

A class holds causes that act alike and that an engineer would look for at the same place. It was
fixed before any diagnosis was scored. Two causes of different classes may still be one and the same
in data of some kind; those pairs are listed too, and leave the catalogue together.
"""

from __future__ import annotations

__all__ = ["CLASSES", "EQUIVALENT", "NAMES", "class_of", "without_class_of"]

CLASSES = {
    "timing": ("action_delay", "action_lag", "packet_drop", "action_jitter", "sensor_delay",
               "sensor_lag", "time_scale", "series_elasticity"),
    "loss": ("dead_band", "backlash", "action_quantization"),
    "gain": ("saturation", "action_gain", "torque_speed_limit", "battery_sag"),
    "friction": ("coulomb_friction", "stribeck_friction", "viscous_friction", "quadratic_drag",
                 "load_dependent_friction", "directional_friction"),
    "offset": ("action_bias", "constant_force", "gravity_tilt", "sensor_bias", "sensor_drift"),
    "restoring": ("parallel_spring", "com_shift", "cogging"),
    "disturbance": ("periodic_disturbance",),
    "inertia": ("payload", "armature", "link_length"),
    "contact": ("contact_friction", "contact_softness"),
    "scale": ("sensor_gain",),
    "noise": ("sensor_noise", "sensor_quantization", "sensor_dropout"),
}  # fmt: skip
NAMES = tuple(name for names in CLASSES.values() for name in names)

# Not to be told apart in some data, whatever the method; from algebra, not from results.
EQUIVALENT = (
    ("action_gain", "payload"),  # a gain divides out of inertia, gravity and damping
    ("action_gain", "armature"),
    ("viscous_friction", "torque_speed_limit"),  # back-EMF is linear in speed
    ("gravity_tilt", "com_shift"),  # of one joint: a centre of mass at another angle
    ("sensor_bias", "com_shift"),  # of one joint: with its zero elsewhere gravity seems turned
    ("action_bias", "directional_friction"),  # half of it is a constant
    ("parallel_spring", "gravity_tilt"),  # at small angles, beside the mass
    ("parallel_spring", "payload"),  # at small angles: more weight is a stiffer pendulum
    ("sensor_gain", "time_scale"),
    ("sensor_gain", "sensor_lag"),
    ("action_lag", "armature"),  # of slow commands: later, as of a heavier rotor
    ("battery_sag", "viscous_friction"),
)


def class_of(name: str) -> str:
    """Return the class of a name; ``foreign`` for what is in none."""
    return next((c for c, names in CLASSES.items() if name in names), "foreign")


def without_class_of(name: str) -> list[str]:
    """Return all names but those of a cause's class, and its equivalents."""
    gone = set(CLASSES.get(class_of(name), ()))
    for pair in EQUIVALENT:
        if name in pair:
            gone |= set(pair)
    return [n for n in NAMES if n not in gone]
