"""The search for what explains the data: rounds that each add effects to a model.

A round screens all units beside the model that there is, fits what may be added, and keeps what is
worth it; in the end every unit has to show that the model needs it, and what is found beside less
than a round had counts too. Where that leaves more than noise, or is more than two effects, two are
looked for of which neither explains most alone.
"""

from __future__ import annotations

__all__ = ["MANY", "Search", "with_forms_of"]

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..effects.action import ActionQuantization
from .bent_laws import fitted_best
from .choice import chosen, fewest
from .elimination import eliminated, without_stopgaps
from .explanations import Round, bent, compare, explanations
from .form_fit import softened, with_fitted_forms, with_forms_anew
from .free_numbers import priced
from .further_effects import beside_variation, identified, nothing_left, stands_apart
from .little_left import all_of_little, little_left, one_alone
from .model import (
    WHITE,
    Model,
    as_good,
    best_by_effect,
    criterion,
    judged,
    shown,
    takes_most,
)
from .objective import Objective, Point, Unit
from .refit import Fit, refit
from .rounded_commands import rounded
from .screening import Screen
from .shapes import with_shapes
from .time_steps import exactly
from .wavering import waver
from .waves_anew import with_waves_anew

Array = NDArray[np.float64]
_MOST = 4  # effects in one explanation
_LESS, _FORMS = 0.05, 3  # of what is explained; models that explain all but that
_MUCH = 1.5  # mean squared innovation: a law with a corner may leave as much of a soft one
_ROUGH, _BEGINNINGS = 2.0, 5  # mean squared innovation of what two may explain; others tried
_PAIR = 2  # effects
MANY = 150  # effects at their places, of which another round takes too long


