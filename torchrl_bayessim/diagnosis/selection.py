"""Which effects, together with the parameters, explain the data: search, then elimination.

Screening ranks units by linear algebra; what survives is fitted jointly with the parameters and
judged on validation segments. Effects interact: on robot logs one effect explained 13 % alone and
58 % beside another. So the search starts from the best units, the best *pairs* (all of them, from
the screen's correlations, at no cost), and each effect at all of its targets, and goes on from the
best few; afterwards every unit has to show that the model needs it.
"""

from __future__ import annotations

__all__ = ["Model", "Selection", "as_good", "parts", "select"]

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from ..effects.effect import Effect, ForceEffect
from .explanations import bent, compare, explanations
from .objective import Objective, Point, Unit
from .refit import Fit, refit
from .screening import Screen

Array = NDArray[np.float64]
_LIKELY = 6.0  # a deviance that chance often makes
_CHANCE = 0.01  # of a test that two models explain the data equally well
_WORSE = 1.5  # times the misfit of the best model: too much for an equal, however few the data
_SHARE = 0.1  # of the gap: what an effect that could be another must remove to be kept
_REST = 0.5  # of what the base leaves: what any further effect must remove
_REMAINS = 0.01  # of the gap: not worth another effect
_WHITE = 1.2  # mean squared innovation of a model that leaves noise alone
_WRONG = 1.5  # mean squared innovation of a base that something is missing from
_MOST = 4  # effects in one explanation
_APART = 3  # effects without each of which a model is fitted with derivatives of its own
_ALIKE = 4  # models with an effect of the same group in its place
_EXCHANGES = 3  # searches for others in the place of an effect
_RIVALS = 6  # models with another effect in the place of one


