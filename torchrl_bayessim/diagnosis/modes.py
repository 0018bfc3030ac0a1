"""What is predicted and compared: short segments, whole trajectories, or their statistics.

A mode cuts logs into segments and says what of them is to be explained, as an objective. Everything
that comes after needs no more than residuals with a covariance.
"""

from __future__ import annotations

__all__ = ["MODES", "Mode", "Summaries", "Trajectories", "shortest"]

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..effects.action import ActionDelay
from ..effects.sensors import SensorDelay
from ..inference.priors import Prior
from ..logs.log import Log
from .horizon import chosen_horizon
from .noise import assumed_noise, measured_noise
from .objective import Objective, Point, Unit, origin, parameters_at
from .prediction import Predictor
from .segments import Segments, cut, cut_for_fits
from .synthetic_likelihood import synthetic_objective
from .whitening import whitening

Array = NDArray[np.float64]
_SHORTEST = 24  # control steps of a trajectory
_PROBE = 12  # trajectories on which it is seen whether they are too long
_CURVED = 1.0  # ratio of second to first differences, from which on chaos rules
_WINDOW = 200  # control steps of which statistics are taken, at most
_APART = 0.1  # s that clocks may be apart
_COMPARED = 240  # numbers of a trajectory


class Mode:
    """Segments that start from measured states: the default, which neither chaos nor noise rules.

    Attributes:
        name: As users call it.
        synchronised: Whether commands and measurements of a row belong together.
        untestable: Names of effects that it cannot tell from nothing.
        alarms: What the reader must know.
    """

    name = "segments"
    synchronised = True
    untestable: tuple[str, ...] = ()
    alarms: tuple[str, ...] = ()

    def noise(
        self,
        predictor: Predictor,
        logs: Sequence[Log],
        *,
        history: int,
        alarms: list[str],
        beside: tuple[Point, Array] | None = None,
    ) -> tuple[Array, str]:
        """Return the standard deviation of each channel's noise, and where it comes from.

        Args:
            predictor: Simulates.
            logs: For training.
            history: Rows before a segment that effects look back at.
            alarms: To which is added what the reader must know.
            beside: The simulator that leaves noise, default none of the effects; and the noise
                that was found without them.
        """
        return measured_noise(predictor, logs, history=history, alarms=alarms, beside=beside)

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
            predictor, parts["train"], units=units, noise=noise, history=history
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
        channels = int(logs[0].measured.sum())
        checks = max(10, _COMPARED // channels)
        return cut(logs, horizon, history=history, most=most, checks=checks)


class Summaries(Mode):
    """Statistics of windows, where clocks were not synchronised, or chaos decides.

    See `synthetic_likelihood`. How late the one clock is cannot be told from a delay.
    """

    name = "summaries"
    synchronised = False
    untestable = ActionDelay.name, SensorDelay.name
    alarms = (
        f"compared by statistics of windows, for clocks up to {_APART} s or an eighth of a window "
        "apart: delays are not looked for",
    )

    def noise(
        self,
        predictor: Predictor,
        logs: Sequence[Log],
        *,
        history: int,  # noqa: ARG002
        alarms: list[str],  # noqa: ARG002
        beside: tuple[Point, Array] | None = None,  # noqa: ARG002
    ) -> tuple[Array, str]:
        """Return what is known without predictions."""
        noise = assumed_noise(predictor, logs)
        return noise, "the sensors' specification, or else third differences"

    def horizon(
        self,
        predictor: Predictor,  # noqa: ARG002 (nothing is simulated)
        parts: Mapping[str, Sequence[Log]],
        *,
        units: Sequence[Unit],  # noqa: ARG002 (long enough for all)
        noise: Array,  # noqa: ARG002
        history: int,
    ) -> int:
        """Return the length of a window: two fit into the shortest log."""
        return max(_SHORTEST, min(_WINDOW, (shortest(parts) - 1 - history) // 2))

    def cut(self, logs: Sequence[Log], horizon: int, *, history: int, most: int) -> Segments:
        """Return at most so many windows."""
        return cut(logs, horizon, history=history, most=most, burn_in=history)

    def objective(
        self,
        predictor: Predictor,
        prior: Prior | None,
        segments: Segments,
        *,
        z: Array,
        noise: Array,
        generator: np.random.Generator | None = None,  # noqa: ARG002 (draws of its own)
    ) -> Objective:
        """Return what is to be made small."""
        rows = round(_APART / predictor.system.control_dt)
        shift = min(rows, segments.history, segments.horizon // 8)
        return synthetic_objective(predictor, prior, segments, z=z, noise=noise, shift=shift)


def shortest(parts: Mapping[str, Sequence[Log]]) -> int:
    """Return the length of the longest log in the split where that is shortest."""
    return min(max(len(log) for log in part) for part in parts.values())


MODES: Mapping[str, type[Mode]] = {mode.name: mode for mode in (Mode, Trajectories, Summaries)}
