r"""What is to be explained where rows cannot be compared: summary statistics of windows of logs.

Clocks of commands and sensors that nobody synchronised move a record by an unknown number of rows,
and chaos decides where a robot is after a while; how far and how fast it moves is left by both. So
of every window are compared, channel by channel and weighted by a Hann window :math:`w_t`, which
forgives what enters and leaves at the edges, the statistics

.. math::  m = \sum_t w_t y_t, \quad \tfrac12 \log a_0, \quad a_\ell / a_0, \quad
           \sum_t w_t |d_t| / \sqrt{a_0}, \quad \sum_t w_t d_t^3 / a_0^{3/2}, \qquad
           a_\ell = \sum_t w_t d_t d_{t + \ell}, \quad d_t = y_t - m.

The residual is their value in the log minus the mean of what simulations give that start from
states nearby, at most ``shift`` rows away, and measure with noise; the draws are the same for all
candidates. Its covariance is that of such simulations at the nominal simulator (synthetic
likelihood: Wood, Nature 466, 2010): correlations from all windows, standard deviations from each.
"""

from __future__ import annotations

__all__ = ["SyntheticObjective", "statistics", "synthetic_objective"]

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..inference.priors import Prior
from .objective import Objective, Point, parameters_at, strengths_of
from .prediction import Predictor
from .segments import Segments
from .strengths import Strengths
from .whitening import Whitening

Array = NDArray[np.float64]
_LAGS = (0.02, 0.04, 0.08, 0.16, 0.32)  # of the window
_DRAWS = 4  # simulations of every candidate and window
_MANY = 128  # of the nominal simulator, for the covariance
_SHRUNK = 0.05  # share of independence in the correlations


@dataclass(frozen=True, eq=False)
class _Draws:
    """What is drawn, the same for every candidate.

    Attributes:
        late: Rows by which sensors lag behind commands, ``(D, S)``, between ``-most`` and ``most``.
        most: The largest.
        offsets: Steps from the measured start states, ``(D, S, 2 nv)``.
        noise: Of every row that statistics are taken of, ``(D, S, T, C)``.
    """

    late: NDArray[np.int64]
    most: int
    offsets: Array
    noise: Array

    def take(self, index: NDArray[np.int64]) -> _Draws:
        """Return those of some windows."""
        arrays = (getattr(self, name)[:, index] for name in ("late", "offsets", "noise"))
        late, offsets, noise = arrays
        return _Draws(late, self.most, offsets, noise)

    def seen(self, simulated: Array) -> Array:
        """Return what sensors show of ``(D, S, H, C)`` in the middle rows, ``(D, S, T, C)``."""
        rows = np.arange(self.most, simulated.shape[2] - self.most) - self.late[..., None]
        return np.take_along_axis(simulated, rows[..., None], axis=2) + self.noise


class SyntheticObjective(Objective):
    """Explains statistics of windows; see the module.

    Args:
        predictor: Simulates.
        prior: Over the parameters; none if there are none.
        segments: The windows; as many of their rows count as compared as there are statistics.
        whitening: Turns residuals into innovations.
        draws: Of start states and noise.
    """

    located = False

    def __init__(
        self,
        predictor: Predictor,
        prior: Prior | None,
        segments: Segments,
        whitening: Whitening,
        *,
        draws: _Draws,
    ) -> None:
        super().__init__(predictor, prior, segments, whitening)
        self.draws = draws

    def take(self, index: NDArray[np.int64]) -> Objective:
        """Return the objective on some windows."""
        some = super().take(index)
        return some._but(draws=self.draws.take(index))

    def raw(self, points: Sequence[Point], offsets: Array | None = None) -> Array:
        """Return differences of statistics, shape ``(P, S, K, C)``."""
        theta = self.theta(np.stack([point.z for point in points]))
        strengths = strengths_of(points, self.predictor.system.robot)
        most, count = self.draws.most, len(self.draws.late)
        record = _measured(self.predictor, _whole(self.segments))
        real = statistics(record[:, most : record.shape[1] - most])
        steps = np.tile(self.draws.offsets, (len(points), 1, 1))
        if offsets is not None:
            steps += np.repeat(offsets, count, 0)
        every = {effect: np.repeat(values, count, 0) for effect, values in strengths.items()}
        thetas = np.repeat(theta, count, 0)
        simulated = _simulated(self.predictor, self.segments, thetas, steps, strengths=every)
        parts = simulated.reshape(len(points), count, *simulated.shape[1:])
        return real - np.stack([statistics(self.draws.seen(part)).mean(0) for part in parts])


