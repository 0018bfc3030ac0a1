"""Why an effect that explains the data should still not be named without reserve."""

from __future__ import annotations

__all__ = ["baseless", "doubts"]

from collections.abc import Sequence

import numpy as np

from .objective import Unit
from .preparation import Prepared
from .report import Finding

_EDGE = 0.98  # of the largest strength that is looked for
_ANYTHING = -np.inf, np.inf


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


def _ends(units: Sequence[Unit]) -> dict[tuple[str, str], tuple[float, float]]:
    return {(u.name, u.where): (round(u.actual(u.low), 12), u.actual(u.high)) for u in units}


def _at_end(strength: float, ends: tuple[float, float]) -> bool:
    low, high = ends
    return not (_EDGE * low if low < 0 else -np.inf) < strength < _EDGE * high


def _of_strength(effect: Finding, ends: dict[tuple[str, str], tuple[float, float]]) -> list[str]:
    name, unit = effect.name.replace("_", " "), effect.unit
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
