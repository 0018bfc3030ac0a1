"""Which effects these data cannot tell from the one that explains them best."""

from __future__ import annotations

__all__ = ["confusion_set", "rivals", "settled", "stand_in"]

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from ..effects.effect import Effect
from ..effects.joints import Armature
from ..effects.transmission import ServoDeadBand
from .alternatives import kind
from .elimination import parts, without_idle
from .exchange import leaves_less_to_do, only_more
from .free_numbers import priced
from .model import Model, as_good, judged_fits
from .objective import Objective, Point
from .selection import Selection

_SAME = 2.0  # of a deviance: what fits of one and the same law may differ by
_TWIN = 0.1  # the same, of what acts in one and the same way
_LAST = 0.01  # of what an effect explains: too little to prefer one law to another
_FORM = 0.1  # of the same: how well the form of a law is known
_ELSEWHERE = 0.25  # of the same, by friction in contacts: chattering ones no fit follows exactly
_OTHER = 0.03  # of the same, by a law of another kind, where the best is not the true one
_COINCIDENCE = 6.0  # of a deviance: odds of 1 to 20
_MISSING = 0.01  # p-value of what a law leaves if it is the true one


def confusion_set(selection: Selection, name: str) -> tuple[str, ...]:
    """Return the names of effects that explain the data as well as one of the best model's.

    In the place of an effect stands another; both models were fitted with the same number of
    strengths. They are compared segment by segment, by the paired differences of the deviances and
    of their logarithms, which a few bad segments do not rule: the other is in the set unless one
    mean is above zero by more than two standard errors (a model confidence set, Hansen, Lunde &
    Nason 2011) and the likelihood says so too.

    Beside other effects, what acts like it is compared alone too, without their help: they were
    found next to it. What acts like it belongs to the set as well if it explains nearly as much, or
    much of what the effect leaves: the cause may have neither's form. So does what acts otherwise,
    where the best law leaves more than noise: then neither is the true one, and a little more
    explained is no proof. The first name is the effect's own.
    """
    own = selection.best.names
    others = [stand_in(selection, rival) for rival in rivals(selection, name, form=_FORM)]
    if len(own) == 1 and min(selection.p_values[1:], default=1.0) < _MISSING:
        others += [
            stand_in(selection, rival)
            for rival in _others(selection, name)
            if _short(selection, rival) < _OTHER
        ]
    if len(own) > 1:
        others += _alike_alone(selection, name)
    others += _alike_beside(selection, name)
    return tuple(dict.fromkeys([name, *(other for other in others if other not in own)]))


def _alike_alone(selection: Selection, name: str) -> list[str]:
    """Return what acts like an effect and, alone, explains the data as well as it does alone."""
    alone = [m for m in selection.tried if len(m.names) == 1]
    mine = [m for m in alone if m.units[0].name == name]
    if not mine:
        return []
    best = min(mine, key=lambda m: float(m.deviances().sum()))
    effect = best.units[0].effect
    return [
        m.units[0].name for m in alone if _alike(effect, m.units[0].effect) and as_good(best, m)
    ]


def _alike_beside(selection: Selection, name: str) -> list[str]:
    """Return what acts like an effect and, beside it, explains much that it leaves."""
    best = selection.best
    groups = {kind(unit.effect) for unit in best.units if unit.name == name}
    found = []
    for model in selection.tried:
        added = model.beyond(best)
        beside = len(model.units) == len(best.units) + len(added)
        if beside and {kind(unit.effect) for unit in added} == groups:
            less = float((best.deviances() - model.deviances()).sum())
            if less > _FORM * _explained(selection):
                found += [unit.name for unit in added]
    return found


def _explained(selection: Selection) -> float:
    """Return the deviance that the best model explains."""
    return float((selection.nominal.deviances() - selection.best.deviances()).sum())


def _alike(one: Effect, other: Effect) -> bool:
    """Return whether two effects act alike: of one group, or a servo's dead band and friction.

    A servo that ignores small errors stands still, as if there were stiction.
    """
    groups = {kind(one), kind(other)}
    servo = isinstance(one, ServoDeadBand) or isinstance(other, ServoDeadBand)
    return len(groups) == 1 or (servo and "friction" in groups)


def _sensing(model: Model) -> int:
    """Return how many faults of sensors a model has."""
    return sum(unit.effect.channel == "sensing" for unit in model.units)


def _driving(model: Model) -> int:
    """Return how many faults of drives a model has."""
    return sum(unit.effect.channel == "actuation" for unit in model.units)


def rivals(selection: Selection, name: str, *, form: float = _LAST) -> list[Model]:
    """Return the models with another effect in the place of one that are as good as the best.

    Or nearly: effects of one group may be one cause that has neither's form, so that all but the
    share ``form`` of what is explained is enough.
    """
    return [
        m
        for m in _others(selection, name)
        if as_good(selection.best, m) or _another_form(selection, m, name, form=form)
    ]


def _others(selection: Selection, name: str) -> list[Model]:
    """Return the models with another effect in the place of one, and not less than it alone."""
    best = set(selection.best.units)
    return [m for m in selection.alternatives.get(name, ()) if not set(m.units) <= best]


