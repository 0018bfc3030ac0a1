"""Whether a further effect is more than a stopgap for the wrong form of another.

A model that is right but for the form of a law leaves a little that many effects can mend. So a
further effect has to matter: to the gap, or to what the others leave, and then no effect of another
kind may do the same by other means. What does the same by the same means is the same explanation
under another name, and stands beside it as its rival.
"""

from __future__ import annotations

__all__ = [
    "beside_variation",
    "identified",
    "leaves_little",
    "no_rival",
    "nothing_left",
    "numerical",
    "stands_apart",
    "surely_elsewhere",
]

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..effects.action import ActionDelay
from ..effects.robot import Robot
from ..effects.sensors import SensorDelay
from .model import LIKELY, Model, as_good, gain, total_gain
from .objective import Unit
from .screening import Screen

_SHARE = 0.1  # of the gap: what an effect that could be another must remove to be kept
_REST = 0.5  # of what the base leaves: what any further effect must remove, each of two at once
_LONE, _ALONE = 0.25, 4.0  # the same where it removes so many times what any other kind does
_REMAINS = 0.01  # of the gap: not worth another effect
_NUMERICAL = 3e-4  # of the gap: what a force that is 2 % off, by the integrator, may leave
_VISIBLE = 1.2  # mean squared innovation that shows however small a share of the gap
_DELAYS = ActionDelay.name, SensorDelay.name
_WRONG = 1.5  # mean squared innovation of a base that something is missing from
_SURELY, _NOTHING = 50.0, 0.2  # gain, and share of what the base leaves: it was just this
# likelihood ratio of what is plain elsewhere, times that of what another kind has there, and gain
_PLAIN, _FAR, _SHOWN = 40.0, 1.5, 10.0
_LEAST = 1e-4  # of the gap: what it removes where noise alone seems left
_DIFFERENT = 0.1  # of the change that an effect makes: what another makes differently


def identified(
    start: Model,
    base: Model,
    better: Model,
    models: Sequence[Model],
    *,
    timestep: float = math.inf,
    seen: Screen | None = None,
    robot: Robot | None = None,
) -> bool:
    """Return whether what is added to a base with effects is more than a stopgap.

    Args:
        start: Parameters alone.
        base: With the effects that there are already.
        better: With further ones.
        models: All that were tried on the base.
        timestep: Of the simulator, s: what is later than that no integrator is.
        seen: The base, compared with all units.
        robot: Where those act.
    """
    if not base.units:
        return True
    left = not nothing_left(start, base)
    screened = seen is not None
    if left and _matters(start, base, better, models, timestep=timestep, screened=screened):
        return True
    if seen is None or robot is None:
        return False
    if not _elsewhere(base, better, seen, robot, beyond=0.0 if left else _PLAIN):
        return False
    return left or not numerical(start, base, better, timestep)


def _matters(
    start: Model,
    base: Model,
    better: Model,
    models: Sequence[Model],
    *,
    timestep: float,
    screened: bool,
) -> bool:
    """Return whether what is added matters, to the gap or to what the base leaves.

    Of a base that was found in a round of its own, and screened in the next, laws have been bent to
    the data: what all runs together show beside it is no mend of them.
    """
    alone, before, after = (m.mean_square for m in (start, base, better))
    removed = (before - after) / max(before - 1.0, 1e-9)
    # a third one mends the forms of two others more easily, and two at once more than one
    count = max(len(better.names) - len(base.names), 1)
    several = count > 1 or len(base.names) > 1
    rest = 1.0 - (1.0 - _REST) ** count
    if before - after > _SHARE * (alone - 1.0) and not (several and removed < rest):
        return True
    added = _added(base, better)
    others = [m for m in models if not (_added(base, m) & added or _same(base, better, m))]
    next_best = before - min([before, *(m.mean_square for m in others)])
    lone = before - after > _ALONE * next_best
    if removed < (_LONE if lone and count < 2 else rest):
        return False
    sure = gain(base, better) > _SURELY
    if screened:
        sure |= gain(base, better) > _SURELY / 2 and total_gain(base, better) > 2 * _SURELY
    just_this = sure and removed > 1.0 - _NOTHING
    if leaves_little(start, base):
        # a simulator that integrates otherwise is late, too, by a part of its time step
        second = len({unit.name for unit in base.units if _does_something(unit, better)}) <= 1
        second &= not _within_a_step(base, better, timestep)
        if not second or not (just_this or (lone and removed > _REST)):
            return False
    return (before > _WRONG or just_this) and not _rivalled(base, better, models)


def stands_apart(base: Model, seen: Screen, robot: Robot) -> bool:
    """Return whether an effect shows elsewhere, however little of the gap is left to it."""
    told = _told(base, seen, robot)
    unit = max(told, key=lambda unit: told[unit], default=None)
    return unit is not None and told[unit] > _apart_from(unit.effect.group, told, _PLAIN)


def numerical(start: Model, base: Model, better: Model, timestep: float) -> bool:
    """Return whether a simulator that integrates otherwise would leave what is added.

    It is late by a part of its time step, and its forces are off by a hundredth.
    """
    if start.mean_square - 1.0 > (base.mean_square - better.mean_square) / _LEAST:
        return True
    return _within_a_step(base, better, timestep)


