"""Which effects, together with the parameters, explain the data: search, then elimination.

Screening ranks units by linear algebra; what survives is fitted jointly with the parameters and
judged on validation segments. Effects interact: on robot logs one effect explained 13 % alone and
58 % beside another. So the search starts from the best units, the best *pairs* (all of them, from
the screen's correlations, at no cost), and each effect at all of its targets, and goes on from the
best few; afterwards every unit has to show that the model needs it.
"""

from __future__ import annotations

__all__ = ["Selection", "select"]

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ..logs.system import System
from .alternatives import alternatives, exchanged
from .elimination import eliminated, without_stopgaps
from .explanations import bent, compare, explanations
from .form_fit import (
    bendable,
    fitted_numbers,
    priced,
    with_fitted_forms,
    with_forms_anew,
)
from .further_effects import identified, nothing_left
from .model import WHITE, Model, as_good, criterion, gain, judged, needed
from .objective import Objective, Point, Unit
from .refit import Fit, refit
from .screening import Screen
from .shapes import with_shapes

_MOST = 4  # effects in one explanation
_UNSEEN = 1.0  # a deviance that no test can detect
_AGAIN = 3  # steps of fits whose noise was another
_FORMS = 3  # effects that are tried in other forms in one round
_EXCHANGES = 3  # of effects for others in their places
_EQUAL = 0.1  # of the deviance


@dataclass(frozen=True, eq=False)
class Selection:
    """What the search found.

    Attributes:
        nominal: Parameters alone.
        best: The explanation chosen; ``nominal`` where no effect is needed.
        screens: One per round, the first at the nominal fit.
        p_values: Of the largest likelihood ratio of each round.
        tried: Every model that was fitted.
        alternatives: For each effect of the best model, the models with another in its place.
    """

    nominal: Model
    best: Model
    screens: tuple[Screen, ...]
    p_values: tuple[float, ...]
    tried: tuple[Model, ...]
    alternatives: dict[str, tuple[Model, ...]]


def select(
    train: Objective,
    validation: Objective,
    nominal: Fit,
    units: Sequence[Unit],
    *,
    known: Selection | None = None,
    shapes: Callable[[Point], Sequence[Unit]] = lambda _: (),
    alpha: float = 0.01,
    generator: np.random.Generator,
    progress: Callable[[str], None] = lambda _: None,
) -> Selection:
    """Search for the effects that the data need.

    Args:
        train: Where models are fitted.
        validation: Where they are judged.
        nominal: The fit of the parameters alone.
        units: The effects to consider, at each of their targets.
        known: What was found before, with another noise: the search goes on from there.
        shapes: Returns those among them that have a frequency or a step, as they are seen beside
            what is in the model already.
        alpha: Level of the test that anything is missing, in every round.
        generator: Of the null distribution's draws.
        progress: Told what is done.
    """
    start = judged(train, validation, [nominal])[0]
    best, tried, screens, p_values, offered = start, [start], [], [], units
    worth = _worth(start, train.predictor.system)
    for round_number in range(_MOST):
        progress(f"screening {len(units)} effects, round {round_number + 1}")
        enough = nothing_left(start, best)
        left = [u for u in units if u not in best.units]
        if best.units and not enough:
            left = with_shapes(left, _beside(best, shapes(best.fit.point)))
        now = compare(train, best.fit, left, glance=enough)
        screens.append(now.seen)
        p_values.append(_p_value(now.seen, best, generator))
        # where much is left, what a first derivative does not see may still be the cause
        if enough or (p_values[-1] > alpha and not bent(best.fit)):
            break
        progress("fitting explanations")
        if known is not None and not best.units:
            models = _anew(train, validation, known)
            best, tried = models[0], [start, *models]
            units = _with_forms(units, best)
            continue
        models = judged(train, validation, explanations(train, now))
        tried += models
        better = _chosen(best, models)
        plain = partial(worth, seen=now.seen)
        better = _fewest((train, validation), best, better, models, worth=plain, offered=offered)
        if better is None or not plain(best, better, models):
            break
        best = _exactly(train, validation, better)
        best = with_fitted_forms(train, validation, best, offered)
        units = _with_forms(units, best)
        tried += [better, best]
    progress("taking out what is not needed")
    needs, dropped = eliminated(train, validation, best)
    if len(needs.units) < len(best.units):
        needs = with_forms_anew(train, validation, needs, offered)
    needs = without_stopgaps(train, validation, needs, offered)
    units = _with_forms(units, needs)
    tried += [*dropped, needs]
    best, others = _settled(
        train, validation, needs, units=units, tried=tried, first=screens[0], progress=progress
    )
    return Selection(start, best, tuple(screens), tuple(p_values), tuple(tried), others)


