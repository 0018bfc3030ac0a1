"""Which effects, together with the parameters, explain the data: search, then elimination.

Screening ranks units by linear algebra; what survives is fitted jointly with the parameters and
judged on validation segments. Effects interact: on robot logs one effect explained 13 % alone and
58 % beside another. So the search starts from the best units, the best *pairs* (all of them, from
the screen's correlations, at no cost), and each effect at all of its targets, and goes on from the
best few; afterwards every unit has to show that the model needs it. Where more than noise is left,
it goes on from effects that explain less alone, too.
"""

from __future__ import annotations

__all__ = ["Selection", "select"]

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from .alternatives import alternatives, stands_in
from .elimination import eliminated
from .exchange import exchanged
from .model import LIKELY, Model, judged, judged_fits
from .objective import Objective, Point, Unit
from .refit import Fit
from .screening import Screen
from .search import MANY, Search, with_forms_of
from .time_steps import exactly
from .weaker_places import without_weaker_places

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
        screened: Names of the effects beside which the last p-value was found.
    """

    nominal: Model
    best: Model
    screens: tuple[Screen, ...]
    p_values: tuple[float, ...]
    tried: tuple[Model, ...]
    alternatives: dict[str, tuple[Model, ...]]
    offered: tuple[Unit, ...] = ()
    screened: frozenset[str] = frozenset()

    @property
    def missing(self) -> float:
        """How often noise alone would let so much be missing beside the best model, 1 if unknown.

        Effects that were exchanged, dropped or added since were not screened beside.
        """
        same = bool(self.p_values) and self.screened == self.best.names
        return self.p_values[-1] if same else 1.0

    def seen_as(self, before: Selection) -> Selection:
        """Return it with what was seen of every effect before, where noise alone was noise."""
        return replace(
            self,
            screens=(before.screens[0], *self.screens[1:]),
            p_values=(before.p_values[0], *self.p_values[1:]),
            offered=before.offered,
        )

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
    pairs: bool = True,
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
        pairs: Whether to look for two effects of which neither explains most alone, where more than
            noise is left, or three or more are found.
        shapes: Returns those among them that have a frequency or a step, as they are seen beside
            what is in the model already.
        alpha: Level of the test that anything is missing, in every round.
        generator: Of the null distribution's draws.
        progress: Told what is done.
    """
    start = judged(train, validation, [nominal])[0]
    again = None if known is None else partial(_anew, train, validation, known)
    search = Search(
        train, validation, start, units,
        again=again, varied=varied,
        shapes=shapes, alpha=alpha, generator=generator, progress=progress,
    )  # fmt: skip
    best, others = _settled(search, search.best())
    two = search.or_two_others(best) if pairs else best
    if two is not best:
        best, others = _settled(search, search.best(two))
    found = tuple(search.screens), tuple(search.p_values), tuple(search.tried), others
    return Selection(start, best, *found, offered=tuple(units), screened=search.screened)


def _anew(train: Objective, validation: Objective, known: Selection) -> list[Model]:
    """Return the best model that was found, and the others that were tried, fitted again."""
    each: dict[frozenset[Unit], Model] = {frozenset(known.best.units): known.best}
    for model in sorted(known.tried, key=lambda m: m.mean_square):
        if model.units:
            each.setdefault(frozenset(model.units), model)
    points = [model.fit.point for model in each.values()]
    return judged_fits(train, validation, points, iterations=_AGAIN)


def _settled(search: Search, best: Model) -> tuple[Model, dict[str, tuple[Model, ...]]]:
    """Return the best model, after exchanges, and the models with others instead."""
    instead = partial(
        alternatives, *search.sets,
        units=with_forms_of(search.units, best), first=search.screens[0], offered=search.offered,
    )  # fmt: skip
    for exchanges in range(_EXCHANGES + 1):
        if not best.units:
            break
        search.progress("trying others in its place")
        others = instead(best, tried=search.tried)
        search.tried += [model for models in others.values() for model in models]
        better = exchanged(search.start, best, others, search.offered)
        # where what varies counts as noise, any effect mends a little of it
        if better is best and not search.varied and len(search.offered) <= MANY:
            units = with_forms_of(search.units, best)
            better = without_weaker_places(search.sets, best, units, search.offered)
        if better is best or exchanges == _EXCHANGES:
            return best, others
        best, dropped = eliminated(*search.sets, exactly(*search.sets, better))
        search.tried += dropped
    return best, {}
