"""Residuals in units of what noise alone would leave: covariance, robust weights, noise floor.

The residual of segment ``i``, measured noise with covariance ``R`` at every compared row and a
start state known only up to ``P0``, has covariance::

    C_i = I ⊗ R + J_i P0 J_iᵀ + Σ_j κ_ij κ_ijᵀ + ¼ δ_i δ_iᵀ,    κ_ij = (ŷ⁺ + ŷ⁻ - 2ŷ) / 2,

``J_i`` the derivative with respect to the start state by central differences of one standard
deviation each. The second differences κ grow where contacts switch, and so tell the analysis not
to trust exactly those segments. ``δ_i`` is what the time step does: twice the difference that half
the time step makes, by Richardson's extrapolation of a method of first order, since a simulator
that integrates coarsely is not a robot with another physics. What of it is common to all segments
is fitted, with one coefficient (see `objective`). With ``C_i = L_i L_iᵀ``, ``L_i⁻¹ r_i``
are innovations: white, of unit variance, for a perfect simulator.
"""

from __future__ import annotations

__all__ = [
    "ENOUGH",
    "Whitening",
    "drawn_starts",
    "excess",
    "innovation_noise",
    "noise_from_differences",
    "start_deviations",
    "start_noise",
    "whitening",
]

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..logs.log import Log
from ..logs.system import System
from .prediction import Predictor
from .segments import Segments

Array = NDArray[np.float64]
_WORST = 1e3  # innovations beyond this, and those of diverged simulations, count as this
_KNOWN = 3.0  # times the error of an estimate that knows what it is to predict
_CARRIED = 2.0  # times that of one from earlier rows: what is missing pushes the same way for long
_ROUNDING = 1e-13  # of the largest variance
_MOST, _HALF, _CALM = 0.9, 0.5, 0.25  # shares of the segments that noise is estimated from
_UNEVEN = 1.3  # ratio of the first two estimates, beyond which some segments hold more than noise
ENOUGH = 40  # segments, to single out a quarter of them
_DRAWS = 24  # simulated robots that the whitening is checked on
_UNIT = 8  # draws of unit noise
_MISSED = 1.2  # times what the linear view says, from which variances of simulated robots count
_THIRD_DIFFERENCE = 20.0  # 1 + 9 + 9 + 1: variance of y₃ - 3y₂ + 3y₁ - y₀ per unit of white noise


@dataclass(frozen=True, eq=False)
class Whitening:
    """What turns residuals into innovations.

    Attributes:
        inverse: ``L⁻¹`` of each segment, shape ``(S, KC, KC)``.
        weights: Square roots of the segments' robust weights, shape ``(S,)``.
        spread: Standard deviations of the residuals under noise alone, ``(S, K, C)``.
        drift: Innovations that the time step makes, by extrapolation, shape ``(S, KC)``.
        curvature: Median over segments of ``‖κ‖ / ‖J‖``: above one the horizon is too long.
    """

    inverse: Array
    weights: Array
    spread: Array
    drift: Array
    curvature: float

    def __call__(self, residual: Array) -> Array:
        """Return weighted innovations, shape ``(P, S, KC)`` of residuals ``(P, S, K, C)``."""
        flat = residual.reshape(*residual.shape[:2], -1)
        white = np.matmul(self.inverse, flat.transpose(1, 2, 0)).transpose(2, 0, 1)
        white = np.nan_to_num(white, nan=_WORST, posinf=_WORST, neginf=-_WORST)
        return np.clip(white, -_WORST, _WORST) * self.weights[:, None]

    def log_likelihood(self, residual: Array) -> Array:
        """Return ``-½ (‖ε_i‖² + log det C_i)`` of residuals ``(P, S, K, C)``, shape ``(P, S)``."""
        scale = np.log(np.einsum("sii->si", self.inverse)).sum(1)
        return scale - 0.5 * (self(residual) ** 2).sum(-1)

    def take(self, index: NDArray[np.int64]) -> Whitening:
        """Return that of some of the segments."""
        names = "inverse", "weights", "spread", "drift"
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    def weighted(self, innovations: Array) -> Whitening:
        """Return the same with Huber's weights for these innovations, ``(S, KC)``.

        ``w_i = min(1, 1.5 m / r_i)`` with ``r_i`` the root mean square of segment ``i`` and ``m``
        their median. They are computed once and kept for all candidates: weights of its own would
        let a strong candidate remove what speaks against it.
        """
        size = np.maximum(np.sqrt((innovations**2).mean(-1)), 1e-12)  # 0 where all stands still
        weight = np.minimum(1.0, 1.5 * np.median(size) / size)
        return Whitening(self.inverse, np.sqrt(weight), self.spread, self.drift, self.curvature)


