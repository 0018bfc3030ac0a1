"""Whether another effect is taken in the place of one of the best model's."""

from __future__ import annotations

__all__ = ["exchanged", "leaves_less_to_do", "only_more"]

from collections.abc import Collection, Mapping, Sequence
from functools import partial

from .free_numbers import priced
from .further_effects import leaves_little
from .model import LIKELY, Model, as_good, gain, needed, numbers
from .objective import Unit

_SMALLER = 0.75  # times: all strengths of an equal that is plainer
_SLIGHTLY = 2e-3  # of what is explained: what laws of a slightly other form leave
_LESS = 0.5  # times: of what an effect did that made up for another


def exchanged(
    start: Model,
    best: Model,
    others: Mapping[str, Sequence[Model]],
    offered: Collection[Unit] = (),
) -> Model:
    """Return the best of a model and its alternatives, itself unless chance is unlikely.

    More units than in one that leaves little have to explain a share (`only_more`), in either. Or
    unless one that is as good leaves less for the others to do (`leaves_less_to_do`).

    Args:
        start: Parameters alone.
        best: The model.
        others: Its alternatives, by the effect in whose place they have another.
        offered: The effects as they were offered: numbers that were fitted have their price.
    """
    cost = partial(priced, offered=offered, dispersion=best.dispersion())
    every = [model for models in others.values() for model in models]
    some = [m for m in every if not only_more(start, best, m)]
    candidates = [
        m for m in some if len(m.units) <= len(best.units) or gain(best, m) > needed(best, m)
    ]
    first = min([best, *candidates], key=cost)
    better_by = cost(best) - cost(first)
    if len(first.units) > len(best.units) and as_good(first, best):
        return best  # something is wrong with both, and more strengths mend more of it
    if better_by > LIKELY:
        return first
    plainer = [
        m for m in some if leaves_less_to_do(best, m) or only_more(start, other=best, best=m)
    ]
    return min(plainer, key=cost, default=best)


def only_more(start: Model, best: Model, other: Model) -> bool:
    """Return whether another has more units than a model that leaves little, for hardly more.

    What is left is as little as a law of a slightly other form leaves, and more strengths mend some
    of that whatever they are: a centre of mass that is shifted along two axes is more than a tilt.
    So they have to explain a share of all that is explained.
    """
    explained, more = (float((m.deviances() - other.deviances()).sum()) for m in (start, best))
    several = len(other.units) > len(best.units) and leaves_little(start, best)
    return several and more < _SLIGHTLY * explained


def leaves_less_to_do(best: Model, other: Model) -> bool:
    """Return whether the others have little to do beside another effect of a kind that is as good.

    Friction in one direction and a push that is half of it against the other are friction in both.
    All strengths together have to be smaller, as shares of their ranges: the other way round a push
    beside friction in both directions would be less push beside friction in one.
    """
    mine, others = _shares(best), _shares(other)
    shared = mine.keys() & others.keys()
    instead = {u.effect.group for u in others.keys() - shared}
    alike = instead == {u.effect.group for u in mine.keys() - shared} and len(instead) == 1
    if not alike or numbers(other) > numbers(best):
        return False
    made_up_for = any(others[unit] < _LESS * mine[unit] for unit in shared)
    smaller = sum(others.values()) < _SMALLER * sum(mine.values())
    return made_up_for and smaller and as_good(best, other)


def _shares(model: Model) -> dict[Unit, float]:
    """Return the size of each strength as a share of its range."""
    return {unit: abs(s / unit.high) for unit, s in model.fit.point.strengths.items()}
