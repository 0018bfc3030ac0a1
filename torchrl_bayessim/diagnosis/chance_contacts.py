"""Segments in which noise makes as much as is left: whether a foot comes down there is chance.

The covariance of a segment's innovations is a linear view at one simulator. At another one the same
segment may pass an impact that it missed before, and noise of start and sensors then makes of it
sixty times what the covariance says: on clean data of a running robot half of what is left sits in
few such segments. So where much is left, a robot is simulated that *is* the simulator, with noise
of its own, and rows in which its innovations are larger than one are trusted that much less, if
need be as its loudest run. Of a few segments that are louder than any of those runs a thousand are
simulated: an object that a hand just misses may be hit in one of so many. What the simulator lacks
noise does not make, and counts as before.
"""

from __future__ import annotations

__all__ = ["left_to_chance", "trusted_less"]

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .contacts import touches
from .objective import Objective, Point
from .whitening import excess

Array = NDArray[np.float64]
_LOUD = 3.0  # mean squared innovation of a segment that is looked at
_DRAWS, _MANY = 48, 1000  # of the noise; of segments that are louder than any of those
_BEYOND = 3.0  # times its loudest draw that such a segment is
_RARE = 0.05  # of the segments, one at least: where more are, it is no chance
_TWICE = 2.0  # what the covariance says
_PART = 0.3  # of what is left beyond noise
_FEW = 0.5  # of the segments: where more are loud, the simulator lacks something everywhere


def left_to_chance(
    sets: Mapping[str, Objective], point: Point, *, noise: Array, generator: np.random.Generator
) -> dict[str, Objective]:
    """Return those objectives of which segments are trusted less; see `trusted_less`."""
    found = {
        name: trusted_less(objective, point, noise=noise, generator=generator)
        for name, objective in sets.items()
    }
    return {name: objective for name, objective in found.items() if objective is not None}


def trusted_less(
    objective: Objective, point: Point, *, noise: Array, generator: np.random.Generator
) -> Objective | None:
    """Return the objective with what chance makes of its loud segments.

    Nothing if that is less than a third of what is left beyond noise, or most segments are loud.
    The generator is drawn from twice where a few segments are louder than any draw.

    Args:
        objective: Segments and their covariance, of one simulator.
        point: The simulator.
        noise: Standard deviation of each channel's noise, shape ``(C,)``.
        generator: Of the noise that is drawn.
    """
    squares = (objective.unweighted([point])[0] ** 2).mean(-1)
    loud = np.flatnonzero(squares > _LOUD)
    if not 0 < len(loud) <= _FEW * len(squares) or not touches(
        objective.predictor, objective.segments.qpos
    ):
        return None
    larger, most = _made_by_noise(objective.take(loud), point, noise, generator)
    chance = larger.mean(1) > _TWICE
    rare = np.flatnonzero(_after(objective, loud, larger, point) > _BEYOND * most)
    if 0 < len(rare) <= max(1.0, _RARE * len(squares)):
        few = objective.take(loud[rare])
        larger[rare], most[rare] = _made_by_noise(few, point, noise, generator, draws=_MANY)
        # all or nothing: the loudest of a thousand draws is loud without a reason, too
        again = _after(objective, loud[rare], larger[rare], point)
        chance[rare] = again <= _TWICE * most[rare]
    loud, larger, most = loud[chance], larger[chance], most[chance]
    if not len(loud):
        return None
    less = _scaled(objective, loud, larger)
    # what chance makes varies: up to the loudest draw, a segment tells no more than noise
    after = _after(objective, loud, larger, point)
    still = np.clip(after, 1.0, most)
    less = _scaled(less, loud, np.repeat(still[:, None], larger.shape[1], 1))
    by_chance = squares[loud] - after / still
    left = np.maximum(squares - 1.0, 0.0).sum()
    if by_chance.sum() <= _PART * left:
        return None
    # what made them loud was why they counted for less: not twice for one reason
    return less if (objective.whitening.weights == 1.0).all() else less.weighted(point)


def _after(objective: Objective, segments: NDArray[np.int64], larger: Array, point: Point) -> Array:
    """Return mean squared innovations of some segments with variances so much larger, ``(S,)``."""
    some = objective.take(segments)
    less = _scaled(some, np.arange(len(segments)), larger)
    return (less.unweighted([point])[0] ** 2).mean(-1)


def _scaled(objective: Objective, segments: NDArray[np.int64], larger: Array) -> Objective:
    """Return the objective with variances so much larger in rows ``(S, K)`` of some segments."""
    whitening = objective.whitening
    inverse, drift = whitening.inverse.copy(), whitening.drift.copy()
    channels = drift.shape[1] // larger.shape[1]
    scale = 1.0 / np.sqrt(np.repeat(larger, channels, axis=1))
    inverse[segments] *= scale[..., None]
    drift[segments] *= scale
    return objective.whitened(replace(whitening, inverse=inverse, drift=drift))


def _made_by_noise(
    objective: Objective,
    point: Point,
    noise: Array,
    generator: np.random.Generator,
    *,
    draws: int = _DRAWS,
) -> tuple[Array, Array]:
    """Return how much larger than one squared innovations of noise are.

    Returns:
        In each row, 1 at least, ``(S, K)``; and the loudest draw of a segment, of those, ``(S,)``.
    """
    moved = objective.made_by_noise(point, noise, draws=draws, generator=generator)
    white = objective.whitening(moved) / objective.whitening.weights[:, None]
    squares = (white**2).reshape(*moved.shape)
    # what diverges says nothing of how loud noise is
    squares[~np.isfinite(moved).all((2, 3))] = 1.0
    larger = excess(squares)
    return larger, np.maximum((squares.mean(-1) / larger).mean(-1).max(0), 1.0)
