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
from .choice import chosen, fewest
from .elimination import eliminated, without_stopgaps
from .explanations import bent, compare, explanations
from .form_fit import with_fitted_forms, with_forms_anew
from .further_effects import identified, nothing_left, stands_apart
from .model import Model, judged
from .objective import Objective, Point, Unit
from .refit import Fit, refit
from .screening import Screen
from .shapes import with_shapes

_MOST = 4  # effects in one explanation
_UNSEEN = 1.0  # a deviance that no test can detect
_AGAIN = 3  # steps of fits whose noise was another
_EXCHANGES = 3  # of effects for others in their places


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
        offered: The units that were considered, with effects as they were offered.
    """

    nominal: Model
    best: Model
    screens: tuple[Screen, ...]
    p_values: tuple[float, ...]
    tried: tuple[Model, ...]
    alternatives: dict[str, tuple[Model, ...]]
    offered: tuple[Unit, ...] = ()


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
    robot, worth = train.predictor.system.robot, _worth(start, train.predictor.system)
    for round_number in range(_MOST):
        progress(f"screening {len(units)} effects, round {round_number + 1}")
        enough, units = nothing_left(start, best), _with_forms(units, best)
        left = [u for u in units if u not in best.units]
        if best.units and not enough:
            left = with_shapes(left, _beside(best, shapes(best.fit.point)))
        now = compare(train, best.fit, left)
        screens.append(now.seen)
        p_values.append(_p_value(now.seen, best, generator))
        if known is not None and not best.units:
            models = _anew(train, validation, known)
            best, tried = models[0], [start, *models]
            continue
        if enough and not stands_apart(best, now.seen, robot):
            break
        # where much is left, what a first derivative does not see may still be the cause
        if p_values[-1] > alpha and not bent(best.fit):
            break
        progress("fitting explanations")
        models = judged(train, validation, explanations(train, now))
        tried += models
        better = chosen(best, models)
        plain = partial(worth, seen=now.seen)
        better = fewest((train, validation), best, better, models, worth=plain, offered=offered)
        if better is None or not plain(best, better, models):
            break
        exact = _exactly(train, validation, better)
        best = with_fitted_forms(train, validation, exact, offered)
        tried += [better, best]
    progress("taking out what is not needed")
    needs, dropped = eliminated(train, validation, best)
    if len(needs.units) < len(best.units):
        needs = with_forms_anew(train, validation, needs, offered)
    needs = without_stopgaps(train, validation, needs, offered)
    tried += [*dropped, needs]
    instead = partial(
        alternatives, train, validation,
        units=_with_forms(units, needs), first=screens[0], offered=offered,
    )  # fmt: skip
    best, others = _settled(train, validation, needs, instead, tried=tried, progress=progress)
    found = start, best, tuple(screens), tuple(p_values), tuple(tried), others
    return Selection(*found, offered=tuple(offered))


def _worth(start: Model, system: System) -> Callable[..., bool]:
    """Return what says whether a further effect is more than a stopgap on a robot."""
    timestep = float(system.task.model.opt.timestep)
    return partial(identified, start, timestep=timestep, robot=system.robot)


def _anew(train: Objective, validation: Objective, known: Selection) -> list[Model]:
    """Return the best model that was found, and the others that were tried, fitted again."""
    each: dict[frozenset[Unit], Model] = {frozenset(known.best.units): known.best}
    for model in sorted(known.tried, key=lambda m: m.mean_square):
        if model.units:
            each.setdefault(frozenset(model.units), model)
    points = [model.fit.point for model in each.values()]
    return judged(train, validation, refit(train, points, iterations=_AGAIN))


def _settled(
    train: Objective,
    validation: Objective,
    best: Model,
    instead: Callable[..., dict[str, tuple[Model, ...]]],
    *,
    tried: list[Model],
    progress: Callable[[str], None],
) -> tuple[Model, dict[str, tuple[Model, ...]]]:
    """Return the best model, after exchanges, and the models with others instead."""
    for exchanges in range(_EXCHANGES + 1):
        if not best.units:
            break
        progress("trying others in its place")
        others = instead(best, tried=tried)
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
