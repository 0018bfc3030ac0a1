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
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..effects.action import ActionQuantization
from .alternatives import alternatives, exchanged, stands_in
from .choice import chosen, fewest
from .elimination import eliminated, without_stopgaps
from .explanations import Round, bent, compare, explanations
from .form_fit import with_fitted_forms, with_forms_anew
from .further_effects import identified, no_rival, nothing_left, stands_apart
from .little_left import all_of_little, little_left, one_alone
from .model import LIKELY, WHITE, Model, criterion, judged, judged_fits
from .objective import Objective, Point, Unit
from .refit import Fit
from .rounded_commands import rounded
from .screening import Screen
from .shapes import with_shapes
from .wavering import waver

Array = NDArray[np.float64]
_MOST = 4  # effects in one explanation
_UNSEEN = 1.0  # a deviance, in units of the dispersion, that no test can detect
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

    def reduced(self, best: Model, tried: Sequence[Model] = ()) -> Selection:
        """Return the selection with a best model of fewer effects, and its own alternatives.

        Args:
            best: That model. What was tried beside an effect that it lacks is no alternative to it,
                nor is what explains more: there was a reason not to take that.
            tried: What else was fitted.
        """
        every, others = (*self.tried, *tried), {}
        least = float(best.deviances().sum()) - LIKELY
        fair = dict.fromkeys(m for m in every if float(m.deviances().sum()) > least)
        for name in best.names:
            kept = [unit for unit in best.units if unit.name != name]
            others[name] = tuple(m for m in fair if stands_in(m, kept, name))
        return replace(self, best=best, alternatives=others, tried=every)


