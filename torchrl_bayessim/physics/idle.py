"""Entries of a MuJoCo model that nothing reads, because of other entries or of integers in it.

======================================================  =========================================
an entry of                                             acts only with
======================================================  =========================================
``jnt_range, jnt_margin, jnt_solref, jnt_solimp``       ``jnt_limited``
``tendon_range, tendon_margin, tendon_sol…_lim``        ``tendon_limited``
``…_actfrcrange``, ``actuator_{ctrl,force,act}range``   ``…_actfrclimited``, ``actuator_…limited``
``actuator_biasprm``, ``actuator_dynprm``               ``actuator_biastype``, ``…dyntype``
``actuator_delay``                                      samples of history (``nsample``)
``actuator_cranklength``, ``actuator_lengthrange``      a slider-crank, a muscle
``body_pos``, ``body_quat``                             a body that is neither free nor mocap
``jnt_axis``, ``jnt_pos``                               a hinge or slide, a joint that is not free
``dof_sol…``, ``tendon_sol…_fri``                       ``frictionloss`` there
``geom_fluid`` after column 0                           column 0, which switches the model on
``geom_fluid``, ``opt.wind``                            ``opt.density`` or ``opt.viscosity``
======================================================  =========================================

The last three depend on numbers, so they are settable together with those.
"""

from __future__ import annotations

__all__ = ["Place", "check_acts"]

from collections.abc import Callable, Container

import mujoco
import numpy as np

from ..errors import PhysicsError, message

Place = tuple[str, tuple[int, ...]]

_FLAGS = {  # the field: what must not be zero in the same row for it to act
    "jnt_range": "jnt_limited", "jnt_margin": "jnt_limited", "jnt_solref": "jnt_limited",
    "jnt_solimp": "jnt_limited", "jnt_actfrcrange": "jnt_actfrclimited",
    "tendon_range": "tendon_limited", "tendon_margin": "tendon_limited",
    "tendon_solref_lim": "tendon_limited", "tendon_solimp_lim": "tendon_limited",
    "tendon_actfrcrange": "tendon_actfrclimited",
    "actuator_ctrlrange": "actuator_ctrllimited", "actuator_forcerange": "actuator_forcelimited",
    "actuator_actrange": "actuator_actlimited",
    "actuator_biasprm": "actuator_biastype", "actuator_dynprm": "actuator_dyntype",
}  # fmt: skip
_FRICTION = {
    "dof_solref": "dof_frictionloss", "dof_solimp": "dof_frictionloss",
    "tendon_solref_fri": "tendon_frictionloss", "tendon_solimp_fri": "tendon_frictionloss",
}  # fmt: skip
_FLUID: list[Place] = [("opt.density", ()), ("opt.viscosity", ())]


def check_acts(model: mujoco.MjModel, place: Place, along: Container[Place] = ()) -> None:
    """Refuse an entry that has no effect.

    Args:
        model: The model.
        place: The entry.
        along: Entries that are set too, so that they count whatever they are in the model.

    Raises:
        PhysicsError: Nothing reads the entry; the message says what it takes.

    Example:
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>")
        >>> check_acts(model, ("dof_solref", (0, 0)), along=[("dof_frictionloss", (0,))])
    """
    field, indices = place
    row = indices[0] if indices else 0
    flag = _FLAGS.get(field)
    if flag is not None and not getattr(model, flag)[row]:
        raise _idle(place, f"{flag} in the model", f"set {flag} in the MJCF")
    for fields, idle, needed, hint in _KINDS:
        if field in fields and idle(model, row):
            raise _idle(place, needed, hint)
    for others in _numbers_needed(field, indices):
        if not any(other in along or _value(model, other) for other in others):
            names = " or ".join(f"{name}{list(at) or ''}" for name, at in others)
            raise _idle(place, f"{names} that is not zero", f"set {names} too")


def _free_body(model: mujoco.MjModel, body: int) -> bool:
    first = model.body_jntadr[body]
    return first >= 0 and model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE


def _no_muscle(model: mujoco.MjModel, actuator: int) -> bool:
    gain, bias = model.actuator_gaintype[actuator], model.actuator_biastype[actuator]
    return gain != mujoco.mjtGain.mjGAIN_MUSCLE and bias != mujoco.mjtBias.mjBIAS_MUSCLE


_PLACES, _JOINT = {"body_pos", "body_quat"}, mujoco.mjtJoint
_KINDS: list[tuple[set[str], Callable[[mujoco.MjModel, int], bool], str, str]] = [
    # fields, whether a row of them is idle, what it would have to be, what to do instead
    (_PLACES, _free_body, "a body without a free joint", "place it by its qpos, at a reset"),
    (
        _PLACES,
        lambda model, row: model.body_mocapid[row] >= 0,
        "a body that is not mocap",
        "place it by mocap_pos and mocap_quat, at a reset",
    ),
    (
        {"jnt_axis", "jnt_pos"},
        lambda model, row: model.jnt_type[row] == _JOINT.mjJNT_FREE,
        "a joint that is not free",
        "place the body by its qpos, at a reset",
    ),
    (
        {"jnt_axis"},
        lambda model, row: model.jnt_type[row] == _JOINT.mjJNT_BALL,
        "a hinge or slide, not a ball joint",
        "another type in the MJCF",
    ),
    (
        {"actuator_delay"},
        lambda model, row: not model.actuator_history[row, 0],
        "samples of history",
        "set nsample in the MJCF",
    ),
    (
        {"actuator_cranklength"},
        lambda model, row: model.actuator_trntype[row] != mujoco.mjtTrn.mjTRN_SLIDERCRANK,
        "a slider-crank as transmission",
        "set cranksite in the MJCF",
    ),
    ({"actuator_lengthrange"}, _no_muscle, "a muscle as actuator", "<muscle> in the MJCF"),
]


def _numbers_needed(field: str, indices: tuple[int, ...]) -> list[list[Place]]:
    """Return groups of entries, of each of which one must not be zero for the field to act."""
    if field in _FRICTION:
        return [[(_FRICTION[field], indices[:1])]]
    if field == "geom_fluid":
        return [_FLUID] if indices[1] == 0 else [[(field, (indices[0], 0))], _FLUID]
    return [_FLUID] if field == "opt.wind" else []


def _value(model: mujoco.MjModel, place: Place) -> float:
    owner = model.opt if place[0].startswith("opt.") else model
    return float(np.asarray(getattr(owner, place[0].removeprefix("opt.")))[place[1]])


def _idle(place: Place, needed: str, hint: str) -> PhysicsError:
    field, indices = place
    got = f"{field}{list(indices) or ''}"
    return PhysicsError(message(f"an entry of {field} that acts, with {needed}", got, hint=hint))
