"""As few time steps as the data allow: most of a search is simulation.

An integrator of fourth order follows an arm with a quarter of the steps that its model asks for;
one of first order, or contacts, do not forgive fewer. So it is tried, on the robot's own motion. A
model that was found is fitted with as many as can be told.
"""

from __future__ import annotations

__all__ = ["exactly", "with_fewest_steps"]

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .model import Model, judged_fits
from .objective import Objective, Point, Unit, parameters_at, strengths_of
from .prediction import Predictor
from .segments import Segments
from .stepwise import fewest_parts

Array = NDArray[np.float64]
_UNSEEN = 0.02  # standard deviations of the noise
_ALIKE = 0.1  # of what an effect does
_TYPICAL = 0.1  # of its range
_EVERY = 3  # so many segments one, for the effects
_HIDDEN = 1.0  # a deviance, in units of the dispersion, that no test can detect


def with_fewest_steps(
    predictor: Predictor, segments: Segments, units: Sequence[Unit], *, z: Array, noise: Array
) -> Predictor:
    """Return the simulator with the fewest time steps that predict what its own steps do.

    The parameters alone to a fiftieth of the noise, and what each effect changes to a tenth.

    Args:
        predictor: Simulates.
        segments: Some.
        units: The effects.
        z: Standardised parameters.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
    """
    own = predictor.substeps
    fewest = fewest_parts(own, predictor.system.task.dt)
    fewer = [predictor.divided(n) for n in range(fewest, own) if own % n == 0]

    def predicted(by: Predictor, points: Sequence[Point], on: Segments) -> Array:
        theta = parameters_at(by.system.prior, np.stack([point.z for point in points]))
        return by.residuals(on, theta, strengths_of(points, by.system.robot)) / noise

    alone = predicted(predictor, [Point(z)], segments)
    fewer = [f for f in fewer if _size(predicted(f, [Point(z)], segments) - alone)[0] < _UNSEEN]
    if not fewer or not units:
        return next(iter(fewer), predictor)
    some = np.arange(0, len(segments), _EVERY)
    points = [Point(z, {unit: _TYPICAL * unit.high}) for unit in units]
    true = predicted(predictor, points, segments.take(some))
    tolerated = np.maximum(_ALIKE * _size(true - alone[:, some]), _UNSEEN)
    for other in fewer:
        if (_size(predicted(other, points, segments.take(some)) - true) < tolerated).all():
            return other
    return predictor


def exactly(train: Objective, validation: Objective, model: Model) -> Model:
    """Fit a model with forces that follow the state at each time step, as many as can be told.

    Forces that are held for 10 ms lag, and what lags looks like a delay to the next round. Where
    something is missing still, less of it can be told: deviances count by their dispersion.
    """
    own = train.predictor.system.task.frame_skip
    if train.predictor.exact and train.predictor.substeps == own:
        return model
    tolerated = _HIDDEN * max(1.0, model.fit.mean_square)

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


def _size(residual: Array) -> Array:
    """Return the root mean square of every candidate's residuals."""
    size = np.sqrt((residual**2).mean((1, 2, 3)))
    return np.nan_to_num(size, nan=np.inf)
