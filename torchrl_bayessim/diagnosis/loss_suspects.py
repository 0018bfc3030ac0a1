"""Short segments in which something may have been lost, and the likeliest law without losses."""

from __future__ import annotations

__all__ = [
    "FEWEST", "JUDGED", "LEFT", "LIKELIER", "NOISE", "SCATTER", "SPOILED", "Alone", "Suspects",
    "spoiled_share",
]  # fmt: skip

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..effects.action import PacketDrop
from ..effects.sensors import SensorDropout
from .loss_law import LossLaw, Told, likeliest
from .loss_segments import LossSegments, loss_segments
from .modes import Mode
from .objective import Unit
from .preparation import Prepared
from .selection import Selection

JUDGED = "train", "validation"  # splits that say what is lost
SCATTER = np.geomspace(0.5, 4.0, 10)  # φ
SPOILED = (0.003, 0.01, 0.03, 0.1, 0.3)  # η
LIKELIER = 0.5  # probability that a segment has a loss, or is spoiled
NOISE = 1.2  # scatter that noise has
FEWEST = 4  # segments with a loss
_MISSING = 1e-4  # p-value of the search's last round, which says that more than chance is left
LEFT = 2.0  # mean squared innovation of what has not explained the losses


class Alone(NamedTuple):
    """The likeliest law without losses.

    Attributes:
        law: The law.
        costs: Its deviances, of the splits that judge.
        spoiled: The share of segments it gives up.
        segments: How many there are.
        colliding: Whether anything of the robot may touch anything.
    """

    law: LossLaw
    costs: list[float]
    spoiled: float
    segments: int
    colliding: bool

    @property
    def calm(self) -> bool:
        """Whether too few segments hold more than noise for losses to be found in them."""
        return self.law.scatter < NOISE and self.spoiled * self.segments < FEWEST

    @classmethod
    def of(cls, data: Mapping[str, LossSegments]) -> Alone:
        """Return that of training and validation segments."""
        judged, size = [data[name].without for name in JUDGED], data["train"].left.shape[1]
        law = likeliest(judged, (0.0,), SCATTER.tolist(), SPOILED, size=size)
        told = Told.joined([law.told(one) for one in judged])
        costs, colliding = [law.deviance([one]) for one in judged], data["train"].colliding
        return cls(law, costs, spoiled_share(told), len(told.spoiled), colliding)


@dataclass(frozen=True, eq=False)
class Suspects:
    """Short segments in which something may have been lost, and what may have been.

    Attributes:
        units: Random effects, of commands and of samples, each of what is lost as one.
        nominal: The segments of each split, with parameters alone.
        best: With the effects that last.
    """

    units: Sequence[Unit]
    nominal: Mapping[str, LossSegments]
    best: Mapping[str, LossSegments]

    @classmethod
    def of(cls, prepared: Prepared, selection: Selection, units: Sequence[Unit]) -> Suspects | None:
        """Return them, nothing where nothing can be lost or effects that last leave noise alone.

        Nor where whole trajectories or statistics are compared.

        Args:
            prepared: Logs, noise and nominal fit.
            selection: What the search without chance found.
            units: All effects at their targets.
        """
        some = [u for u in units if isinstance(u.effect, PacketDrop | SensorDropout) and _as_one(u)]
        if not some or type(prepared.mode) is not Mode:
            return None
        nominal = loss_segments(prepared)
        best = {n: one.at(selection.best.fit.point) for n, one in nominal.items()}
        found = cls(some, nominal, best)
        return None if _explained(found.rival, selection) else found

    @cached_property
    def alone(self) -> Alone:
        """The parameters alone, without losses."""
        return Alone.of(self.nominal)

    @cached_property
    def rival(self) -> Alone:
        """The effects that last, without losses."""
        return Alone.of(self.best)


def _explained(rival: Alone, found: Selection) -> bool:
    """Return whether effects that last leave noise alone.

    In short segments, where lost commands are hardly more than a lag, and in those of the search,
    where a few that are lost may show all the same.
    """
    best = found.best
    calm = rival.calm and best.dispersion() < LEFT
    return bool(best.units) and calm and found.p_values[-1] > _MISSING


def spoiled_share(told: Told) -> float:
    """Return the share of the segments that something else has rather spoiled than not."""
    return float((told.spoiled > LIKELIER).mean())


def _as_one(unit: Unit) -> bool:
    """Return whether a unit is lost as one: a packet holds all commands, but no reading of all."""
    alone = unit.where != "all" or len(unit.direction) == 1
    return alone or isinstance(unit.effect, PacketDrop)
