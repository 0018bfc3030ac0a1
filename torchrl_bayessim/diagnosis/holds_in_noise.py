r"""Samples of a position that were not renewed, though noise makes each a number of its own.

Measured velocities :math:`v` say how far a joint went, :math:`X_k = \sum_j \tfrac{\Delta}{2}
(v_{j-1} + v_j)`, whatever moved it. A sample that was renewed after :math:`r` rows has gone as far
as the joint, one that was not has not moved, and the next that is makes up for it:

.. math::
    y_k - y_{k-1} \sim N(X_k - X_{k-1-r}, s^2) \quad\text{or}\quad N(0, s^2),

a hidden Markov model of :math:`r` (Rabiner 1989), with a share :math:`p` of samples that are not
renewed and a few outliers. A robot whose velocities do not tell where it is after a row, as after
impacts, makes that about as likely without any; so it has to be far likelier with some.
"""

from __future__ import annotations

__all__ = ["HeldSamples", "held_in_noise", "with_motion"]

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

Array = NDArray[np.float64]
Held = NDArray[np.bool_]
_SHARES = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.45])  # p
_SCALES = np.array([0.7, 1.0, 1.4, 2.0, 3.0, 4.5])  # s, times a guess
_QUARTILE = 0.319  # of a normal distribution's size
_LONGEST = 12  # rows
_OUTLIERS = 0.03  # share, of any size
_UNCAUGHT = 1e-6  # of those that make up for held ones: a joint with play does not
_SURE, _EACH = 300.0, 7.0  # deviance, and for each sample that is held
_MOVING, _MOVED = 4.0, 0.1  # s that a joint moves in a row, and the share of rows in which it does


@dataclass(frozen=True, eq=False)
class HeldSamples:
    """Which samples of each log were not renewed.

    Attributes:
        rows: For each log, shape ``(T,)``; where the joint stood still nobody can tell.
        share: Of the rows of which it is known.
        count: How many these are.
        gain: How far positions go per measured velocity.
    """

    rows: list[Held]
    share: float
    count: int
    gain: float = 1.0


def held_in_noise(
    values: Sequence[Array], speeds: Sequence[Array], dt: float
) -> HeldSamples | None:
    """Return which samples of each log were not renewed; nothing unless that is sure.

    Args:
        values: Positions, one array for each log.
        speeds: Measured velocities.
        dt: Seconds from row to row.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> t = 0.02 * np.arange(300)
        >>> angle, speed = np.sin(3 * t), 3 * np.cos(3 * t)
        >>> lost = rng.random(300) < 0.2
        >>> last = np.maximum.accumulate(np.where(lost, 0, np.arange(300)))
        >>> shown = angle[last] + 1e-3 * rng.standard_normal(300)
        >>> found = held_in_noise([shown], [speed], 0.02)
        >>> bool((found.rows[0] != lost)[np.abs(speed) > 0.5].mean() < 0.01)
        True
        >>> bool(abs(found.share - 0.2) < 0.05)
        True
        >>> held_in_noise([angle + 1e-3 * rng.standard_normal(300)], [speed], 0.02) is None
        True
    """
    model = _Model.of(values, speeds, dt)
    # most joints move less from row to row, and need no more
    if model is None or model.moving(float(model.scales[0]))[model.there].mean() < _MOVED:
        return None
    costs = model.deviances()
    best = np.unravel_index(costs.argmin(), costs.shape)
    scale = float(model.scales[best[0]])
    moving, gained = model.moving(scale), float(costs[:, 0].min() - costs[best])
    if gained < _SURE or moving[model.there].mean() < _MOVED:
        return None
    rows = model.likeliest(scale, float(_SHARES[best[1]]))
    if gained < _EACH * sum(int(held.sum()) for held in rows):
        return None
    told = [held[1:][some[: len(held) - 1]] for held, some in zip(rows, moving, strict=True)]
    held = np.concatenate(told)
    return HeldSamples(rows, float(held.mean()), len(held), model.gain_between(rows, values, scale))


def with_motion(values: Array, speeds: Array, held: Held, time: Array) -> Array:
    """Return positions with held ones replaced by where the velocities say that the joint was."""
    steps = np.diff(time) * 0.5 * (speeds[1:] + speeds[:-1])
    gone = np.r_[0.0, np.cumsum(steps)]
    there = np.interp(time, time[~held], (values - gone)[~held]) + gone
    return np.where(held, there, values)


def _gain(moved: Array, changes: Array) -> float:
    """Return how far positions go per velocity, whatever gains the sensors have.

    The median of ratios weighted by motion: half of what is off is too small, and half too large.

    >>> moved = np.array([[1.0, 2.0, 2.0, 1.0]])
    >>> _gain(moved, np.array([[0.9, 1.8, 0.0, 2.7]]))
    0.9
    """
    there = np.isfinite(changes) & (moved != 0)
    if not there.any():
        return 1.0
    ratios, weights = changes[there] / moved[there], np.abs(moved[there])
    order = np.argsort(ratios)
    below = np.cumsum(weights[order])
    return float(ratios[order][np.searchsorted(below, 0.5 * below[-1])])