def whitening(
    predictor: Predictor,
    segments: Segments,
    theta: Array,
    noise: Array,
    *,
    generator: np.random.Generator | None = None,
) -> Whitening:
    """Return the whitening at one candidate.

    Args:
        predictor: Simulates.
        segments: The segments.
        theta: Parameters, shape ``(D,)``.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
        generator: To check the whitening on simulated data: a perfect robot is simulated with half
            the time step and noise of its own; rows whose innovations are larger than one there
            (where the linear view of the start's noise fails) are trusted that much less.
    """
    root = start_noise(predictor, segments, noise)
    offsets = np.concatenate([np.zeros_like(root[:1]), root, -root])
    thetas = np.repeat(theta[None], len(offsets), 0)
    residual = predictor.residuals(segments, thetas, None, offsets)
    finer = predictor.finer.residuals(segments, theta[None])
    size, checks, channels = residual.shape[1:]
    flat = np.nan_to_num(residual.reshape(len(offsets), size, -1))
    plus, minus, nominal = flat[1 : 1 + len(root)], flat[1 + len(root) :], flat[0]
    slope, curve = (plus - minus) / 2, (plus + minus - 2 * nominal) / 2
    spread = np.einsum("jsm,jsn->smn", slope, slope) + np.einsum("jsm,jsn->smn", curve, curve)
    step = 2.0 * (nominal - np.nan_to_num(finer.reshape(size, -1)))
    spread += 0.25 * step[:, :, None] * step[:, None, :]
    every = np.arange(checks * channels)
    # where chaos amplifies the start's noise a millionfold, rounding errors are not negligible
    rounding = _ROUNDING * spread[:, every, every].max(1, keepdims=True)
    spread[:, every, every] += np.tile(noise**2, checks) + rounding
    lower = np.linalg.cholesky(spread)
    inverse = np.linalg.inv(lower)
    if generator is not None:
        drawn = drawn_starts(root, _DRAWS, generator)
        moved = predictor.residuals(segments, np.repeat(theta[None], _DRAWS, 0), None, drawn)
        made = moved - finer - (step / 2).reshape(finer.shape)
        made += noise * generator.standard_normal(moved.shape)
        white = np.matmul(inverse, np.nan_to_num(made, nan=_WORST).reshape(_DRAWS, size, -1, 1))
        larger = excess((white**2).reshape(_DRAWS, size, checks, channels))
        inverse /= np.sqrt(np.repeat(larger, channels, axis=1))[..., None]
    variance = np.diagonal(spread, axis1=1, axis2=2).reshape(size, checks, channels)
    bent = np.linalg.norm(curve, axis=(0, 2)) / np.maximum(
        np.linalg.norm(slope, axis=(0, 2)), 1e-12
    )
    drift = np.matmul(inverse, step[..., None])[..., 0]
    return Whitening(inverse, np.ones(size), np.sqrt(variance), drift, float(np.median(bent)))


def excess(squares: Array) -> Array:
    """Return how much larger than one squares of simulated innovations are, 1 at least, ``(S, K)``.

    Until something touches the ground a segment is as predictable as the others: so rows that are
    certainly worse count by themselves, and the others of the segment together.

    Args:
        squares: Shape ``(draws, S, K, C)``.
    """
    rows = np.minimum(squares.mean((0, 3)), _WORST)
    loud = rows > 1.0 + 3.0 * np.sqrt(2.0 / (squares.shape[0] * squares.shape[3]))
    others = np.where(loud, 0.0, rows).sum(1) / np.maximum((~loud).sum(1), 1)
    return np.where(loud, rows, np.maximum(others, 1.0)[:, None])


def drawn_starts(root: Array, draws: int, generator: np.random.Generator) -> Array:
    """Return drawn errors of the start states, ``(draws, S, 2 nv)``; see `start_noise`."""
    steps, size, _ = root.shape
    return np.einsum("dsj,jsn->dsn", generator.standard_normal((draws, size, steps)), root)


def start_noise(predictor: Predictor, segments: Segments, noise: Array) -> Array:
    """Return steps of one standard deviation of the start states, ``(J, S, 2 nv)``.

    Their squares sum up to the covariance.
    """
    size = predictor.tangent.size
    start = start_deviations(
        predictor.system, noise, segments.velocity_gain, segments.velocity_error
    )
    steps = np.diag(start)[start > 0]
    steps = np.broadcast_to(steps[:, None], (len(steps), len(segments), 2 * size))
    roots = [segments.freed(steps)]
    if segments.touching is not None:
        roots.append(_roots(segments.touching.error))
    if segments.uncertainty is not None:
        known = _KNOWN if segments.smoothed else _CARRIED
        roots.append(known * _roots(segments.uncertainty))
    return np.concatenate(roots)


