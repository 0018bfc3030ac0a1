"""What validation runs say of the effects where test runs hardly show the gap.

Effects were chosen on them too, which flatters the share: so it must be larger, or surer.
"""

from __future__ import annotations

__all__ = [
    "NAMED",
    "NEGLIGIBLE",
    "PARTIAL",
    "SHOWN",
    "SURE",
    "enough",
    "hardly_shown",
    "share_on_validation",
]

from .selection import Selection
from .shrinkage import Shrinkage

PARTIAL = 0.4  # share of the gap that a cause explains at least
NAMED = 0.8  # share of the gap that a cause without reserve explains
NEGLIGIBLE = 1.05  # mean squared innovation: an excess over noise that no one would chase
SHOWN = 1.2  # mean squared innovation of runs that show a gap
SURE = 1e-5  # p-value of a gap that is there
_LARGELY = 0.5  # share of such a gap that is enough
_GONE = 50.0  # squares that are surely not of chance


def enough(p_value: float) -> float:
    """Return the share on validation runs that names a cause, for a gap of this p-value."""
    return _LARGELY if p_value < SURE else NAMED


def hardly_shown(measured: Shrinkage, validated: float) -> bool:
    """Return whether test runs show so little of the gap that they cannot say what explains it.

    Either there is hardly any, or they let the effects explain as much as validation runs say.
    """
    return measured.refit < SHOWN or measured.explained_ci[1] >= min(validated, NAMED)


def share_on_validation(selection: Selection) -> float:
    """Return the share of the gap that the effects explain on validation runs, 0 if they have none.

    ``(G_without - G_with) / (G_without - 1)`` of mean squared innovations, and of a gap that is
    hardly above the noise floor, but surely smaller with the effects, the same above what they
    leave: chaos may have set the floor too high.
    """
    without, left = (model.validation**2 for model in (selection.nominal, selection.best))
    before, after = float(without.mean()), float(left.mean())
    if before > SHOWN:
        return min((before - after) / (before - 1.0), 1.0)
    gone = float((without - left).sum()) > _GONE
    return (before - after) / (before - min(after, 1.0)) if gone else 0.0
