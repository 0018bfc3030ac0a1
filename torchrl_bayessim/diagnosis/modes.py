"""What is predicted and compared: short segments, or whole trajectories.

A mode cuts logs into segments and says what of them is to be explained, as an objective. Everything
that comes after needs no more than residuals with a covariance.
"""

from __future__ import annotations

__all__ = ["MODES", "Mode", "Trajectories", "shortest"]

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..inference.priors import Prior
from ..logs.log import Log
from .horizon import chosen_horizon
from .objective import Objective, Unit, origin, parameters_at
from .prediction import Predictor
from .segments import Segments, cut, cut_for_fits
from .whitening import whitening

Array = NDArray[np.float64]
_SHORTEST = 24  # control steps of a trajectory
_PROBE = 12  # trajectories on which it is seen whether they are too long
_CURVED = 1.0  # ratio of second to first differences, from which on chaos rules
_COMPARED = 240  # numbers of a trajectory


class Mode:
    """Segments that start from measured states: the default, which neither chaos nor noise rules.

    Attributes:
        name: As users call it.
    """

    name = "segments"

    def horizon(
        self,
        predictor: Predictor,
        parts: Mapping[str, Sequence[Log]],
        *,
        units: Sequence[Unit],
        noise: Array,
        history: int,
    ) -> int:
        """Return how many control steps a segment should have.

        Args:
            predictor: Simulates.
            parts: The logs, by split.
            units: The effects that should show.
            noise: Standard deviation of each channel's noise.
            history: Rows before a segment that effects look back at.
        """
        horizon = chosen_horizon(
            predictor, predictor.system, parts["train"], units=units, noise=noise, history=history
        )
        return min(horizon, shortest(parts) // 2)

    def cut(self, logs: Sequence[Log], horizon: int, *, history: int, most: int) -> Segments:
        """Return at most so many segments of the logs."""
        return cut_for_fits(logs, horizon, history=history, most=most)

    def objective(
        self,
        predictor: Predictor,
        prior: Prior | None,
        segments: Segments,
        *,
        z: Array,
        noise: Array,
        generator: np.random.Generator | None = None,
    ) -> Objective:
        """Return what is to be made small.

        Args:
            predictor: Simulates.
            prior: Over the parameters.
            segments: What to explain.
            z: Standardised parameters where the covariance is computed.
            noise: Standard deviation of each channel's noise.
            generator: Of simulated noise, on which the covariance is checked.
        """
        white = whitening(predictor, segments, parameters_at(prior, z), noise, generator=generator)
        return Objective(predictor, prior, segments, white)


class Trajectories(Mode):
    """Whole trajectories, from their first row on, or windows as long as chaos allows.

    For robots that can be reset and replayed only, and for hidden states that live long: what a
    short segment would have to guess at its start is over after a while, or known at a reset.
    """

    name = "trajectories"

    def horizon(
        self,
        predictor: Predictor,
        parts: Mapping[str, Sequence[Log]],
        *,
        units: Sequence[Unit],  # noqa: ARG002 (long enough for all)
        noise: Array,
        history: int,
    ) -> int:
        """Return the length of the shortest log, or its half and so on, as far as it is linear."""
        steps = shortest(parts) - 1
        prior = predictor.system.prior
        theta = parameters_at(prior, origin(prior))
        while steps >= _SHORTEST:
            pieces = self.cut(parts["train"], steps, history=history, most=_PROBE)
            if whitening(predictor, pieces, theta, noise).curvature <= _CURVED:
                return steps
            steps //= 2
        return steps

    def cut(self, logs: Sequence[Log], horizon: int, *, history: int, most: int) -> Segments:
        """Return at most so many windows, the first from the first row on."""
        long = [log for log in logs if len(log) > horizon]
        channels = int(logs[0].measured.sum())
        checks = max(10, _COMPARED // channels)
        return cut(long, horizon, history=history, most=most, checks=checks)


def shortest(parts: Mapping[str, Sequence[Log]]) -> int:
    """Return the length of the longest log in the split where that is shortest."""
    return min(max(len(log) for log in part) for part in parts.values())


MODES: Mapping[str, type[Mode]] = {mode.name: mode for mode in (Mode, Trajectories)}
