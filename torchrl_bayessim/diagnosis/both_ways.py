"""Friction in both directions and a push, in the place of friction in one direction.

Dry friction ``s`` in one direction is ``s / 2`` in both and a push of ``s / 2``. Friction in both
and a push of about as much are nearly that, so a search takes one effect for two.
"""

from __future__ import annotations

__all__ = ["both_ways"]

from collections.abc import Sequence
from dataclasses import replace

from ..effects.action import ActionBias
from ..effects.disturbance import ConstantForce
from ..effects.friction import DirectionalFriction
from ..effects.joints import CoulombFriction
from .model import Model, judged_fits, takes_most
from .objective import Objective, Unit

_LEFT = 5.0  # mean squared innovation: friction in one direction is not what happened


def both_ways(
    sets: tuple[Objective, Objective], best: Model, name: str, units: Sequence[Unit]
) -> list[Model]:
    """Return models with friction in both directions and a push that take most of what is left.

    Args:
        sets: Where models are fitted, and where they are judged.
        best: The model.
        name: Its effect that is replaced: nothing is, unless it is friction in one direction of one
            joint with neither the other nor a push, and more than noise is left.
        units: The effects to consider, dry friction in each of its forms.
    """
    mine = [unit for unit in best.units if unit.name == name]
    if name != DirectionalFriction.name or len(mine) != 1 or best.mean_square < _LEFT:
        return []
    robot, strengths = sets[0].predictor.system.robot, best.fit.point.strengths
    here, there = (
        [u for u in some if u.joint(robot) == mine[0].joint(robot) >= 0]
        for some in (units, best.units)
    )
    if any(_is_dry(unit) or _pushes(unit) for unit in there):
        return []
    dry, pushes = filter(_is_dry, here), list(filter(_pushes, here))
    half, kept = abs(strengths[mine[0]]) / 2, {u: s for u, s in strengths.items() if u != mine[0]}
    starts = [
        replace(best.fit.point, strengths={**kept, unit: unit.inside(half), push: 0.0})
        for unit in dry
        for push in pushes
    ]
    found = judged_fits(*sets, starts) if starts else []
    return [model for model in found if takes_most(best, model)]


def _is_dry(unit: Unit) -> bool:
    return unit.name == CoulombFriction.name


def _pushes(unit: Unit) -> bool:
    return isinstance(unit.effect, ActionBias | ConstantForce)
