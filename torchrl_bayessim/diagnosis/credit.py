"""Whose merit it is that a gap shrinks, where several effects were found."""

from __future__ import annotations

__all__ = ["credit_of", "shares", "unit_credit", "worthwhile"]

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from math import factorial

import numpy as np

from .elimination import parts
from .further_effects import surely_elsewhere
from .model import WHITE, Model, total_gain
from .objective import Objective, Unit
from .selection import Selection

_LEAST = 0.005  # of the credit, to be named beside another cause
_PLAIN = 25.0  # deviance that an effect removes, which chance hardly makes of any of a hundred
_OFF = 0.01  # p-value of what is left, below which a model is off somewhere
_MORE = 1.5  # times what is left with it, without


def worthwhile(
    selection: Selection, sets: Mapping[str, Objective], *, lasting: float | None = None
) -> Selection:
    """Return the selection, apart, without effects that have next to no credit.

    In a model that is a little off everywhere a further effect mends some of it, surely but for
    nothing; unless it is what no law at the places of the others could be.

    Args:
        selection: What was found.
        sets: Segments by split.
        lasting: Their share of the gap together, where the rest is due to commands or samples that
            were lost or late: a cause of its own.
    """
    share = 1.0 if lasting is None else lasting
    while True:
        selection = _apart(selection, sets)
        credit = credit_of(selection)
        least = min(credit, key=credit.__getitem__, default="")
        if len(credit) < 2 or share * credit[least] >= _LEAST:
            return selection
        kept = {unit for unit in selection.best.units if unit.name != least}
        without = [model for model in selection.tried if set(model.units) == kept]
        best = min(without, key=lambda model: float(model.deviances().sum()))
        if best.deviances().sum() > _MORE * selection.best.deviances().sum():
            return selection  # little of the gap, but most of what is left of it
        if lasting is None and _surely_needed(best, selection):
            return selection
        if surely_elsewhere(best, selection.best, sets["train"].predictor.system.robot):
            return selection
        selection = selection.reduced(best)


def _surely_needed(without: Model, selection: Selection) -> bool:
    """Return whether one of two effects is plainly needed by a model that is off nowhere."""
    best = selection.best
    if len(best.names) != 2 or best.mean_square > WHITE:
        return False  # a third one mends the forms of two others more easily
    # the last p-value may be of a model that was reduced since
    return total_gain(without, best) > _PLAIN and selection.p_values[-1] > _OFF


def _apart(selection: Selection, sets: Mapping[str, Objective]) -> Selection:
    """Return the selection with all fits without one of the effects among what was tried.

    Effects that were added together may never have been fitted one by one.
    """
    best = selection.best
    known = [set(model.units) for model in selection.tried]
    missing = [{u for u in best.units if u.name != name} not in known for name in best.names]
    if len(best.names) < 2 or not any(missing):
        return selection
    return replace(
        selection,
        tried=(*selection.tried, *parts(sets["train"], sets["validation"], best)),
    )


def credit_of(selection: Selection) -> dict[str, float]:
    """Return each effect's share of the deviance that all of them remove, over all orders."""
    names = list(selection.best.names)
    full = float(selection.best.deviances().sum())
    none = float(selection.nominal.deviances().sum())
    if not names or none <= full:
        return dict.fromkeys(names, 0.0)
    known = {frozenset(names): full, frozenset[str](): none}
    for model in selection.tried:
        inside = frozenset(model.names)
        if inside and inside < frozenset(names) and set(model.units) <= set(selection.best.units):
            known[inside] = min(known.get(inside, np.inf), float(model.deviances().sum()))

    def value(some: frozenset[str]) -> float:
        if some in known:
            return (none - known[some]) / (none - full)
        smaller = [known[other] for other in known if other <= some]
        return (none - min(smaller)) / (none - full)

    return shares(names, value)


def unit_credit(selection: Selection, credit: Mapping[str, float]) -> dict[Unit, float]:
    """Return the credit of each unit of the best model.

    Those of one effect share it by the squared length of what each changes.
    """
    fit = selection.best.fit
    sizes = {unit: float((fit.change(unit) ** 2).sum()) for unit in fit.units}
    sums = {name: sum(s for u, s in sizes.items() if u.name == name) for name in credit}
    return {
        u: max(credit.get(u.name, 0.0), 0.0) * size / max(sums.get(u.name, 0.0), 1e-30)
        for u, size in sizes.items()
    }


def shares(names: Sequence[str], value: Callable[[frozenset[str]], float]) -> dict[str, float]:
    """Return each member's credit, averaged over all orders of joining (Shapley 1953).

    Example:
        >>> credit = shares(["a", "b"], lambda s: {0: 0.0, 1: 0.3, 2: 1.0}[len(s)])
        >>> credit
        {'a': 0.5, 'b': 0.5}
    """
    count = len(names)
    credit = {}
    for name in names:
        others = [n for n in names if n != name]
        total = 0.0
        for size in range(count):
            weight = factorial(size) * factorial(count - size - 1) / factorial(count)
            for some in combinations(others, size):
                with_it = value(frozenset([*some, name]))
                total += weight * (with_it - value(frozenset(some)))
        credit[name] = total
    return credit