class Search:
    """Rounds that each add to a model, and take out again what it does not need.

    Args:
        train: Where models are fitted.
        validation: Where they are judged.
        start: The parameters alone.
        offered: The effects to consider, at each of their targets.
        again: Returns the models to go on from, the best first, where there are some; None to
            begin with none.
        varied: Whether what varies counts as noise: less than white noise may still hold an effect.
        shapes: Returns effects that have a frequency or a step, as they are seen beside a model.
        alpha: Level of the test that anything is missing, in every round.
        generator: Of the null distribution's draws.
        progress: Told what is done.

    Attributes:
        units: The effects, those of the model that was found in the forms that fit.
        screens: One per round.
        p_values: Of the largest likelihood ratio of each round.
        screened: Names of the effects beside which the last of them was found.
        tried: Every model that was fitted.
    """

    def __init__(
        self,
        train: Objective,
        validation: Objective,
        start: Model,
        offered: Sequence[Unit],
        *,
        again: Callable[[], list[Model]] | None,
        varied: bool,
        shapes: Callable[[Point], Sequence[Unit]],
        alpha: float,
        generator: np.random.Generator,
        progress: Callable[[str], None],
    ) -> None:
        self.sets, self.start, self.offered = (train, validation), start, offered
        self.again, self.shapes, self.alpha, self.varied = again, shapes, alpha, varied
        self.generator, self.progress = generator, progress
        self.worth = partial(beside_variation, start) if varied else _worth(start, train)
        self.units: Sequence[Unit] = offered
        self.tried, self.screens, self.p_values = [start], list[Screen](), list[float]()
        self.screened = frozenset[str]()

    def best(self, base: Model | None = None) -> Model:
        """Return what the data need: what is found beside less than a round had counts too.

        Args:
            base: To go on from; default the parameters alone.
        """
        best = base or self.start
        for rounds in range(1 + len(best.names), _MOST + 1):
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

    def or_two_others(self, best: Model) -> Model:
        """Return the model, or one of two effects that leave noise alone and stand in its place.

        The effect that explains most alone may be neither of them: a spring beside a heavier rotor
        is nearly a payload. So a search that began anew goes on from what explains less alone, too.
        Three or more effects give way to two that cost less, with a price for each number.
        """
        if not self._may_be_two_others(best):
            return best
        others = [m for m in self.tried if len(m.names) == 1 and not m.names & best.names]
        begun = list(best_by_effect(others, self.start).values())[:_BEGINNINGS]
        tried = list(self.tried)
        pairs = [two for two in map(self._two, begun) if two is not None]
        found = [two for two in pairs if self._instead(best, two)]
        two = min(found, key=lambda two: criterion(two, 1.0), default=best)
        if two is best or any(as_good(two, other) for other in pairs if other is not two):
            self.tried[:] = tried
            return best
        self.units = self.offered
        return two

    def _may_be_two_others(self, best: Model) -> bool:
        """Return whether more than noise is left, or more was found than two effects."""
        if self.again is not None or len(self.offered) > MANY or not best.units:
            return False
        rough = _ROUGH if len(best.names) == 1 else WHITE  # a law may have another form
        return len(best.names) > _PAIR or best.mean_square >= rough

    def _instead(self, best: Model, two: Model) -> bool:
        """Return whether two effects stand in the place of a model's."""
        if best.mean_square >= WHITE and takes_most(best, two) and shown(best, two):
            return True
        cost = partial(priced, offered=self.offered, dispersion=best.dispersion())
        return len(best.names) > _PAIR and cost(two) < cost(best)

    def _two(self, one: Model) -> Model | None:
        """Return a model of an effect and a second one, if they leave noise alone."""
        self.progress(f"searching on from {next(iter(one.names))}")
        base = refit(self.sets[0], [one.fit.point], iterations=0)[0]
        left = [unit for unit in with_forms_of(self.offered, one) if unit not in one.units]
        left = with_shapes(left, _beside(one, self.shapes(base.point)))
        now = compare(self.sets[0], base, left)
        better = lambda models: self._better(one, models, seen=now.seen)
        two = self._explained(now, lambda models: better([m for m in models if len(m.names) == 2]))
        two = None if two is None else self._needs(two)
        white = two is not None and len(two.names) == 2 and two.mean_square < WHITE
        return two if white else None

    def _further(self, best: Model) -> Model | None:
        """Return the model with what it lacks most; nothing where it lacks nothing."""
        train = self.sets[0]
        self.progress(f"screening {len(self.units)} effects, round {len(self.screens) + 1}")
        enough = nothing_left(self.start, best) and not self.varied
        self.units = with_forms_of(self.units, best)
        left = [u for u in self.units if u not in best.units]
        if best.units and not enough:
            left = with_shapes(left, _beside(best, self.shapes(best.fit.point)))
        now = compare(train, best.fit, left)
        self.screens.append(now.seen)
        self.p_values.append(_p_value(now.seen, best, self.generator))
        self.screened = frozenset(best.names)
        if self.again is not None and not best.units and len(self.screens) == 1:
            models = self.again()
            self.tried = [self.start, *models]
            if models[0].units:
                return models[0]
            if not self.varied:
                return None  # with another noise, nothing is still nothing
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
        if best.units or not _may_be_rounded(best, better):
            return better
        return self._or_rounded(best, better)

    def _or_rounded(self, best: Model, better: Model | None) -> Model | None:
        """Return the better model, or one with commands that are rounded to a step of their own."""
        if self.varied:
            return better
        self.progress("looking for rounded commands")
        # what was found may have forces that are followed more closely since
        base = refit(self.sets[0], [best.fit.point], iterations=0)[0]
        steps, stepped = rounded(self.sets[0], base, self.units), None
        if steps:
            now = compare(self.sets[0], base, steps)
            stepped = self._explained(now, partial(self._better, best, seen=now.seen))
        found = [model for model in (better, stepped) if model is not None]
        return min(found, key=lambda model: criterion(model, 1.0), default=None)

    def _little(self, best: Model, seen: Screen) -> bool:
        """Return whether little is left, and one effect may be all of it."""
        dispersion = max(1.0, best.fit.mean_square)
        little = little_left(best, self.p_values[-1])
        return little and one_alone(seen, dispersion, self.generator)

    def _explained(
        self, now: Round, best_of: Callable[[Sequence[Model]], Model | None]
    ) -> Model | None:
        """Return the best model with what a comparison suggests; nothing where none is worth it."""
        models = judged(*self.sets, explanations(self.sets[0], now))
        if self.varied:  # several at once make up for a variation that is not quite known
            there = {unit.name for unit in now.base.units}
            models = [model for model in models if len(model.names - there) < 2]
        better = best_of(models)
        formed = fitted_best(self.sets, better, models, self.offered)
        if formed:
            models += formed
            better = best_of(models)
        self.tried += models
        if better is None:
            return None
        fitted = with_fitted_forms(*self.sets, exactly(*self.sets, better), self.offered)
        self.tried += [better, fitted]
        if fitted.dispersion() < _MUCH:
            return fitted
        # of what is alike between corners, such as a push and a bias before a limit, each
        near = [m for m in models if m is not better and _nearly(now.base, better, m)]
        near.sort(key=lambda model: model.fit.cost)
        soft = softened(*self.sets, [fitted, *near], self.offered, most=_FORMS)
        self.tried += soft
        return min([fitted, *soft], key=lambda model: priced(model, self.offered))

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
        """Return the model without the effects that it does not need, its waves read off anew."""
        if any(unit.effect.placed for unit in best.units):
            self.progress("reading waves off anew")
            known, best = best, with_waves_anew(self.sets, best, self.shapes, self.offered)
            self.tried += [best] if best is not known else []
        self.progress("taking out what is not needed")
        needs, dropped = eliminated(*self.sets, best)
        if len(needs.units) < len(best.units):
            needs = with_forms_anew(*self.sets, needs, self.offered)
        needs = without_stopgaps(*self.sets, needs, self.offered)
        self.tried += [*dropped, needs]
        return needs


def _nearly(base: Fit, better: Model, other: Model) -> bool:
    """Return whether as few effects explain nearly as much on the runs of the fit."""
    explained = base.cost - better.fit.cost
    few = len(other.names) <= len(better.names)
    return few and other.fit.cost - better.fit.cost < _LESS * explained


def _worth(start: Model, train: Objective) -> Callable[..., bool]:
    """Return what says whether a further effect is more than a stopgap on a robot."""
    system = train.predictor.system
    timestep = float(system.task.model.opt.timestep)
    told = partial(identified, start, timestep=timestep, robot=system.robot)

    def worth(base: Model, better: Model, models: Sequence[Model], **seen: Any) -> bool:
        return told(base, better, models, **seen) and not waver(base, better, train.segments)

    return worth


def with_forms_of(units: Sequence[Unit], model: Model) -> list[Unit]:
    """Return the units, those of a model with fitted forms in the places of their like."""
    return with_shapes(units, [unit for unit in model.units if unit not in units])


def _may_be_rounded(base: Model, better: Model | None) -> bool:
    """Return whether commands may be rounded: they are, or half of what a base leaves is left."""
    if better is None or ActionQuantization.name in better.names:
        return True
    return not takes_most(base, better)


def _beside(model: Model, found: Sequence[Unit]) -> list[Unit]:
    """Return those that the model does not have at their places already."""
    there = {(unit.name, unit.where) for unit in model.units}
    return [unit for unit in found if (unit.name, unit.where) not in there]


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