def _roots(covariance: Array) -> Array:
    """Return steps whose squares sum up to covariances ``(S, 2 nv, 2 nv)``, ``(J, S, 2 nv)``."""
    asked = np.flatnonzero(covariance.any((0, 1)))
    some = covariance[:, asked[:, None], asked]
    variances = np.einsum("sii->si", some)
    roots = np.zeros((*covariance.shape[:2], len(asked)))
    safe = some + 1e-9 * np.einsum("si,ij->sij", variances, np.eye(len(asked)))
    values, vectors = np.linalg.eigh(safe)
    roots[:, asked] = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    return np.moveaxis(roots, -1, 0)


def start_deviations(system: System, noise: Array, gain: Array, error: Array) -> Array:
    """Return the standard deviation of each coordinate of a measured start, ``(2 nv,)``.

    Args:
        system: The robot.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
        gain: Noise of an estimated velocity per noise of the position, ``(nv,)``.
        error: Of an estimated velocity, where motion is too fast for it, ``(nv,)``.
    """
    size = len(gain)
    start = np.zeros(2 * size)
    start[list(system.channel_index)] = noise
    # An estimated velocity knows of the rows that it is to predict: three times its noise leaves
    # the segment itself to say how fast it began.
    estimated = _KNOWN * gain * start[:size]
    start[size:] = np.maximum(start[size:], np.maximum(estimated, error))
    return start


def noise_from_differences(logs: Sequence[Log], values: Sequence[Array]) -> Array:
    """Return each channel's noise from third differences, shape ``(C,)``.

    A signal that is smooth on the scale of the sampling drops out of ``y₃ - 3y₂ + 3y₁ - y₀``; white
    noise of variance σ² leaves 20 σ². The median is taken, since contacts are not smooth.

    Args:
        logs: The logs.
        values: What their channels hold, shape ``(T, C)`` each.
    """
    third = [np.diff(v, 3, axis=0) for v, log in zip(values, logs, strict=True) if len(log) > 3]
    spread = np.median(np.abs(np.concatenate(third)), axis=0) / 0.6745
    return spread / np.sqrt(_THIRD_DIFFERENCE)


def innovation_noise(
    innovations: Array, pushes: Array, checks: int, *, drawn: Array | None = None
) -> Array:
    """Return by which factor each channel's noise differs from what was assumed, shape ``(C,)``.

    ``σ̂² = mean ½(ε_{t+1} - ε_t)²`` over innovations in order of time, divided by what unit noise
    gives in the same way, or simulated robots whose noise is known, where the linear view misses
    much of theirs: a model's error is smooth, and so drops out. What a constant force at any joint
    could explain within the segment is projected out first, since over a few steps a missing force
    is hardly more than that. The worst tenth of the segments is left out, or, where the worse half
    of many has more than its part, all but the calmest quarter: noise is the same everywhere, and
    what a missing effect does, such as an impact where backlash closes, is not.

    Args:
        innovations: Shape ``(S, KC)``.
        pushes: What a force at each joint changes, shape ``(J, S, KC)``.
        checks: Rows per segment, ``K``.
        drawn: Innovations of simulated robots, shape ``(draws, S, KC)``.
    """
    segments, size = innovations.shape
    channels = size // checks
    basis = np.moveaxis(pushes, 0, -1)
    left, values, _ = np.linalg.svd(basis, full_matrices=False)
    left = left * (values > 1e-6 * np.maximum(values[:, :1], 1e-12))[:, None]
    steps = np.eye(size)[channels:] - np.eye(size)[:-channels]

    def squares(some: Array) -> Array:
        rest = some - np.einsum("smj,snj,rsn->rsm", left, left, some, optimize=True)
        changes = (rest @ steps.T) ** 2
        return changes.reshape(len(some), segments, checks - 1, channels).sum(2)

    unit = squares(np.random.default_rng(0).standard_normal((_UNIT, segments, size)))
    found, simulated = squares(innovations[None]), None if drawn is None else squares(drawn)

    def factor(share: float) -> Array:
        usual = _calm(unit, share)
        if simulated is not None:
            made = _calm(simulated, share)
            # they start where noise has put a foot into the ground already: they err upwards
            usual = np.where(made > _MISSED * usual, made, usual)
        return _calm(found, share) / usual

    most, half, calm = (factor(share) for share in (_MOST, _HALF, _CALM))
    uneven = (most > _UNEVEN * half) & (segments >= ENOUGH)
    return np.sqrt(np.where(uneven, calm, most))


def _calm(squares: Array, share: float) -> Array:
    """Return sums over the calmest segments, of squares ``(N, S, C)``; their mean, ``(C,)``."""
    most = np.quantile(squares, share, axis=1, keepdims=True)
    return np.asarray(np.where(squares <= most, squares, 0.0).sum(1).mean(0))