def select(
    train: Objective,
    validation: Objective,
    nominal: Fit,
    units: Sequence[Unit],
    *,
    known: Selection | None = None,
    varied: bool = False,
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
        varied: Whether what varies counts as noise: less than white noise may still hold an effect.
        shapes: Returns those among them that have a frequency or a step, as they are seen beside
            what is in the model already.
        alpha: Level of the test that anything is missing, in every round.
        generator: Of the null distribution's draws.
        progress: Told what is done.
    """
    start = judged(train, validation, [nominal])[0]
    search = _Search(
        train, validation, start, units,
        known=known, varied=varied,
        shapes=shapes, alpha=alpha, generator=generator, progress=progress,
    )  # fmt: skip
    needs = search.best()
    instead = partial(
        alternatives, train, validation,
        units=_with_forms(search.units, needs), first=search.screens[0], offered=units,
    )  # fmt: skip
    best, others = _settled(
        train, validation, needs, instead, tried=search.tried, progress=progress
    )
    found = tuple(search.screens), tuple(search.p_values), tuple(search.tried), others
    return Selection(start, best, *found, offered=tuple(units))


class _Search:
    """Rounds that each add to a model, and take out again what it does not need."""

    def __init__(
        self,
        train: Objective,
        validation: Objective,
        start: Model,
        offered: Sequence[Unit],
        *,
        known: Selection | None,
        varied: bool,
        shapes: Callable[[Point], Sequence[Unit]],
        alpha: float,
        generator: np.random.Generator,
        progress: Callable[[str], None],
    ) -> None:
        self.sets, self.start, self.offered = (train, validation), start, offered
        self.known, self.shapes, self.alpha, self.varied = known, shapes, alpha, varied
        self.generator, self.progress = generator, progress
        self.worth = no_rival if varied else _worth(start, train)
        self.units: Sequence[Unit] = offered
        self.tried, self.screens, self.p_values = [start], list[Screen](), list[float]()

    def best(self) -> Model:
        """Return what the data need: what is found beside less than a round had counts too."""
        best = self.start
        for rounds in range(1, _MOST + 1):
            further = self._further(best)
            found = further or best
            if further is not None and rounds < _MOST:
                best = found
                continue
            best = self._needs(found)
            enough = nothing_left(self.start, best) or best.mean_square < WHITE
            if enough or len(best.names) == len(found.names):
                break
        return best

    def _further(self, best: Model) -> Model | None:
        """Return the model with what it lacks most; nothing where it lacks nothing."""
        train = self.sets[0]
        self.progress(f"screening {len(self.units)} effects, round {len(self.screens) + 1}")
        enough = nothing_left(self.start, best) and not self.varied
        self.units = _with_forms(self.units, best)
        left = [u for u in self.units if u not in best.units]
        if best.units and not enough:
            left = with_shapes(left, _beside(best, self.shapes(best.fit.point)))
        now = compare(train, best.fit, left)
        self.screens.append(now.seen)
        self.p_values.append(_p_value(now.seen, best, self.generator))
        if self.known is not None and not best.units:
            models = _anew(*self.sets, self.known)
            self.tried = [self.start, *models]
            return models[0]
        apart = not enough or stands_apart(best, now.seen, train.predictor.system.robot)
        if not apart and not self._little(best, now.seen):
            return None
        # where much is left, what a first derivative does not see may still be the cause
        if self.p_values[-1] > self.alpha and not bent(best.fit):
            return None
        self.progress("fitting explanations")
        better = self._explained(
            now,
            partial(self._better, best, seen=now.seen)
            if apart
            else partial(self._all, best, left=left),
        )
        unknown = better is None or ActionQuantization.name in better.names
        if best.units or self.varied or not unknown:
            return better
        self.progress("looking for rounded commands")
        steps = rounded(train, best.fit, self.units)
        stepped = None
        if steps:
            now = compare(train, best.fit, steps)
            stepped = self._explained(now, partial(self._better, best, seen=now.seen))
        found = [model for model in (better, stepped) if model is not None]
        return min(found, key=lambda model: criterion(model, 1.0), default=None)

    def _little(self, best: Model, seen: Screen) -> bool:
        """Return whether little is left, and one effect may be all of it."""
        dispersion = max(1.0, best.fit.mean_square)
        little = little_left(best, self.p_values[-1], self.sets[0])
        return little and one_alone(seen, dispersion, self.generator)

    def _explained(
        self, now: Round, best_of: Callable[[Sequence[Model]], Model | None]
    ) -> Model | None:
        """Return the best model with what a comparison suggests; nothing where none is worth it."""
        models = judged(*self.sets, explanations(self.sets[0], now))
        if self.varied:  # several at once make up for a variation that is not quite known
            there = {unit.name for unit in now.base.units}
            models = [model for model in models if len(model.names - there) < 2]
        self.tried += models
        better = best_of(models)
        if better is None:
            return None
        fitted = with_fitted_forms(*self.sets, _exactly(*self.sets, better), self.offered)
        self.tried += [better, fitted]
        return fitted

    def _better(self, best: Model, models: Sequence[Model], seen: Screen) -> Model | None:
        """Return the best model with more than the base, if that is worth it."""
        worth = partial(self.worth, seen=seen)
        better = chosen(best, models)
        better = fewest(self.sets, best, better, models, worth=worth, offered=self.offered)
        return better if better is not None and worth(best, better, models) else None

    def _all(self, best: Model, models: Sequence[Model], left: Sequence[Unit]) -> Model | None:
        """Return the model with one effect more, if that is all of the little that is left."""
        missing = lambda seen, model: _p_value(seen, model, self.generator) < self.alpha
        train = self.sets[0]
        return all_of_little(self.start, best, models, train=train, left=left, missing=missing)

    def _needs(self, best: Model) -> Model:
        """Return the model without the effects that it does not need."""
        self.progress("taking out what is not needed")
        needs, dropped = eliminated(*self.sets, best)
        if len(needs.units) < len(best.units):
            needs = with_forms_anew(*self.sets, needs, self.offered)
        needs = without_stopgaps(*self.sets, needs, self.offered)
        self.tried += [*dropped, needs]
        return needs


def _worth(start: Model, train: Objective) -> Callable[..., bool]:
    """Return what says whether a further effect is more than a stopgap on a robot."""
    system = train.predictor.system
    timestep = float(system.task.model.opt.timestep)
    told = partial(identified, start, timestep=timestep, robot=system.robot)

    def worth(base: Model, better: Model, models: Sequence[Model], **seen: Any) -> bool:
        return told(base, better, models, **seen) and not waver(base, better, train.segments)

    return worth


def _anew(train: Objective, validation: Objective, known: Selection) -> list[Model]:
    """Return the best model that was found, and the others that were tried, fitted again."""
    each: dict[frozenset[Unit], Model] = {frozenset(known.best.units): known.best}
    for model in sorted(known.tried, key=lambda m: m.mean_square):
        if model.units:
            each.setdefault(frozenset(model.units), model)
    points = [model.fit.point for model in each.values()]
    return judged_fits(train, validation, points, iterations=_AGAIN)


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
    """Fit a model with forces that follow the state at each time step, as many as can be told.

    Forces that are held for 10 ms lag, and what lags looks like a delay to the next round. Where
    something is missing still, less of it can be told: deviances count by their dispersion.
    """
    own = train.predictor.system.task.frame_skip
    if train.predictor.exact and train.predictor.substeps == own:
        return model
    tolerated = _UNSEEN * max(1.0, model.fit.mean_square)

    def exact(substeps: int) -> Array:
        other = train.predictor.divided(substeps)
        other.exactly(substeps)
        return train.on(other)([model.fit.point])[0]

    true = exact(own)
    if float(((true - model.fit.innovations) ** 2).sum()) < tolerated:
        return model
    fewer = (n for n in range(train.predictor.substeps, own) if own % n == 0)
    near = (n for n in fewer if float(((true - exact(n)) ** 2).sum()) < tolerated)
    substeps = next(near, own)
    for predictor in {train.predictor, validation.predictor}:
        predictor.exactly(substeps)
    return judged_fits(train, validation, [model.fit.point], iterations=4)[0]


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