def _worth(start: Model, system: System) -> Callable[..., bool]:
    """Return what says whether a further effect is more than a stopgap on a robot."""
    timestep = float(system.task.model.opt.timestep)
    return partial(identified, start, timestep=timestep, robot=system.robot)


def _anew(train: Objective, validation: Objective, known: Selection) -> list[Model]:
    """Return the best model that was found, and the others that were tried, fitted again."""
    best = known.best.fit.point
    others = [m.fit.point for m in known.tried if m.units and m is not known.best]
    return judged(train, validation, refit(train, [best, *others], iterations=_AGAIN))


def _settled(
    train: Objective,
    validation: Objective,
    best: Model,
    *,
    units: Sequence[Unit],
    tried: list[Model],
    first: Screen,
    progress: Callable[[str], None],
) -> tuple[Model, dict[str, tuple[Model, ...]]]:
    """Return the best model, after exchanges, and the models with others instead."""
    for exchanges in range(_EXCHANGES + 1):
        if not best.units:
            break
        progress("trying others in its place")
        others = alternatives(train, validation, best, units=units, tried=tried, first=first)
        tried += [model for models in others.values() for model in models]
        better = exchanged(best, others)
        if better is best or exchanges == _EXCHANGES:
            return best, others
        best, dropped = eliminated(train, validation, _exactly(train, validation, better))
        tried += dropped
    return best, {}


def _with_forms(units: Sequence[Unit], model: Model) -> list[Unit]:
    """Return the units, those of a model with fitted forms in the places of their like."""
    return with_shapes(units, [unit for unit in model.units if unit not in units])


def _beyond(base: Model, model: Model) -> list[Unit]:
    """Return the units that a model has and its base has not."""
    return [unit for unit in model.units if unit not in base.units]


def _beside(model: Model, found: Sequence[Unit]) -> list[Unit]:
    """Return those that the model does not have at their places already."""
    there = {(unit.name, unit.where) for unit in model.units}
    return [unit for unit in found if (unit.name, unit.where) not in there]


def _exactly(train: Objective, validation: Objective, model: Model) -> Model:
    """Fit a model with the simulator's own time steps and forces that follow the state at each.

    Where that can be seen: forces that are held for 10 ms lag, and what lags looks like a delay to
    the next round.
    """
    if train.predictor.exact:
        return model
    exact = train.predictor.divided(train.predictor.system.task.frame_skip)
    exact.exactly()
    there = train.on(exact)([model.fit.point])[0]
    if float(((there - model.fit.innovations) ** 2).sum()) < _UNSEEN:
        return model
    for predictor in {train.predictor, validation.predictor}:
        predictor.exactly()
    return judged(train, validation, refit(train, [model.fit.point], iterations=4))[0]


def _p_value(seen: Screen, model: Model, generator: np.random.Generator) -> float:
    """Return how often noise alone would give the largest likelihood ratio of the screen."""
    if not len(seen.units):
        return 1.0
    dispersion = max(1.0, model.fit.mean_square)
    largest = float(seen.ratios(dispersion).max())
    null = seen.null(1000, generator)
    above = float((null >= largest).mean())
    if above > 0.02:
        return above
    # beyond the draws: the tail of a maximum falls like exp(-x/2)
    tail = np.quantile(null, 0.98)
    return float(0.02 * np.exp(-(largest - tail) / 2))


