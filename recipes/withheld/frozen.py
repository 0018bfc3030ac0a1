"""What the methods were set on, beside what a run scores: both are printed with every run.

Thresholds, laws and the search were changed on cases whose labels were known: those of the seeds
below, once they were scored, on the real logs of the tests and on the tests' own robots. A seed
draws parameters, causes, places, strengths, noise and motions anew. Kinds of robots and causes are
the same, since these are what the diagnosis is for; what it has never met at all is tier T4, and
what it is not allowed to name T3.
"""

from __future__ import annotations

__all__ = ["SEEDS", "lists", "told"]

from collections.abc import Mapping, Sequence
from typing import Any

from .causes_foreign import FOREIGN
from .plans import applicable

# Scored once, after which their failures were looked at; then those that were for trying only
SEEDS = (
    *(2211, 2213, 2214, 2215, 4471, 5083, 9207, 9401, 9402),
    *(9501, 9502, 9503, 9504, 9505, 9506, 9507, 9508, 9509),
    *(9510, 9511, 9512, 9513, 9514, 9515, 9516, 9517, 9518, 9519, 9520),
    *(9521, 9522, 9523, 9524, 9525, 9527, 9529, 9530, 9531, 9532, 9533, 9534, 9535, 9536, 9537),
    *(9538, 9539, 9540, 9541, 9542, 9543, 9544, 9545, 9546, 9547, 9548, 9549, 9550, 9551),
    *(8801, 8802, 8803, 8901, 8902, 8911, 8912, 8913, 9526, 9528),
)
_ROBOTS = "arm", "two_links", "cart_pole", "hopper", "half_cheetah", "fetch_push"


def lists(seed: int, robots: Sequence[str], tiers: Mapping[str, int]) -> dict[str, Any]:
    """Return both lists, and whether the seed is new, so that a run of it is blind.

    Args:
        seed: Of the run.
        robots: That are drawn.
        tiers: Cases by tier.
    """
    causes = set(FOREIGN) if "T4" in tiers else set()
    if set(tiers) - {"T0", "T4"}:
        causes |= _causes(robots)
    return {
        "set_on": {
            "seeds": list(SEEDS),
            "robots": list(_ROBOTS),
            "causes": sorted(_causes(_ROBOTS)),
        },
        "scored": {"seeds": [seed], "robots": list(robots), "causes": sorted(causes)},
        "blind": seed not in SEEDS,
    }


def told(found: Mapping[str, Any]) -> str:
    """Return both lists in words, a line each, and a third on the seed."""
    lines = [
        f"{lead}: " + "; ".join(_of(kind, names) for kind, names in found[name].items())
        for name, lead in (("set_on", "methods were set on"), ("scored", "scored"))
    ]
    blind = "no case of this seed was seen before"
    seen = "this seed was seen before: its figures are not those of a blind run"
    return "\n".join([*lines, blind if found["blind"] else seen])


def _causes(robots: Sequence[str]) -> set[str]:
    forms = "same", "other"
    return {name for robot in robots for form in forms for name in applicable(robot, form)}


def _of(kind: str, names: Sequence[Any]) -> str:
    return f"{kind} {', '.join(map(str, names)) or 'none'}"
