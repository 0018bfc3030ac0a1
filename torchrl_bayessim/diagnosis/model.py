"""A fitted explanation, and which of two explains the data better."""

from __future__ import annotations

__all__ = [
    "LIKELY",
    "WHITE",
    "Model",
    "as_good",
    "best_by_effect",
    "criterion",
    "gain",
    "judged",
    "judged_fits",
    "needed",
    "numbers",
    "price",
    "shown",
    "shown_by_the_fit",
    "shown_together",
    "takes_most",
    "total_gain",
]

from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from .objective import Objective, Point, Unit
from .refit import Fit, refit

Array = NDArray[np.float64]
LIKELY = 6.0  # a deviance that chance often makes
_CHANCE = 0.01  # of a test that two models explain the data equally well
_NEXT_TO_NOTHING, _OF_ITS_OWN = 0.03, 0.05  # of what all runs of the fit gain; of one's deviance
_WORSE = 1.5  # times the misfit of the best model: too much for an equal, however few the data
_CERTAIN, _SEVERAL = 5.0, 2  # times what judging runs must gain; runs of the fit that gain it
_BESIDE = 100.0  # deviance that segments gain beside the one that gains most, which may be odd
_TOGETHER = 6.0  # the same of all runs together, where noise alone seems left
_MOST = 0.5  # of what a model leaves beyond noise
WHITE = 1.2  # mean squared innovation of a model that leaves noise alone


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

    @property
    def names(self) -> Set[str]:
        """The names of the effects, in their order; each may be at several places."""
        return dict.fromkeys(unit.name for unit in self.units).keys()

    def beyond(self, base: Model) -> list[Unit]:
        """Return the effects that it has and ``base`` has not."""
        return [unit for unit in self.units if unit not in base.units]

    def instead(self, base: Model) -> list[Unit]:
        """Return what it has in the place of effects of ``base``, whose laws it may bend."""
        beyond = self.beyond(base)
        return [unit for unit in beyond if unit.name not in base.names] or beyond

    def deviances(self) -> Array:
        """Return misfits of all segments, training then validation."""
        return np.concatenate([(self.fit.innovations**2).sum(-1), (self.validation**2).sum(-1)])

    @property
    def mean_square(self) -> float:
        """The mean squared innovation of training and validation."""
        return float(self.deviances().sum()) / (self.fit.innovations.size + self.validation.size)

    def dispersion(self) -> float:
        """Return the variance of what is left of the validation innovations, at least 1."""
        return max(1.0, float(np.mean(self.validation**2)))


def judged(train: Objective, validation: Objective, fits: Sequence[Fit]) -> list[Model]:
    """Return the fits with their innovations on the validation segments."""
    held_out = validation([fit.point for fit in fits]) if fits else []
    first = 1 + int(train.segments.log.max())
    logs = np.r_[train.segments.log, first + validation.segments.log]
    return [Model(fit, innovations, logs) for fit, innovations in zip(fits, held_out, strict=True)]


def judged_fits(
    train: Objective,
    validation: Objective,
    starts: Sequence[Point] | Sequence[Fit],
    **options: Any,
) -> list[Model]:
    """Return what `refit` finds from each start, with innovations on the validation segments."""
    return judged(train, validation, refit(train, starts, **options))


def criterion(model: Model, dispersion: float) -> float:
    """Return the deviance of all segments plus a price per number; smaller is better."""
    total = float(model.deviances().sum())
    return total / dispersion + numbers(model) * price(model)


def best_by_effect(models: Iterable[Model], base: Model) -> dict[str, Model]:
    """Return the best model by the first effect that it has beyond a base, the best first."""
    best: dict[str, Model] = {}
    for model in sorted(models, key=lambda m: criterion(m, 1.0)):
        best.setdefault(model.instead(base)[0].name, model)
    return best


def numbers(model: Model) -> int:
    """Return how many numbers its effects have: strengths, and what was read off for them."""
    return sum(1 + len(unit.effect.placed) for unit in model.units)


def price(model: Model) -> float:
    """Return the deviance that a further number has to explain."""
    return float(np.log(model.deviances().size * 8))


def gain(base: Model, model: Model) -> float:
    """Return how much better the validation segments are explained, in units of the noise."""
    before, after = (float((m.validation**2).sum()) for m in (base, model))
    return (before - after) / model.dispersion()


def total_gain(base: Model, model: Model) -> float:
    """Return how much better all segments are explained, in units of the noise."""
    return float((base.deviances() - model.deviances()).sum()) / model.dispersion()


def needed(base: Model, model: Model) -> float:
    """Return the gain on validation that more strengths need: the chance level per strength."""
    return 4.0 * max(1, len(model.units) - len(base.units))


def takes_most(before: Model, after: Model) -> bool:
    """Return whether most of what a model leaves beyond noise is gone with another."""
    return before.mean_square - after.mean_square > _MOST * (before.mean_square - 1.0)


def shown(base: Model, model: Model) -> bool:
    """Return whether segments that no fit saw show that a model is better than its base.

    Or those of several runs of the fit, beyond doubt, if the others do not disagree, or by next to
    nothing: what shows in some motions only need not be in the runs that judge. Or all together
    where the base leaves little more than noise: there is nothing that an effect could make up for.
    """
    if gain(base, model) > needed(base, model):
        return True
    if gain(base, model) < 0:
        return False
    if not base.units:
        return shown_together(base, model)
    count = len(model.fit.innovations)
    logs = model.logs[:count]
    better = (base.deviances() - model.deviances())[:count] / model.dispersion()
    each, had = np.bincount(logs, better), np.bincount(logs, base.deviances()[:count])
    runs = int((each > _CERTAIN * needed(base, model)).sum())
    nothing = np.minimum(_NEXT_TO_NOTHING * each.sum(), _OF_ITS_OWN * had / model.dispersion())
    return runs >= _SEVERAL and not (each < -np.maximum(nothing, LIKELY)).any()


def shown_together(base: Model, model: Model) -> bool:
    """Return whether all runs together show that a model is better than little more than noise.

    Those that judge may not say the opposite. A single run has to show it twice as surely: it may
    be odd.
    """
    gains = (base.deviances() - model.deviances()) / model.dispersion()
    each, least = np.bincount(model.logs, gains), needed(base, model)
    together, alone = float(each.sum()), float(each.max())
    several = together - alone > least
    sure = together > _TOGETHER * least * (1.0 if several else 2.0)
    return base.mean_square < WHITE and sure and gain(base, model) >= 0


def shown_by_the_fit(base: Model, model: Model) -> bool:
    """Return whether a model leaves noise alone of what shows in the runs of the fit.

    Those that judge may not say the opposite. A speed limit shows where the robot is fast, which
    may have been in one run; a law that is not it would leave some of what it does, where that is
    more than a segment.
    """
    gains = (base.deviances() - model.deviances())[: len(model.fit.innovations)]
    gone = base.fit.mean_square > WHITE > max(model.fit.mean_square, model.dispersion())
    return bool(gone and gains.sum() - gains.max() > _BESIDE and gain(base, model) > -LIKELY)


def as_good(best: Model, rival: Model) -> bool:
    """Return whether the segments do not say that the rival is worse.

    Where the best model leaves noise alone, the likelihood says so. Where something is still wrong
    with both, it would be too sure, and the segments' differences count by how they vary.
    """
    mine, others = best.deviances(), rival.deviances()
    if float((others - mine).sum()) / best.dispersion() < LIKELY:
        return True
    if best.mean_square < WHITE:
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