def _chosen(base: Model, models: Sequence[Model]) -> Model | None:
    """Return the best model, if the segments that it was not fitted on say that it is better."""
    dispersion = min([base.dispersion(), *(m.dispersion() for m in models)])
    better = [m for m in models if gain(base, m) > needed(base, m)]
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


def _fewest(
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
        bent = _in_other_forms(sets, base, singles, offered)
        least = priced(sets[0], base, offered)
        return next((m for m in bent if priced(sets[0], m, offered) < least), None)
    several, smaller = len(_new_names(base, better)) > 1, None
    if several:
        smaller = _chosen(base, singles)
        if smaller is not None and not worth(smaller, better, models):
            return better if _no_simpler(sets, smaller, better, offered) else smaller
    elif better.mean_square < WHITE:
        return better
    fitted = _in_other_forms(sets, base, singles, offered)
    if several:
        better = next((m for m in fitted if as_good(better, m)), better)
        return smaller if smaller is not None and not worth(base, better, models) else better
    own = with_fitted_forms(*sets, better, offered)
    return min([own, *fitted], key=lambda m: priced(sets[0], m, offered))


def _no_simpler(
    sets: tuple[Objective, Objective], single: Model, pair: Model, offered: Sequence[Unit]
) -> bool:
    """Return whether a pair explains more than a single effect that has as many numbers.

    A wave has a rate and a phase beside its strength, with which it is a spring that is off center.
    """
    train = sets[0]
    fewest = fitted_numbers(train, pair, offered)
    if fitted_numbers(train, single, offered) < fewest:
        return False
    single = with_fitted_forms(*sets, single, offered)
    return priced(train, pair, offered) < priced(train, single, offered)


def _in_other_forms(
    sets: tuple[Objective, Objective],
    base: Model,
    singles: Sequence[Model],
    offered: Sequence[Unit],
) -> list[Model]:
    """Return the best few models of one new effect whose law bends to the data, the best first.

    Whose law, or that of what is there already: what was bent to make up for the new effect is in
    its way.
    """
    train = sets[0]
    kinds: dict[str, Model] = {}
    for model in sorted(singles, key=lambda m: criterion(m, 1.0)):
        kinds.setdefault(_beyond(base, model)[0].name, model)
    laws = [u for u in offered if u.name in kinds and bendable(train, [u])]
    bends = set(kinds) if bendable(train, base.units) else {unit.name for unit in laws}
    plain = [m for name, m in kinds.items() if name in bends]
    plain = plain[:_FORMS]
    softer = [point for m in plain for point in _as_offered(train, m, _beyond(base, m), laws)]
    plain += judged(*sets, refit(train, softer, iterations=4)) if softer else []
    tried = {m: with_fitted_forms(*sets, m, offered) for m in plain}
    fitted = [bent for plain, bent in tried.items() if bent is not plain]
    fitted = [bent for bent in fitted if gain(base, bent) > needed(base, bent)]
    return sorted(fitted, key=lambda m: priced(sets[0], m, offered))


def _as_offered(
    train: Objective, model: Model, added: Sequence[Unit], laws: Sequence[Unit]
) -> list[Point]:
    """Return the model with laws that bend in the place of those that were added and do not."""
    if bendable(train, added):
        return []
    there = {(unit.name, unit.where): unit for unit in laws}
    others = {unit: there.get((unit.name, unit.where), unit) for unit in added}
    strengths = model.fit.point.strengths
    moved = {others.get(u, u): others.get(u, u).inside(s) for u, s in strengths.items()}
    return [Point(model.fit.point.z, moved)]


def _new_names(base: Model, model: Model) -> set[str]:
    """Return the effects that a model has beside those of its base."""
    return {unit.name for unit in _beyond(base, model)}