@dataclass(frozen=True, eq=False)
class Model:
    """A fitted explanation.

    Attributes:
        fit: On the training segments.
        validation: Weighted innovations on the validation segments, ``(S, KC)``.
        logs: Which log each segment is from, training then validation.
    """

    fit: Fit
    validation: Array
    logs: NDArray[np.int64]

    @property
    def units(self) -> tuple[Unit, ...]:
        """The effects in it."""
        return self.fit.units

    def deviances(self) -> Array:
        """Return misfits of all segments, training then validation."""
        return np.concatenate([(self.fit.innovations**2).sum(-1), (self.validation**2).sum(-1)])

    def dispersion(self) -> float:
        """Return the variance of what is left of the validation innovations, at least 1."""
        return max(1.0, float(np.mean(self.validation**2)))


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
        alpha: Level of the test that anything is missing, in every round.
        generator: Of the null distribution's draws.
        progress: Told what is done.
    """
    start = _judged(train, validation, [nominal])[0]
    best, tried, screens, p_values = start, [start], [], []
    for round_number in range(_MOST):
        progress(f"screening {len(units)} effects, round {round_number + 1}")
        left = [u for u in units if u not in best.units]
        enough = _all_explained(start, best)
        now = compare(train, best.fit, left, glance=enough)
        screens.append(now.seen)
        p_values.append(_p_value(now.seen, best, generator))
        # where much is left, what a first derivative does not see may still be the cause
        if enough or (p_values[-1] > alpha and not bent(best.fit)):
            break
        progress("fitting explanations")
        models = _judged(train, validation, explanations(train, now))
        tried += models
        better = _needed_only(start, best, _chosen(best, models), models)
        if better is None or not _identified(start, best, better, models):
            break
        best = _exactly(train, validation, better)
    progress("taking out what is not needed")
    best, dropped = _eliminated(train, validation, best)
    tried += dropped
    alternatives: dict[str, tuple[Model, ...]] = {}
    for _ in range(_EXCHANGES):
        if not best.units:
            break
        progress("trying others in its place")
        alternatives = _alternatives(
            train, validation, best, units=units, tried=tried, first=screens[0]
        )
        tried += [model for models in alternatives.values() for model in models]
        better = _exchanged(best, alternatives)
        if better is best:
            break
        best, dropped = _eliminated(train, validation, _exactly(train, validation, better))
        tried += dropped
    return Selection(start, best, tuple(screens), tuple(p_values), tuple(tried), alternatives)


def _exchanged(best: Model, alternatives: Mapping[str, Sequence[Model]]) -> Model:
    """Return the best of a model and its alternatives, itself unless chance is unlikely."""
    every = [model for models in alternatives.values() for model in models]
    others = [
        m for m in every if len(m.units) <= len(best.units) or _gain(best, m) > _needed(best, m)
    ]
    first = min([best, *others], key=lambda m: _criterion(m, best.dispersion()))
    gain = _criterion(best, best.dispersion()) - _criterion(first, best.dispersion())
    return first if gain > _LIKELY else best


def _all_explained(start: Model, best: Model) -> bool:
    """Return whether too little of the gap is left to be a cause of its own.

    The true law in a simulator that integrates differently leaves as much.
    """
    alone, left = (float((m.fit.innovations**2).mean()) - 1.0 for m in (start, best))
    return bool(best.units) and left < _REMAINS * alone


def _exactly(train: Objective, validation: Objective, model: Model) -> Model:
    """Fit a model with forces that follow the state at every time step, if it has any.

    Held for 10 ms they lag, and what lags looks like a delay to the next round.
    """
    forced = any(isinstance(unit.effect, ForceEffect) for unit in model.units)
    if not forced or train.predictor.exact:
        return model
    train.predictor.exact = validation.predictor.exact = True
    return _judged(train, validation, refit(train, [model.fit.point], iterations=4))[0]


def _p_value(seen: Screen, model: Model, generator: np.random.Generator) -> float:
    """Return how often noise alone would give the largest likelihood ratio of the screen."""
    if not len(seen.units):
        return 1.0
    dispersion = max(1.0, float((model.fit.innovations**2).mean()))
    largest = float(seen.ratios(dispersion).max())
    null = seen.null(1000, generator)
    above = float((null >= largest).mean())
    if above > 0.02:
        return above
    # beyond the draws: the tail of a maximum falls like exp(-x/2)
    tail = np.quantile(null, 0.98)
    return float(0.02 * np.exp(-(largest - tail) / 2))


def _fitted(
    train: Objective,
    validation: Objective,
    base: Model,
    additions: Sequence[dict[Unit, float]],
    *,
    race: float,
) -> list[Model]:
    """Fit the base model with each addition that can come near a cost."""
    starts = [Point(base.fit.point.z, {**base.fit.point.strengths, **more}) for more in additions]
    return _judged(train, validation, refit(train, starts, race=race)) if starts else []


def _judged(train: Objective, validation: Objective, fits: Sequence[Fit]) -> list[Model]:
    judged = validation([fit.point for fit in fits]) if fits else []
    first = 1 + int(train.segments.log.max())
    logs = np.r_[train.segments.log, first + validation.segments.log]
    return [Model(fit, innovations, logs) for fit, innovations in zip(fits, judged, strict=True)]


def _criterion(model: Model, dispersion: float) -> float:
    """Return the deviance of all segments plus a price per strength; smaller is better."""
    total = float(model.deviances().sum())
    return total / dispersion + len(model.units) * np.log(model.deviances().size * 8)


def _chosen(base: Model, models: Sequence[Model]) -> Model | None:
    """Return the best model, if the segments that it was not fitted on say that it is better."""
    dispersion = min([base.dispersion(), *(m.dispersion() for m in models)])
    better = [m for m in models if _gain(base, m) > _needed(base, m)]
    if not better:
        return None
    first = min(better, key=lambda m: _criterion(m, dispersion))
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
        and _gain(m, model) <= _needed(m, model)
    ]


def _needed_only(
    start: Model,
    base: Model,
    better: Model | None,
    models: Sequence[Model],
) -> Model | None:
    """Return the best model, or the one with a single new effect if more are a stopgap."""
    if better is None or len({u.name for u in better.units if u not in base.units}) < 2:
        return better
    single = [m for m in models if len({u.name for u in m.units if u not in base.units}) == 1]
    smaller = _chosen(base, single)
    if smaller is None or _identified(start, smaller, better, models):
        return better
    return smaller


def _identified(start: Model, base: Model, better: Model, models: Sequence[Model]) -> bool:
    """Return whether what is added to a base with effects is more than a stopgap.

    A model that is right but for the form of a law leaves a little that many effects can mend. An
    effect is added only if it matters: to the gap, or, if nothing else could mend it as well, to
    what the base leaves.
    """
    if not base.units:
        return True
    alone, before, after = (
        float(np.mean(np.r_[(m.fit.innovations**2).ravel(), (m.validation**2).ravel()]))
        for m in (start, base, better)
    )
    if before - after > _SHARE * (alone - 1.0):
        return True
    if before - after < _REST * (before - 1.0):
        return False
    added = {u.effect.group for u in better.units if u not in base.units}
    rivals = [
        {u.effect.group for u in m.units if u not in base.units}
        for m in models
        if m is not better and as_good(better, m)
    ]
    return before > _WRONG and all(groups <= added for groups in rivals)


def _gain(base: Model, model: Model) -> float:
    """Return how much better the validation segments are explained, in units of the noise."""
    before, after = (float((m.validation**2).sum()) for m in (base, model))
    return (before - after) / model.dispersion()


def _needed(base: Model, model: Model) -> float:
    """Return the gain on validation that more strengths need: the chance level per strength."""
    return 4.0 * max(1, len(model.units) - len(base.units))


def _eliminated(train: Objective, validation: Objective, model: Model) -> tuple[Model, list[Model]]:
    """Take out, one at a time, units without which the data are explained as well."""
    tried: list[Model] = []
    while model.units:
        without = [model.fit.without(unit) for unit in model.units]
        few = len(without) <= _APART
        fits = refit(train, [fit.point for fit in without], origins=without, renew=few)
        smaller = _judged(train, validation, fits)
        tried += smaller
        criterion = [_criterion(m, model.dispersion()) for m in smaller]
        best = int(np.argmin(criterion))
        loss = _gain(smaller[best], model)
        if criterion[best] > _criterion(model, model.dispersion()) and loss > _needed(
            smaller[best], model
        ):
            break
        model = smaller[best]
    there = refit(train, [model.fit.point], iterations=0)[0]
    return replace(model, fit=there), tried


def parts(train: Objective, validation: Objective, model: Model) -> list[Model]:
    """Return the model without each of its effects, fitted."""
    strengths = model.fit.point.strengths
    starts = [
        Point(model.fit.point.z, {u: s for u, s in strengths.items() if u.name != out})
        for out in dict.fromkeys(unit.name for unit in strengths)
    ]
    return _judged(train, validation, refit(train, starts))


def _alternatives(
    train: Objective,
    validation: Objective,
    best: Model,
    *,
    units: Sequence[Unit],
    tried: Sequence[Model],
    first: Screen,
) -> dict[str, tuple[Model, ...]]:
    """Return models with another effect in the place of each effect of the best one."""
    start = tried[0]
    result: dict[str, tuple[Model, ...]] = {}
    names = list(dict.fromkeys(unit.name for unit in best.units))
    for name in names:
        kept = {u: s for u, s in best.fit.point.strengths.items() if u.name != name}
        known = [m for m in tried if _stands_in(m, kept, name)]
        if kept:
            base = _judged(train, validation, refit(train, [Point(best.fit.point.z, kept)]))[0]
            left = [u for u in units if u not in kept and u.name != name]
            strongest, most = compare(train, base.fit, left).seen.best(1.0), _RIVALS
        else:  # the search has tried those that stand out; what acts alike is a rival anyway
            base, most = start, _ALIKE
            groups = {u.effect.group for u in best.units}
            seen = {u.effect for m in known for u in m.units}
            strongest = {
                unit: found
                for unit, found in first.best(1.0).items()
                if unit.effect.group in groups and unit.name != name and unit.effect not in seen
            }
        additions: dict[Effect, dict[Unit, float]] = {}
        for unit, (_, strength) in strongest.items():
            if len(additions) < most:
                additions.setdefault(unit.effect, {unit: strength})
        known += _fitted(train, validation, base, list(additions.values()), race=best.fit.cost)
        result[name] = tuple(known)
    return result


def _stands_in(model: Model, kept: dict[Unit, float], name: str) -> bool:
    """Return whether a model has one other effect beside the kept ones."""
    others = {u.name for u in model.units if u not in kept}
    return set(kept) <= set(model.units) and len(others) == 1 and others != {name}


def as_good(best: Model, rival: Model) -> bool:
    """Return whether the segments do not say that the rival is worse.

    Where the best model leaves noise alone, the likelihood says so. Where something is still wrong
    with both, it would be too sure, and the segments' differences count by how they vary.
    """
    mine, others = best.deviances(), rival.deviances()
    if float((others - mine).sum()) / best.dispersion() < _LIKELY:
        return True
    if float(mine.sum()) / (best.fit.innovations.size + best.validation.size) < _WHITE:
        return False
    if float(others.sum()) > _WORSE * float(mine.sum()):
        return False
    kinds = others - mine, np.log(others / mine)
    return all(_positive(kind, best.logs) > _CHANCE for kind in kinds)


def _positive(differences: Array, logs: NDArray[np.int64]) -> float:
    """Return the p-value of a positive mean, with errors of segments or of logs.

    What is wrong with both models is wrong all along a log, and speaks for the one in some logs and
    for the other in others: so the larger error counts, and if it is that of ``G`` logs, Student's
    distribution with ``G - 1`` degrees of freedom (clustered errors, Liang & Zeger 1986; Cameron &
    Miller 2015).
    """
    mean, count = float(differences.mean()), len(differences)
    by_log = np.bincount(logs, differences - mean)
    alone, together = float(((differences - mean) ** 2).sum()), float((by_log**2).sum())
    score = mean / max(np.sqrt(max(alone, together)) / count, 1e-12)
    groups = len(np.unique(logs)) if together > alone else count
    return float(student.sf(score, max(groups - 1, 1)))