def _elsewhere(base: Model, better: Model, seen: Screen, robot: Robot, *, beyond: float) -> bool:
    """Return whether one effect is added that no other law at the places of the base could be.

    Whatever is wrong with the form of a law is a force of its own joint, or an error of its own
    sensor. What those together cannot explain, and one effect elsewhere does far better than any of
    another kind, is that effect, however little of the gap it is.
    """
    added = better.beyond(base)
    if len({unit.name for unit in added}) != 1 or gain(base, better) < _SHOWN:
        return False
    told = _told(base, seen, robot)
    mine = max((told.get(unit, 0.0) for unit in added), default=0.0)
    return mine > _apart_from(added[0].effect.group, told, beyond)


def surely_elsewhere(base: Model, better: Model, robot: Robot) -> bool:
    """Return whether what a model has beside a base is at another place, and surely needed.

    The model has to leave noise alone, or little more and less than it takes: one that is off
    everywhere needs whatever mends some of it.
    """
    lost, places = total_gain(base, better), _places_of(base, robot)
    apart = any(not _places(unit, robot) <= places for unit in better.beyond(base))
    before, after = base.mean_square, better.mean_square
    most = after < _WRONG and before - after > _REST * (before - 1.0)
    return apart and lost > _PLAIN and (most or after < _VISIBLE)


def _told(base: Model, seen: Screen, robot: Robot) -> dict[Unit, float]:
    """Return likelihood ratios of units beside all laws at the places of the base."""
    places = _places_of(base, robot)
    near = {unit for unit in seen.units if _places(unit, robot) <= places}
    return seen.beside(near, base.dispersion())


def _apart_from(group: str, told: Mapping[Unit, float], beyond: float) -> float:
    """Return the likelihood ratio from which an effect of a group stands apart from all others.

    It is so many times that of any of another group, and larger by ``beyond`` at least.
    """
    other = max((r for unit, r in told.items() if unit.effect.group != group), default=0.0)
    return max(_PLAIN, _FAR * other, other + beyond)


def _places_of(model: Model, robot: Robot) -> set[tuple[str, int]]:
    return {place for unit in model.units for place in _places(unit, robot)}


def _places(unit: Unit, robot: Robot) -> set[tuple[str, int]]:
    """Return the joints at which a unit acts, -1 where it is none, and whether on sensors."""
    side = "sensing" if unit.effect.channel == "sensing" else "forces"
    return {(side, unit.effect.joint(robot, target)) for target in unit.targets}


def _does_something(unit: Unit, model: Model) -> bool:
    """Return whether a unit moves what a model predicts by more than chance would let it."""
    if unit not in model.units:
        return False
    return float((model.fit.change(unit) ** 2).sum()) > LIKELY


def _within_a_step(base: Model, better: Model, timestep: float) -> bool:
    """Return whether something late is added, and no delay that is longer than a time step."""
    if ActionDelay.group not in _added(base, better):
        return False
    strengths = better.fit.point.strengths
    delays = [u for u in strengths if u not in base.units and u.name in _DELAYS]
    return not any(unit.actual(strengths[unit]) > timestep for unit in delays)


def no_rival(base: Model, better: Model, models: Sequence[Model], **_: object) -> bool:
    """Return whether no effect of another kind mends a base as well, where all that is left counts.

    Where what varies counts as noise, what is left says nothing of how much is missing.
    """
    return not base.units or not _rivalled(base, better, models)


def beside_variation(
    start: Model, base: Model, better: Model, models: Sequence[Model], **_: object
) -> bool:
    """Return whether an effect is more than a stopgap for a variation that is not quite known.

    It has no rival; and beside two effects, whose forms leave a little as well, it takes a share of
    what the variation leaves of the gap.
    """
    alone, before, after = (m.mean_square for m in (start, base, better))
    little = before - after < _REMAINS * (alone - 1.0)
    return no_rival(base, better, models) and not (little and len(base.names) > 1)


def _rivalled(base: Model, better: Model, models: Sequence[Model]) -> bool:
    """Return whether effects of other kinds, that do something else, mend the base as well.

    What has the same beside something else says nothing against an effect.
    """
    added = _added(base, better)
    others = [m for m in models if not (_added(base, m) <= added or added <= _added(base, m))]
    return any(as_good(better, m) and not _same(base, better, m) for m in others)


def _same(base: Model, better: Model, other: Model) -> bool:
    """Return whether two explain the same part of what their base leaves: one under two names."""
    mine, others, left = (
        np.concatenate([m.fit.innovations.ravel(), m.validation.ravel()])
        for m in (better, other, base)
    )
    return float(((others - mine) ** 2).sum()) < _DIFFERENT * float(((left - mine) ** 2).sum())


def _added(base: Model, model: Model) -> set[str]:
    """Return the kinds of what a model has beside those of its base."""
    return {unit.effect.group for unit in model.beyond(base)}


def nothing_left(start: Model, best: Model) -> bool:
    """Return whether what is left is no share of the gap, or a small one no larger than noise."""
    if _leaves_less(start, best, _NUMERICAL):
        return True
    return leaves_little(start, best) and best.mean_square < _VISIBLE


def leaves_little(start: Model, best: Model) -> bool:
    """Return whether effects leave so small a share of the gap that it is hardly worth another."""
    return _leaves_less(start, best, _REMAINS)


def _leaves_less(start: Model, best: Model, share: float) -> bool:
    """Return whether effects leave less than a share of the gap: too little for one of its own.

    The true law in a simulator that integrates differently leaves as much.
    """
    alone, left = (m.fit.mean_square - 1.0 for m in (start, best))
    return bool(best.units) and left < share * alone