def _another_form(selection: Selection, rival: Model, name: str, *, form: float) -> bool:
    """Return whether a rival of the same group explains nearly all of the same."""
    best = selection.best
    mine = {kind(u.effect) for u in best.units if u.name == name}
    others = {kind(u.effect) for u in rival.instead(best)}
    groups = {u.effect.group for u in (*best.units, *rival.units) if kind(u.effect) in mine}
    least = form if len(groups) == 1 else max(form, _ELSEWHERE)
    return mine == others and _short(selection, rival) < least


def _short(selection: Selection, rival: Model) -> float:
    """Return how much less a rival explains than the best, as a share of what that explains."""
    more = float((rival.deviances() - selection.best.deviances()).sum())
    return more / max(_explained(selection), 1e-9)


def stand_in(selection: Selection, rival: Model) -> str:
    """Return the effect that a rival has in the place of one of the best model's."""
    return rival.instead(selection.best)[0].name


def settled(
    selection: Selection,
    name: str,
    sets: Mapping[str, Objective],
    *,
    causes: Callable[[Model], int] = lambda model: len(model.names),
) -> Selection:
    """Return the selection with that one of equals in front that explains most.

    Of training and validation, with a price for each number: test runs choose nothing. Where more
    than noise is left, deviances count by so much less (quasi-likelihood, Wedderburn 1974), or the
    one with the most strengths would mend most of that. Of those that explain the same it is one of
    the fewest causes, and of the likeliest group, all its effects together; of late commands and
    late sensors, the one with fewer faults of sensors, which needs no names of channels to be put
    on a simulator; of a law at one place, such as a payload that is held aside, and another at
    several, the one place; of twins, such as a bias of commands and a constant force, the drive's,
    which is looked at first, and not the one that rounding prefers. And of equals that leave the
    other effects more and less to make up for, the one that leaves less.

    Args:
        selection: What the search found.
        name: The effect whose equals are looked at.
        sets: Where models are fitted, ``train``, and where they are judged, ``validation``.
        causes: Returns of how many causes a model is; default as many as it has effects.
    """
    start, best = selection.nominal, selection.best
    equals = [best, *(m for m in rivals(selection, name) if not only_more(start, best, m))]
    costs = {model: _cost(model, selection) for model in equals}
    least = min(costs.values())
    same = [model for model in equals if costs[model] - least < _SAME]
    fewest = min(map(causes, same))
    same = [model for model in same if causes(model) == fewest]
    same = _of_the_likeliest_group(same, costs, selection, name)
    simple = {model: (_sensing(model), len(model.units)) for model in same}
    first = min(same, key=lambda model: (*simple[model], costs[model]))
    twins = [m for m in same if simple[m] == simple[first] and costs[m] < costs[first] + _TWIN]
    first = min(twins, key=lambda model: (-_driving(model), costs[model]))
    plainer = [m for m in equals if leaves_less_to_do(first, m) and _sensing(m) <= _sensing(first)]
    first = min(plainer, key=costs.__getitem__, default=first)
    if first is selection.best:
        return selection
    chosen, first = first, without_idle(sets["train"], sets["validation"], first)
    others = tuple(m for m in (selection.best, *selection.alternatives[name]) if m is not chosen)
    tried = (*selection.tried, *parts(sets["train"], sets["validation"], first))
    return replace(
        selection,
        best=first,
        tried=tried,
        alternatives={
            **{n: _beside(first, selection, n, sets) for n in selection.best.names if n != name},
            stand_in(selection, first): others,
        },
    )


def _cost(model: Model, selection: Selection) -> float:
    """Return the criterion, with a price for numbers of laws, and one for a coincidence.

    That all bodies of a robot are heavier, or all rotors larger, in the proportion of their ranges
    hardly happens: what one cause of another kind does, such as a gain of commands, looks like it.
    """
    everywhere = sum(
        unit.effect.group == Armature.group and sum(part != 0 for part in unit.direction) > 1
        for unit in model.units
    )
    dispersion = selection.best.dispersion()
    return priced(model, selection.offered, dispersion=dispersion) + _COINCIDENCE * everywhere


def _of_the_likeliest_group(
    models: Sequence[Model], costs: Mapping[Model, float], selection: Selection, name: str
) -> list[Model]:
    """Return the models with effects of one group, the likeliest if every effect may be there."""
    least = min(costs[model] for model in models)
    groups: dict[str, dict[str, float]] = {}
    group_of = {}
    for model in models:
        own = {unit for unit in model.units if unit.name == name}
        unit = next(iter(own)) if own else model.instead(selection.best)[0]
        group_of[model] = group = kind(unit.effect)
        likely = groups.setdefault(group, {})
        odds = math.exp(-0.5 * (costs[model] - least))
        likely[unit.name] = max(likely.get(unit.name, 0.0), odds)
    likeliest = max(groups, key=lambda group: sum(groups[group].values()))
    return [model for model in models if group_of[model] == likeliest]


def _beside(
    first: Model, selection: Selection, name: str, sets: Mapping[str, Objective]
) -> tuple[Model, ...]:
    """Return the rivals of an effect beside another one in front: they stood beside the old one."""
    new = {u: s for u, s in first.fit.point.strengths.items() if u.name != name}
    starts = []
    for rival in rivals(selection, name, form=_FORM):
        added = {u: rival.fit.point.strengths[u] for u in rival.instead(selection.best)}
        starts.append(Point(rival.fit.point.z, {**new, **added}))
    if not starts:
        return ()
    return tuple(judged_fits(sets["train"], sets["validation"], starts))
