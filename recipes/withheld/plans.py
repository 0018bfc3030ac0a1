"""Which cases are drawn: so many of every tier, robot and cause."""

from __future__ import annotations

__all__ = ["CONTROLS", "applicable", "plans"]

from collections.abc import Mapping, Sequence

import numpy as np

from .cases import Plan
from .causes_actuation import ACTUATION
from .causes_body import BODY, CONTACT
from .causes_chance import CHANCE
from .causes_foreign import FOREIGN
from .causes_sensing import SENSING
from .classes import class_of

CONTROLS = ("parameters", "noise", "shuffled", "renamed")
_ENGINES = {"T6": "other", "T6B": "bullet"}
_OF_MUJOCO = {"load_dependent_friction"}  # which asks MuJoCo for the load
_OF_GYMNASIUM = {"hopper", "half_cheetah", "fetch_push"}
# Commands that are no motor's, an object and its contacts, and encoders; nothing in joints, of
# which an arm that is dragged by its hand shows nothing. The object's centre of mass stays: MuJoCo
# takes it to be the body's origin for good
_OF_A_DRAGGED_HAND = {
    *("action_delay", "action_lag", "dead_band", "saturation", "action_gain", "action_bias"),
    *("packet_drop", "action_jitter", "gravity_tilt", "payload", "sensor_dropout"),
    *SENSING,
    *CONTACT,
}
_OTHER_ONLY = {"backlash", "series_elasticity"}  # of two masses, unlike the catalogue's
_SAME_ONLY = {"armature", "com_shift"}
_TOO_FAST = {"half_cheetah": {"backlash"}}  # two masses at 40 Hz, on its grid of 10 ms


def applicable(robot: str, form: str = "same") -> list[str]:
    """Return the causes that a robot can have in a form."""
    names = {**ACTUATION, **BODY, **SENSING, **CHANCE}
    if robot in _OF_GYMNASIUM:
        names |= CONTACT
    left = _OTHER_ONLY if form == "same" else _SAME_ONLY
    if robot == "cart_pole":
        left = left | _OTHER_ONLY | {"armature"}  # its motor has no rotor
    if robot == "fetch_push":
        left = left | set(names) - _OF_A_DRAGGED_HAND
    left = left | _TOO_FAST.get(robot, set())
    return [name for name in names if name not in left]


def plans(tiers: Mapping[str, int], robots: Sequence[str], rng: np.random.Generator) -> list[Plan]:
    """Return plans in random order.

    Args:
        tiers: Number of cases by tier and robot, ``T0`` to ``T6``, ``T6B`` (of the arm only) and
            ``controls`` (of each).
        robots: Their names.
        rng: Of causes and order; causes are dealt from shuffled decks, so that all occur alike.
    """
    found: list[Plan] = []
    for robot in robots:
        for tier, count in tiers.items():
            found += _tier(tier, robot, count, rng)
    return [found[i] for i in rng.permutation(len(found))]


def _tier(tier: str, robot: str, count: int, rng: np.random.Generator) -> list[Plan]:
    same, other = applicable(robot), applicable(robot, "other")
    if tier == "T0":
        return [Plan(tier, robot)] * count
    if tier == "controls":
        plain = [Plan(name, robot, control=name) for name in CONTROLS[:3] for _ in range(count)]
        if robot in _OF_GYMNASIUM:  # whose names are Gymnasium's
            return plain
        return plain + [Plan("renamed", robot, (n,), control="renamed")
                        for n in _deal(same, count, rng)]  # fmt: skip
    if tier == "T5":
        return [_pair(robot, rng) for _ in range(count)]
    if tier in _ENGINES:
        deck = [name for name in same if tier == "T6" or name not in _OF_MUJOCO]
        half = [()] * (count - count // 2) + [(name,) for name in _deal(deck, count // 2, rng)]
        able = tier == "T6" or robot == "arm"
        return [Plan(tier, robot, causes, engine=_ENGINES[tier]) for causes in half if able]
    foreign = [] if robot == "fetch_push" else list(FOREIGN)  # those are in joints
    deck = {"T1": same, "T2": other, "T3": same, "T4": foreign}[tier]
    form = "other" if tier == "T2" else "same"
    return [Plan(tier, robot, (name,), form) for name in _deal(deck, count, rng)]


def _deal(deck: Sequence[str], count: int, rng: np.random.Generator) -> list[str]:
    dealt: list[str] = []
    while deck and len(dealt) < count:
        dealt += [deck[i] for i in rng.permutation(len(deck))]
    return dealt[:count]


def _pair(robot: str, rng: np.random.Generator) -> Plan:
    """Return two causes of different classes that leave a parameter to refit."""
    form = str(rng.choice(["same", "other"]))
    deck = applicable(robot, form)
    while True:
        a, b = (str(name) for name in rng.choice(deck, 2, replace=False))
        apart = class_of(a) != class_of(b) and not {a, b} <= _OTHER_ONLY
        if apart and not ("viscous_friction" in {a, b} and _divides({a, b})):
            return Plan("T5", robot, (a, b), form)


def _divides(names: set[str]) -> bool:
    return bool(names & {"action_gain", "payload", "armature", "com_shift"})
