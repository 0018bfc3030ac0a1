"""A second effect where the first leaves little: named if it is all of that, and nothing else is.

A weak cause beside a strong one is a thousandth of the gap, and as much is left by the form of a
law that is not quite the true one. But what is true explains the rest to the noise, with one
strength, and no effect of another kind does; what mends the form of another law leaves something
still, by the test that found that something is missing and more than a tenth of what it explains,
or is one of several that mend as much.
"""

from __future__ import annotations

__all__ = ["all_of_little", "little_left", "one_alone"]

from collections.abc import Callable, Sequence

import numpy as np

from ..effects.action import ActionDelay
from ..effects.backlash import Backlash
from ..effects.friction import PowerLawFriction, QuadraticDrag
from ..effects.joints import CoulombFriction, ParallelSpring, ViscousFriction
from .choice import chosen
from .explanations import compare
from .further_effects import no_rival, numerical
from .model import WHITE, Model, total_gain
from .objective import Objective, Unit
from .screening import Screen
from .wavering import waver

_SURELY = 1e-4  # p-value of what is left, to look for one effect that is all of it
_PLAIN = 25.0  # deviance that it removes, which chance hardly makes of any of a hundred units
_DRAWS, _RARELY = 1000, 0.99  # of noise, and where the largest ratio of so many of them lies
_MORE = 2.0  # times that: what a fit may explain and a screen does not
_SURE = 100.0  # the same where contacts, or what is missing beside it, may imitate an effect
_TENTH = 0.1  # of what it explains of the runs of the fit: what may be missing beside it
_FORMS = CoulombFriction.group, Backlash.group
_LATE = ActionDelay.group, Backlash.group  # of each other, and of what a drive that gives way does
_SMOOTH = ViscousFriction, PowerLawFriction, QuadraticDrag, ParallelSpring


def little_left(best: Model, p_value: float) -> bool:
    """Return whether a model of one effect leaves little more than noise, but surely more.

    Of one, since a third effect mends the forms of two others more easily. Not beside dry
    friction or a drive that gives way, which no time step follows exactly.

    Args:
        best: With the effects that were found.
        p_value: Of what it leaves.
    """
    if len(best.names) != 1 or best.mean_square > WHITE or p_value > _SURELY:
        return False
    return not any(
        unit.effect.group in _FORMS and not isinstance(unit.effect, _SMOOTH) for unit in best.units
    )


def one_alone(seen: Screen, dispersion: float, generator: np.random.Generator) -> bool:
    """Return whether one unit may be all that is missing: beside the strongest no other shows.

    Args:
        seen: What is missing, compared with all units.
        dispersion: Its variance.
        generator: Of the null distribution's draws.
    """
    strongest = next(iter(seen.best(dispersion)))
    others = seen.beside([strongest], dispersion)
    noise = np.quantile(seen.null(_DRAWS, generator), _RARELY)
    return max(others.values(), default=0.0) < _MORE * float(noise)


def all_of_little(
    start: Model,
    best: Model,
    models: Sequence[Model],
    *,
    train: Objective,
    left: Sequence[Unit],
    missing: Callable[[Screen, Model], bool],
) -> Model | None:
    """Return the model with the one effect that is all of the little that is left, if one is.

    Not of what is late beside what is late: delays, filters and springs in a drive are forms of
    each other. Where contacts correct what sensors say, and no time step follows them exactly, it
    has to explain more. What explains that, and ten times what shows beside it, may leave that.

    Args:
        start: Parameters alone.
        best: With the effects that were found.
        models: All that were tried beside those.
        train: Where models are fitted.
        left: Units that a model may lack.
        missing: Told a screen of a model, and the model: whether something surely is missing.
    """
    single = [model for model in models if len(model.units) == len(best.units) + 1]
    if any(_late(unit) for unit in best.units):
        single = [model for model in single if not any(map(_late, model.beyond(best)))]
    better = chosen(best, single)
    if better is None:
        return None
    timestep = float(train.predictor.system.task.model.opt.timestep)
    gained, fitted = total_gain(best, better), best.fit.misfit - better.fit.misfit
    touching, dispersion = train.segments.touching is not None, max(1.0, better.fit.mean_square)
    if gained < (_SURE if touching else _PLAIN) or numerical(start, best, better, timestep):
        return None
    others = [unit for unit in left if unit.name not in better.names]
    if not no_rival(best, better, single) or waver(best, better, train.segments):
        return None
    seen = compare(train, better.fit, others).seen
    # a screen of some segments says as much less
    largest = (seen.ratios(dispersion) * seen.growth**2).max(initial=0.0)
    most = gained > _SURE and largest < _TENTH * fitted / dispersion
    return better if most or not missing(seen, better) else None


def _late(unit: Unit) -> bool:
    return unit.effect.group in _LATE and not isinstance(unit.effect, _SMOOTH)
