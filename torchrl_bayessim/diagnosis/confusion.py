"""Which effects these data cannot tell from the one that explains them best."""

from __future__ import annotations

__all__ = ["confusion_set"]

from .selection import Selection, as_good


def confusion_set(selection: Selection, name: str) -> tuple[str, ...]:
    """Return the names of effects that explain the data as well as one of the best model's.

    In the place of an effect stands another; both models were fitted with the same number of
    strengths. They are compared segment by segment, by the paired differences of the deviances and
    of their logarithms, which a few bad segments do not rule: the other is in the set unless one
    mean is above zero by more than two standard errors (a model confidence set, Hansen, Lunde &
    Nason 2011) and the likelihood says so too.

    The first name is the effect's own.
    """
    best = selection.best
    names = [name]
    for rival in selection.alternatives.get(name, ()):
        new = [u.name for u in rival.units if u.name not in {v.name for v in best.units}]
        if as_good(best, rival):
            names += [other for other in dict.fromkeys(new) if other not in names]
    return tuple(names)