def synthetic_objective(
    predictor: Predictor,
    prior: Prior | None,
    segments: Segments,
    *,
    z: Array,
    noise: Array,
    shift: int,
    seed: int = 0,
) -> SyntheticObjective:
    """Return the objective, with the covariance of simulations at ``z``.

    Args:
        predictor: Simulates.
        prior: Over the parameters.
        segments: Windows.
        z: Standardised parameters.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
        shift: Rows by which commands and sensors may be apart, at most.
        seed: Of the draws.
    """
    generator = np.random.default_rng(seed)
    theta = parameters_at(prior, z)[None]

    def drawn(count: int) -> _Draws:
        return _drawn(predictor, segments, noise, shift=shift, count=count, generator=generator)

    def shown(by: Predictor, draws: _Draws) -> Array:
        thetas = np.repeat(theta, len(draws.late), 0)
        return statistics(draws.seen(_simulated(by, segments, thetas, draws.offsets)))

    found = shown(predictor, drawn(_MANY))
    few = drawn(_DRAWS)
    step = 2.0 * (shown(predictor.finer, few) - shown(predictor, few)).mean(0)
    white = _whitening(found, step.reshape(len(segments), -1))
    rows = np.linspace(1, segments.horizon, found.shape[2]).round().astype(np.int64)
    return SyntheticObjective(predictor, prior, replace(segments, checked=rows), white, draws=few)


def statistics(values: Array) -> Array:
    """Return the statistics of windows, ``(*, T, C)`` to ``(*, K, C)``.

    Example:
        >>> wave = np.sin(0.3 * np.arange(201.0))[:, None]
        >>> late = np.sin(0.3 * (np.arange(201.0) - 6))[:, None]
        >>> bool(np.abs(statistics(wave) - statistics(late)).max() < 0.01)
        True
    """
    rows = values.shape[-2]
    weight = np.hanning(rows + 2)[1:-1, None]
    mean = (weight * values).sum(-2, keepdims=True) / weight.sum()
    apart = values - mean
    lags = [max(1, round(lag * rows)) for lag in _LAGS]
    variance = (weight * apart**2).sum(-2) / weight.sum() + 1e-300
    found = [mean[..., 0, :], 0.5 * np.log(variance)]
    for lag in lags:
        both = np.sqrt(weight[lag:] * weight[:-lag])
        found.append((both * apart[..., lag:, :] * apart[..., :-lag, :]).sum(-2) / both.sum()
                     / variance)  # fmt: skip
    size = np.sqrt(variance)
    found.append((weight * np.abs(apart)).sum(-2) / weight.sum() / size)
    found.append((weight * apart**3).sum(-2) / weight.sum() / size**3)
    return np.stack(found, -2)


def _drawn(
    predictor: Predictor,
    segments: Segments,
    noise: Array,
    *,
    shift: int,
    count: int,
    generator: np.random.Generator,
) -> _Draws:
    """Return how late sensors are, the start states seen so much later, less noise, and noise."""
    at, size = segments.history, len(segments)
    late = generator.integers(-shift, shift + 1, (count, size))
    every = np.arange(size)
    turned = predictor.tangent.difference(segments.qpos[:, at], segments.qpos[every, at + late])
    sped = segments.qvel[every, at + late] - segments.qvel[:, at]
    offsets = np.concatenate([turned, sped], -1)
    channels = predictor.sensing.channels
    offsets[..., channels] += noise * generator.standard_normal((count, size, len(channels)))
    shape = (count, size, segments.horizon - 2 * shift, len(channels))
    return _Draws(late, shift, offsets, noise * generator.standard_normal(shape))


def _whole(segments: Segments) -> Segments:
    return replace(segments, checked=np.arange(1, segments.horizon + 1, dtype=np.int64))


def _measured(predictor: Predictor, segments: Segments) -> Array:
    """Return measured channels at the compared rows, rotations from the start, ``(S, K, C)``."""
    at, rows = segments.history, segments.rows
    turned = predictor.tangent.difference(segments.qpos[:, at : at + 1], segments.qpos[:, rows])
    tangent = np.concatenate([turned, segments.qvel[:, rows]], -1)
    return tangent[..., predictor.sensing.channels]


def _simulated(
    predictor: Predictor,
    segments: Segments,
    theta: Array,
    offsets: Array,
    *,
    strengths: Strengths | None = None,
) -> Array:
    """Return simulated channels at every row, ``(P, S, H, C)``."""
    whole = _whole(segments)
    residual = predictor.residuals(whole, theta, strengths, offsets)
    return _measured(predictor, whole) - residual


def _whitening(found: Array, drift: Array) -> Whitening:
    """Return the whitening of statistics ``(D, S, K, C)`` drawn from the nominal simulator."""
    draws, size, kinds, channels = found.shape
    flat = found.reshape(draws, size, -1)
    apart = flat - flat.mean(0)
    deviation = np.sqrt((apart**2).sum(0) / (draws - 1)) + 1e-12
    scaled = apart / deviation
    own = np.einsum("dsi,dsj->sij", scaled, scaled) / (draws - 1)
    common = min(1.0, flat.shape[2] / draws)
    correlation = (1 - common) * own + common * own.mean(0)
    correlation = (1 - _SHRUNK) * correlation + _SHRUNK * np.eye(flat.shape[2])
    spread = (1 + 1 / _DRAWS) * deviation[:, :, None] * deviation[:, None] * correlation
    spread += 0.25 * drift[:, :, None] * drift[:, None, :]
    inverse = np.linalg.inv(np.linalg.cholesky(spread))
    deviation = np.sqrt(np.einsum("sii->si", spread)).reshape(size, kinds, channels)
    moved = np.matmul(inverse, drift[..., None])[..., 0]
    return Whitening(inverse, np.ones(size), deviation, moved, 0.0)