class _Model:
    """The hidden Markov model of several logs at once; rows beyond a log's end say nothing.

    Args:
        moved: By how much the velocities say that it moved in each row, shape ``(L, N - 1)``.
        changes: ``y_k - y_{k-1}``, not a number beyond the end, shape ``(L, N - 1)``.
        lengths: Rows of each log.

    Attributes:
        gain: How far positions go per that.
        gone: ``X``, shape ``(L, N)``.
        there: Which rows there are.
        scales: Those of ``s`` that are tried.
    """

    def __init__(self, moved: Array, changes: Array, lengths: Sequence[int]) -> None:
        self.changes, self.lengths = changes, list(lengths)
        self.there = np.isfinite(changes)
        self.gain = _gain(moved, changes)
        self.gone = self.gain * np.pad(np.cumsum(moved, 1), ((0, 0), (1, 0)))
        off = np.abs(changes - self.gain * moved)[self.there]
        self.scales = _SCALES * (np.quantile(off, 0.25) / _QUARTILE)
        self.reach = float(np.nanmax(np.abs(changes)))

    @classmethod
    def of(cls, values: Sequence[Array], speeds: Sequence[Array], dt: float) -> _Model | None:
        """Return that of some logs; nothing of a joint that stands still."""
        rows = max(len(one) for one in values)
        pairs = list(zip(values, speeds, strict=True))
        moved, changes = np.zeros((len(pairs), rows - 1)), np.full((len(pairs), rows - 1), np.nan)
        for i, (angle, speed) in enumerate(pairs):
            moved[i, : len(angle) - 1] = 0.5 * dt * (speed[1:] + speed[:-1])
            changes[i, : len(angle) - 1] = np.diff(angle)
        made = cls(moved, changes, [*map(len, values)])
        return made if made.scales[0] > 0 else None

    def moving(self, scale: float) -> Held:
        """Return in which rows the joint moves more than noise, shape ``(L, N - 1)``."""
        return (np.abs(np.diff(self.gone, axis=1)) > _MOVING * scale) & self.there

    def deviances(self) -> Array:
        """Return the deviance of every scale and share, shape ``(F, P)``."""
        scales, shares = self.scales[:, None, None, None], _SHARES[:, None, None]
        state = self._start((len(_SCALES), len(_SHARES)))
        for k in range(1, self.gone.shape[1]):
            renewed, held = self._densities(k, scales)
            first = logsumexp(state + renewed, axis=-1, keepdims=True) + np.log1p(-shares)
            with np.errstate(divide="ignore"):
                on = state[..., :-1] + held + np.log(shares)
            state = np.where(self._now(k), np.concatenate([first, on], -1), state)
        return np.asarray(-2 * logsumexp(state, axis=-1).sum(-1), dtype=np.float64)

    def gain_between(self, rows: Sequence[Held], values: Sequence[Array], scale: float) -> float:
        """Return how far positions go per velocity from one renewed sample to the next.

        Least squares, without outliers: held samples take part in the median, which is a guess.
        """
        gone = [one[: len(held)][~held] for one, held in zip(self.gone, rows, strict=True)]
        moved = np.concatenate([np.diff(one) for one in gone]) / self.gain
        went = [np.diff(one[~held]) for one, held in zip(values, rows, strict=True)]
        changes = np.concatenate(went)
        near = np.abs(changes - self.gain * moved) < _MOVING * scale
        square = float((moved[near] ** 2).sum())
        return float((moved[near] * changes[near]).sum()) / square if square else self.gain

    def likeliest(self, scale: float, share: float) -> list[Held]:
        """Return which samples are held in the likeliest sequence (Viterbi 1967)."""
        state, came = self._start(()), []
        for k in range(1, self.gone.shape[1]):
            renewed, held = self._densities(k, np.full((1, 1), scale))
            each = state + renewed
            first = each.max(-1, keepdims=True) + np.log1p(-share)
            now = np.concatenate([first, state[..., :-1] + held + np.log(share)], -1)
            came.append(each.argmax(-1))
            state = np.where(self._now(k), now, state)
        return [self._traced(log, int(state[log].argmax()), came) for log in range(len(state))]

    def _traced(self, log: int, last: int, came: Sequence[NDArray[np.intp]]) -> Held:
        held, rows = np.zeros(self.lengths[log], dtype=bool), last
        for k in range(len(held) - 1, 0, -1):
            held[k] = rows > 0
            rows = rows - 1 if rows > 0 else int(came[k - 1][log])
        return held

    def _start(self, shape: tuple[int, ...]) -> Array:
        state = np.full((*shape, len(self.gone), _LONGEST + 1), -np.inf)
        state[..., 0] = 0.0
        return state

    def _now(self, k: int) -> Held:
        return self.there[:, k - 1, None]

    def _densities(self, k: int, scales: Array) -> tuple[Array, Array]:
        """Return logarithms of densities of a change if it is renewed after ``r`` rows, or held."""
        before = np.maximum(k - 1 - np.arange(_LONGEST + 1), 0)
        change = np.nan_to_num(self.changes[:, k - 1])[:, None]
        moved = self.gone[:, k, None] - self.gone[:, before]
        outliers = np.where(np.arange(_LONGEST + 1) > 0, _UNCAUGHT, _OUTLIERS)
        return (
            self._log(change - moved, scales, outliers),
            self._log(change, scales, np.array(_OUTLIERS)),
        )

    def _log(self, off: Array, scales: Array, outliers: Array) -> Array:
        normal = np.exp(-0.5 * (off / scales) ** 2) / (scales * np.sqrt(2 * np.pi))
        return np.log((1 - outliers) * normal + outliers / (2 * self.reach))
