r"""Jitter of commands: each is late by a time of its own, and what that changes is nearly linear.

With the time late uniform between 0 and :math:`s`, the command that acts in step :math:`k` has mean
and variance

.. math::
    \bar a_k = \frac1s \int_0^s u(t_k - \tau)\, d\tau, \qquad
    v_k = \frac1s \int_0^s u(t_k - \tau)^2\, d\tau - \bar a_k^2,

:math:`u` between the commands of two steps on the line that joins them. One simulation per step and
actuator says what a change of that command does to the innovations, :math:`p_k`; so they are moved
by :math:`\sum_k (\bar a_k - u_k)\, p_k` and scattered by :math:`\sum_k v_k\, p_k p_k^T`
(`moved_innovations`), whatever the strength and wherever it is. Where the command changes little,
jitter does little: that tells it from a force that varies by itself.
"""

from __future__ import annotations

__all__ = ["Jitter", "Responses", "jitter", "moments", "shaken"]

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .loss_segments import command_slopes
from .moved_innovations import Judged, Moved, Told, tell
from .objective import Objective, Point, Unit

Array = NDArray[np.float64]
_TIMES = 64  # τ at which the integrals are taken
_LEVELS = np.geomspace(0.02, 1.0, 9)  # of the range of the strength
_FINER = np.geomspace(0.65, 1.55, 7)  # times the best of these
_SIZES = np.geomspace(
    0.01, 1.0, 7
)  # of the largest command there was: a force that varies by itself
_LEAST, _MOST = 0.05, 0.5  # relative error of a strength: what else differs counts too


@dataclass(frozen=True, eq=False)
class Responses:
    """What a change of each command does in some segments.

    Attributes:
        judged: The segments, at a fit.
    """

    judged: Judged

    @classmethod
    def of(cls, objective: Objective, point: Point, most: int) -> Responses:
        """Return those of so many segments of a split at least."""
        return cls(Judged.of(objective, point, most))

    @cached_property
    def _slopes(self) -> dict[int, Array]:
        """By actuator, each of shape ``(S, M, H)``."""
        return {}

    def slopes(self, actuator: int) -> Array:
        """Return what a change of each command of an actuator does, ``(S, M, H)``."""
        if actuator not in self._slopes:
            judged, segments = self.judged, self.judged.objective.segments
            at = segments.history
            before = segments.ctrl[:, at - 1 : at + segments.horizon - 1, actuator]
            self._slopes[actuator] = command_slopes(
                judged.objective, judged.point, judged.left, actuator, others=before
            )
        return self._slopes[actuator]

    def moved(self, unit: Unit, strength: float) -> Moved:
        """Return what jitter does at the targets of a unit, at each by itself."""
        segments = self.judged.objective.segments
        rows = segments.history + np.arange(segments.horizon)
        dt = self.judged.objective.predictor.system.control_dt
        mean, roots = np.zeros_like(self.judged.left), []
        for target in unit.targets:
            steps = unit.direction[target] * strength / dt
            change, variance = moments(segments.ctrl[..., target], rows, steps)
            slopes = self.slopes(target)
            mean += np.einsum("smk,sk->sm", slopes, change)
            roots.append(slopes * np.sqrt(variance)[:, None])
        return Moved.of(mean, np.concatenate(roots, -1))

    def pushed(self, unit: Unit, size: float) -> Moved:
        """Return what a force does there that is another in each step, whatever was commanded."""
        ctrl = np.abs(self.judged.objective.segments.ctrl)
        roots = [size * ctrl[..., t].max() * self.slopes(t) for t in unit.targets]
        return Moved.of(np.zeros_like(self.judged.left), np.concatenate(roots, -1))


def moments(ctrl: Array, rows: NDArray[np.int64], steps: float) -> tuple[Array, Array]:
    """Return how commands change on average, and their variance, ``(S, H)`` each.

    Args:
        ctrl: Commands of an actuator, windows, shape ``(S, W)``.
        rows: The rows that are late, shape ``(H,)``; those before them are in the windows.
        steps: Steps by which each is late at most.

    Example:
        >>> ctrl = np.array([[0.0, 0.0, 1.0]])
        >>> change, variance = moments(ctrl, np.array([2]), 1.0)  # uniform between 0 and 1
        >>> change.round(3).item(), variance.round(3).item()
        (-0.5, 0.083)
    """
    late = (np.arange(_TIMES) + 0.5) / _TIMES * steps
    whole = late.astype(np.int64)
    part = (late - whole)[:, None, None]
    at = rows - whole[:, None]
    acting = (1 - part) * ctrl[:, at].swapaxes(0, 1)
    acting = acting + part * ctrl[:, at - 1].swapaxes(0, 1)
    return acting.mean(0) - ctrl[:, rows], acting.var(0)


@dataclass(frozen=True, eq=False)
class Jitter:
    """The likeliest jitter.

    Attributes:
        unit: Where.
        strength: Seconds.
        error: Standard deviation of that.
        told: What the judged segments say of it.
    """

    unit: Unit
    strength: float
    error: float
    told: Told

    @property
    def cost(self) -> float:
        """Deviance of the judged segments."""
        return self.told.cost


def jitter(judged: Sequence[Responses], units: Sequence[Unit]) -> Jitter:
    """Return the likeliest jitter of those at some actuators.

    Args:
        judged: Segments of the fit, then of those that judge it.
        units: Jitter at its targets, one at least.
    """
    return min((_likeliest(judged, unit) for unit in units), key=lambda one: one.cost)


def _likeliest(judged: Sequence[Responses], unit: Unit) -> Jitter:
    every = {level: _told(judged, unit, level) for level in (_LEVELS * unit.high).tolist()}
    best = min(every, key=lambda level: every[level].cost)
    finer = np.unique(np.minimum(_FINER * best, unit.high)).tolist()
    every |= {level: _told(judged, unit, level) for level in finer if level != best}
    levels = np.array(sorted({*finer, best}))
    costs = np.array([every[level].cost for level in levels])
    least = float(levels[costs.argmin()])
    curve = float(np.polyfit(np.log(levels), costs, 2)[0]) if len(levels) > 2 else 0.0
    error = float(np.clip(1 / np.sqrt(max(curve, 1e-9)), _LEAST, _MOST)) * least
    return Jitter(unit, least, error, every[least])


def _told(judged: Sequence[Responses], unit: Unit, strength: float) -> Told:
    return tell([one.judged for one in judged], [one.moved(unit, strength) for one in judged])


def shaken(judged: Sequence[Responses], unit: Unit) -> float:
    """Return the least deviance of forces that are others in each step, whatever was commanded."""
    each = [one.judged for one in judged]
    return min(tell(each, [one.pushed(unit, s) for one in judged]).cost for s in _SIZES.tolist())
