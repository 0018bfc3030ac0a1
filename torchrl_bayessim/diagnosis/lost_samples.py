"""Effects that last, beside samples that were not renewed: what these spoil hides the others.

Every sample of a sensor that loses some is decided on, in short segments that overlap, by the
densities of all patterns of a few losses (`loss_segments`, `loss_law`). Those that are likely to
have been lost are interpolated from the others, which takes no simulator, and the search is done
again. In the end losses have to explain the segments as they were recorded in the simulator that it
found, clearly better than losses alone.
"""

from __future__ import annotations

__all__ = ["beside_lost_samples"]

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from ..effects.sensors import SensorDropout
from ..logs.log import Log
from ..logs.velocity import Windows, velocity
from .beside_losses import CERTAIN, Beside, Sought
from .loss_law import LossLaw
from .loss_segments import LossSegments, steps_of
from .loss_suspects import LIKELIER, Alone
from .losses import all_found
from .objective import Point, Unit
from .preparation import Prepared
from .prepared_anew import with_other_logs
from .segments import cut

Array = NDArray[np.float64]
_SPOILED = 0.01  # of segments, by something else


def beside_lost_samples(sought: Sought) -> Beside | None:
    """Return effects that last beside samples that were lost, if there are more than was found."""
    prepared, selection, found = sought.prepared, sought.selection, sought.found
    if not found or not isinstance(found[0].unit.effect, SensorDropout):
        return None
    best, model = found[0], prepared.predictor.system.task.model
    if model.nq != model.nv:  # a rotation is not interpolated by its coordinates
        return None
    renewal = _Renewal(prepared, best.unit, best.strength, sought.suspects.alone.law.size)
    known = selection.best if best.beside else selection.nominal
    logs = {name: renewal.of(part, known.fit.point) for name, part in prepared.logs.items()}
    again, other = sought.search(with_other_logs(prepared, logs, generator=sought.generator))
    if not set(other.best.names) - set(known.names):
        return None
    data = {name: one.at(other.best.fit.point) for name, one in sought.suspects.nominal.items()}
    sensors = [u for u in sought.suspects.units if isinstance(u.effect, SensorDropout)]
    lost = all_found(data, sensors, Alone.of(data), other.best.units)
    chance = next((one for one in lost if one.unit == best.unit), None)
    if chance is None or chance.deviance > best.deviance - CERTAIN:
        return None
    return Beside(prepared, again, other, replace(chance, beside=True))


@dataclass(frozen=True, eq=False)
class _Renewal:
    """What decides whether samples were lost, and puts others in their place.

    Attributes:
        prepared: Logs as they were recorded.
        unit: The sensor whose samples are lost.
        share: How many of them.
        size: Innovations of a segment.
    """

    prepared: Prepared
    unit: Unit
    share: float
    size: int

    def of(self, logs: Sequence[Log], point: Point) -> list[Log]:
        """Return logs in which the samples that are likely to have been lost are interpolated.

        Args:
            logs: Of a split.
            point: The simulator in which it is decided on.
        """
        least = 2 * steps_of(self.prepared)
        return [self._renewed(log, point) if len(log) > least else log for log in logs]

    def _renewed(self, log: Log, point: Point) -> Log:
        prepared = self.prepared
        history = max(prepared.sets["train"].segments.history, 1)
        steps = steps_of(prepared)
        stride = max(1, steps // 2)  # each sample is decided on twice
        pieces = cut([log], steps, history=history, stride=stride)
        predictor, noise = prepared.predictor, prepared.noise
        objective = prepared.mode.objective(
            predictor, predictor.system.prior, pieces, z=point.z, noise=noise
        )
        law = LossLaw(self.share, 1.0, _SPOILED, self.size)
        likely = LossSegments.of(objective, point).lost(self.unit, law)
        lost = _decided(len(log), pieces.start, likely)
        column = self.unit.targets[0]
        return _interpolated(log, lost, int(predictor.sensing.channels[column]))


def _decided(rows: int, start: NDArray[np.int64], likely: Array) -> NDArray[np.bool_]:
    """Return which samples of a log are likely to be lost, by the mean of the segments they are in.

    Args:
        rows: Of the log.
        start: The row at which each segment starts, ``(S,)``.
        likely: Probability that each of its values is lost, the first at its start, ``(S, 1 + H)``.

    Example:
        >>> _decided(5, np.array([0, 1]), np.array([[0.0, 0.9, 0.1], [0.3, 0.2, 0.0]]))
        array([False,  True, False, False, False])
    """
    total, count = np.zeros(rows), np.zeros(rows)
    at = start[:, None] + np.arange(likely.shape[1])
    np.add.at(total, at, likely)
    np.add.at(count, at, 1.0)
    return total > LIKELIER * np.maximum(count, 1.0)


def _interpolated(log: Log, lost: NDArray[np.bool_], coordinate: int) -> Log:
    """Return a log with some samples of a tangent coordinate interpolated by Akima's cubics.

    A velocity that was estimated from them is estimated again, but for the ends of the log.
    """
    if not lost.any() or (~lost).sum() < 5:
        return log
    time, width = log.time.numpy(), log.qvel.shape[1]
    name, column = ("qpos", coordinate) if coordinate < width else ("qvel", coordinate - width)
    values = getattr(log, name).clone()
    kept = values[:, column].numpy()
    between = Akima1DInterpolator(time[~lost], kept[~lost])(time)
    values[:, column] = torch.from_numpy(np.where(lost & np.isfinite(between), between, kept))
    renewed = replace(log, **{name: values})
    if name == "qpos" and log.velocity_gain[column] > 0:
        estimated, _, half = velocity(Windows(time), values[:, column].numpy())
        speeds, inner = log.qvel.clone(), slice(half, len(log) - half)
        speeds[inner, column] = torch.from_numpy(estimated[inner])
        renewed = replace(renewed, qvel=speeds)
    return renewed
