"""Which of the explanations that a round has fitted the search goes on with: the fewest effects."""

from __future__ import annotations

__all__ = ["chosen", "fewest"]

from collections.abc import Callable, Mapping, Sequence

from .form_fit import with_fitted_forms
from .free_numbers import bendable, fitted_numbers, priced
from .model import (
    WHITE,
    Model,
    as_good,
    best_by_effect,
    criterion,
    gain,
    judged_fits,
    needed,
    shown,
)
from .objective import Objective, Point, Unit

_FORMS = 3  # effects that are tried in other forms in one round
_EQUAL = 0.1  # of the deviance


def chosen(base: Model, models: Sequence[Model]) -> Model | None:
    """Return the best model, if the segments that it was not fitted on say that it is better."""
    dispersion = min([base.dispersion(), *(m.dispersion() for m in models)])
    better = [m for m in models if shown(base, m)]
    if not better:
        return None
    least = min(criterion(m, dispersion) for m in better)
    # of twins, such as a bias of commands and a constant force, not the one that rounding prefers
    equal = [m for m in better if criterion(m, dispersion) < least + _EQUAL]
    first = min(equal, key=lambda m: [str(unit) for unit in m.units])
    return min([first, *_coarser(first, better)], key=lambda m: len(m.units))


def _coarser(model: Model, models: Sequence[Model]) -> list[Model]:
    """Return models of the same kinds of effects with fewer strengths, unless they predict worse.

    One strength at all places may stand for one at each.
    """
    kinds = {unit.effect.group for unit in model.units}
    return [
        m
        for m in models
        if {u.effect.group for u in m.units} == kinds
        and len(m.units) < len(model.units)
        and (gain(m, model) <= needed(m, model) or as_good(model, m))
    ]


def fewest(
    sets: tuple[Objective, Objective],
    base: Model,
    better: Model | None,
    models: Sequence[Model],
    *,
    worth: Callable[..., bool],
    offered: Sequence[Unit],
) -> Model | None:
    """Return the best model, or one with a single new effect where more are a stopgap.

    Or where that effect explains as much in another form, which others imitate. Where none is
    better, one that is if its law is bent.
    """
    singles = [m for m in models if len(_new_names(base, m)) == 1]
    if better is None:  # a law in a wrong form may fit some runs and predict no others
        bent = _worth_bending(base, _in_other_forms(sets, base, singles, offered), offered)
        least = priced(base, offered)
        return next((m for m in bent if priced(m, offered) < least), None)
    several, smaller = len(_new_names(base, better)) > 1, None
    if several:
        smaller = chosen(base, singles)
        # a screen of the base says nothing of what is beside the smaller one
        if smaller is not None and not worth(smaller, better, models, seen=None):
            if _no_simpler(sets, smaller, better, offered):
                return better
            # a law that was bent to make up for the new effect lets its rivals do as well
            white = smaller.mean_square < WHITE
            return smaller if white else with_fitted_forms(*sets, smaller, offered)
    elif better.mean_square < WHITE:
        return better
    tried = _in_other_forms(sets, base, singles, offered)
    fitted = _worth_bending(base, tried, offered)
    if several:
        better = next((m for m in fitted if as_good(better, m)), better)
        return smaller if smaller is not None and not worth(base, better, models) else better
    own = tried.get(better) or with_fitted_forms(*sets, better, offered)
    return min([own, *fitted], key=lambda m: priced(m, offered))


def _no_simpler(
    sets: tuple[Objective, Objective], single: Model, pair: Model, offered: Sequence[Unit]
) -> bool:
    """Return whether a pair explains more than a single effect that has as many numbers.

    A wave has a rate and a phase beside its strength, with which it is a spring that is off center.
    """
    if fitted_numbers(single, offered) < fitted_numbers(pair, offered):
        return False
    single = with_fitted_forms(*sets, single, offered)
    return priced(pair, offered) < priced(single, offered)


def _in_other_forms(
    sets: tuple[Objective, Objective],
    base: Model,
    singles: Sequence[Model],
    offered: Sequence[Unit],
) -> dict[Model, Model]:
    """Return the best few models of one new effect as they are, and with laws bent to the data.

    Its law, or that of what is there already: what was bent to make up for the new effect is in its
    way.
    """
    train = sets[0]
    kinds = best_by_effect(singles, base)
    laws = [u for u in offered if u.name in kinds and bendable(train, [u])]
    bends = set(kinds) if bendable(train, base.units) else {unit.name for unit in laws}
    plain = [m for name, m in kinds.items() if name in bends]
    plain = plain[:_FORMS]
    softer = [point for m in plain for point in _as_offered(train, m, m.beyond(base), laws)]
    plain += judged_fits(*sets, softer, iterations=4) if softer else []
    return {m: with_fitted_forms(*sets, m, offered) for m in plain}


def _worth_bending(
    base: Model,
    tried: Mapping[Model, Model],
    offered: Sequence[Unit],
) -> list[Model]:
    """Return those that gain by their bent laws, and that explain what no fit saw, best first."""
    fitted = [bent for plain, bent in tried.items() if bent is not plain]
    fitted = [bent for bent in fitted if gain(base, bent) > needed(base, bent)]
    return sorted(fitted, key=lambda m: priced(m, offered))


def _as_offered(
    train: Objective, model: Model, added: Sequence[Unit], laws: Sequence[Unit]
) -> list[Point]:
    """Return the model with laws that bend in the place of those that were added and do not."""
    if bendable(train, added):
        return []
    there = {(unit.name, unit.where): unit for unit in laws}
    others = {unit: there[at] for unit in added if (at := (unit.name, unit.where)) in there}
    if not others:
        return []
    strengths = model.fit.point.strengths
    moved = {others.get(u, u): others.get(u, u).inside(s) for u, s in strengths.items()}
    return [Point(model.fit.point.z, moved)]


def _new_names(base: Model, model: Model) -> set[str]:
    """Return the effects that a model has beside those of its base."""
    return {unit.name for unit in model.beyond(base)}
