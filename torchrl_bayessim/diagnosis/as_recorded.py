"""Test runs as they were recorded: samples that were held among them, and commands as sent.

What is taken to have been lost, held or late is replaced before anything is compared; the gap is of
what was recorded.
"""

from __future__ import annotations

__all__ = ["Recorded", "Sent", "along", "gap_with_holds"]

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..logs.log import Log
from .contacts import settled
from .objective import Objective, Point
from .preparation import Prepared
from .segments import Segments
from .selection import Selection
from .splits import split
from .validation import NEGLIGIBLE

_MOST = 0.5  # of what effects leave


class Recorded(NamedTuple):
    """Mean squared innovations of test segments, samples that were held among them.

    Attributes:
        refit: As they were recorded, without effects.
        effects: With those that last.
        bridged: The same with other samples in the place of those that were held.
    """

    refit: float = 1.0
    effects: float = 1.0
    bridged: float = 1.0

    @property
    def matter(self) -> bool:
        """Whether held samples are most of what effects leave, and that is more than noise."""
        left = self.effects - 1.0
        return left > NEGLIGIBLE - 1.0 and self.effects - self.bridged > _MOST * left


def gap_with_holds(prepared: Prepared, logs: Sequence[Log], selection: Selection) -> Recorded:
    """Return what is left of test segments cut from the logs as recorded, and as bridged."""
    test = prepared.sets["test"]
    if test.segments.uncertainty is not None:  # the held samples entered the estimates too
        return Recorded()
    whole, size = split(logs)["test"], len(test.segments)
    if test.segments.touching is not None:
        theta = test.theta(selection.nominal.fit.point.z)
        whole = settled(prepared.predictor, whole, theta=theta, noise=prepared.noise)
    pieces = prepared.mode.cut(whole, prepared.horizon, history=test.segments.history, most=size)
    if len(pieces) != size:
        return Recorded()
    points = [selection.nominal.fit.point, selection.best.fit.point]
    return Recorded(*along(test, pieces, points), *along(test, test.segments, points[1:]))


def along(test: Objective, pieces: Segments, points: Sequence[Point]) -> NDArray[np.float64]:
    """Return mean squared innovations of points on other segments of the same runs, ``(P,)``."""
    left = test.along(pieces)(points)
    total = np.asarray((left**2).sum((1, 2)), dtype=np.float64)
    return total / (test.whitening.weights**2).sum() / left.shape[2]


@dataclass(frozen=True)
class Sent:
    """Mean squared innovations of test segments with the commands that were sent.

    Where others are taken to have acted, on which everything else is compared; or of samples as
    they were recorded, where those that were lost are interpolated.

    Attributes:
        raw: At the prior's mean.
        refit: With parameters that were fitted to these.
        effects: With the effects that last, and parameters that were fitted beside them.
        lost: How many commands, or samples, of all runs are taken to have been others.
        of: How many there are.
        samples: Whether they are samples.
    """

    raw: float
    refit: float
    effects: float
    lost: int
    of: int
    samples: bool = False

    @classmethod
    def along(cls, prepared: Prepared, sent: Prepared, selection: Selection) -> Sent:
        """Return them for what was found on the commands that arrived.

        Args:
            prepared: With these.
            sent: The same runs with those that were sent.
            selection: What was found.
        """
        test, nominal = prepared.sets["test"], sent.nominal.point
        size, history = len(test.segments), test.segments.history
        pieces = prepared.mode.cut(sent.logs["test"], prepared.horizon, history=history, most=size)
        points = [Point(np.zeros_like(nominal.z)), nominal, selection.best.fit.point]
        logs = [
            pair
            for name, part in sent.logs.items()
            for pair in zip(part, prepared.logs[name], strict=True)
        ]
        counts = [
            sum(
                int((getattr(one, name) != getattr(other, name)).any(1).sum())
                for one, other in logs
            )
            for name in ("ctrl", "qpos", "qvel")  # a velocity may be estimated from positions
        ]
        lost = next((count for count in counts if count), 0)
        raw, refit, effects = along(test, pieces, points).tolist()
        rows = sum(len(one) for one, _ in logs)
        return cls(raw, refit, effects, lost, rows, samples=not counts[0])

    def share(self, refit: float, effects: float) -> float:
        """Return the share of the gap that losses have of what they and the effects remove.

        The mean over which of the two comes first (Shapley 1953), at least nothing in either order.

        Args:
            refit: Mean squared innovation with the commands that arrived, and fitted parameters.
            effects: The same with the effects, too.

        Example:
            >>> Sent(raw=9.0, refit=5.0, effects=3.0, lost=4, of=100).share(3.0, 1.0)
            0.5
        """
        alone = max(self.refit - refit, 0.0)
        beside = max(self.effects - effects, 0.0)
        return min(0.5 * (alone + beside) / max(self.refit - effects, 1e-9), 1.0)

    @property
    def note(self) -> str:
        """What the reader must know."""
        if self.samples:
            return (
                f"{self.lost} of {self.of} samples are taken to have been lost, and interpolated; "
                "the gap without causes is of the logs as recorded, all else, of test runs too, "
                "of those with the interpolated"
            )
        return (
            f"{self.lost} of {self.of} commands are taken to have been lost; the gap without "
            "causes is of those that were sent, all else, of test runs too, of those that arrived"
        )
