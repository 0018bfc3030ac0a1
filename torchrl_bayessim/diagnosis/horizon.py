"""How many control steps a segment has: as many as show the effects best."""

from __future__ import annotations

__all__ = ["chosen_horizon"]

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import Effect
from ..logs.log import Log
from .objective import Objective, Point, Unit, origin, parameters_at
from .prediction import Predictor
from .segments import cut_for_fits
from .whitening import drawn_starts, start_noise, whitening

Array = NDArray[np.float64]
_LADDER = (3, 5, 10, 20, 40, 80, 160)
_LARGEST, _LARGEST_UNSURE = 0.2, 0.4  # of the median log's length
_UNSURE = 20  # the least where start states were estimated from what they are to predict
_FILTERED = 10  # where the depth of contacts was
_PROBE = 100  # control steps on which horizons are compared
_WORTH = 0.2  # nats per effect that a longer horizon must bring
_BENT, _STRAIGHT = 1.0, 0.5  # second differences per first one: too many, and few enough
_SURVIVES = 0.9  # of a signature, another draw of the start's noise


def chosen_horizon(
    predictor: Predictor,
    logs: Sequence[Log],
    *,
    units: Sequence[Unit],
    noise: Array,
    history: int,
) -> int:
    """Return the horizon at which the effects would show most, per segment row simulated.

    Chosen on what simulations of the effects would look like, never on the residuals: largest
    ``Σ_e log(1 + λ_e)`` with ``λ_e`` the squared length of the whitened signature at a tenth of the
    range, as long as second differences stay below first ones, and signatures much the same at
    another draw of the start's noise: what contacts scramble no fit can follow. Rows in which
    contacts make more of that noise than its linear view says count less. Where start states were
    estimated from what follows them, few steps hardly say how a segment began, and nothing else;
    nor where contacts were, unless these many are scrambled.
    """
    typical = float(np.median([len(log) for log in logs]))
    guessed = any(log.uncertainty is not None for log in logs)
    filtered = any(log.touching is not None for log in logs)
    smoothed = any(log.smoothed for log in logs)
    least = _UNSURE if smoothed else _FILTERED if filtered else 0
    longest = typical * (_LARGEST_UNSURE if guessed else _LARGEST)
    units = _one_of_each(units)
    shown = partial(_shown, predictor, logs, units=units, noise=noise, history=history)
    best = partial(_best, shown, worth=_WORTH * len(units))
    ladder = [steps for steps in _LADDER if steps <= longest]
    enough = [steps for steps in ladder if steps >= least]
    choice = best(enough)
    if enough and not choice and filtered and not guessed:
        choice = best(steps for steps in ladder if steps < least)
    return choice or max(least, _LADDER[0])


def _one_of_each(units: Sequence[Unit]) -> list[Unit]:
    """Return each effect, of its forms the first, at the last of its places: usually all."""
    usual: dict[str, Effect] = {}
    for unit in units:
        usual.setdefault(unit.name, unit.effect)
    return list({u.name: u for u in units if u.effect == usual[u.name]}.values())


def _best(shown: Callable[[int], float], ladder: Iterable[int], *, worth: float) -> int:
    """Return the shortest horizon that no longer one beats by much; 0 if the first is scrambled."""
    best, choice = -np.inf, 0
    for steps in ladder:
        value = shown(steps)
        if not np.isfinite(value):
            break
        if value > best + worth:
            best, choice = value, steps
    return choice


def _shown(
    predictor: Predictor,
    logs: Sequence[Log],
    steps: int,
    *,
    units: Sequence[Unit],
    noise: Array,
    history: int,
) -> float:
    """Return ``Σ_e log(1 + λ_e)`` over so many steps; minus infinity if contacts scramble it."""
    prior = predictor.system.prior
    z = origin(prior)
    pieces = cut_for_fits(logs, steps, history=history, most=max(4, _PROBE // steps))
    # a guessed start is surer than its covariance says: draws from that would scramble too much
    drawn = predictor.colliding and pieces.uncertainty is None
    generator = np.random.default_rng(0) if drawn else None
    white = whitening(predictor, pieces, parameters_at(prior, z), noise, generator=generator)
    if white.curvature > _BENT:
        return -np.inf
    objective = Objective(predictor, prior, pieces, white)
    points = [Point(z), *(Point(z, {unit: 0.1 * unit.high}) for unit in units)]
    signatures = _signatures(objective, points)
    if white.curvature > _STRAIGHT and pieces.uncertainty is None:
        root = start_noise(predictor, pieces, noise)
        other = _signatures(objective, points, drawn_starts(root, 1, np.random.default_rng(0)))
        if _alike(signatures, other) < _SURVIVES:
            return -np.inf
    change = (signatures**2).sum((1, 2))
    per_row = change * (sum(len(log) for log in logs) / (len(pieces) * steps))
    return float(np.log1p(per_row).sum())


def _signatures(
    objective: Objective, points: Sequence[Point], offset: Array | None = None
) -> Array:
    """Return by how much innovations differ from those of the first point, ``(P - 1, S, KC)``.

    Args:
        objective: Evaluates.
        points: The first without effects.
        offset: Of the start states, ``(1, S, 2 nv)``.
    """
    moved = objective(points, None if offset is None else np.repeat(offset, len(points), 0))
    return moved[1:] - moved[0]


def _alike(signatures: Array, others: Array) -> float:
    """Return the usual correlation of signatures of the same effects; 1 where none shows."""
    one, other = (np.sqrt((some**2).sum((1, 2))) for some in (signatures, others))
    seen = np.minimum(one, other) > 1.0  # noise
    if not seen.any():
        return 1.0
    both = (signatures * others).sum((1, 2))[seen]
    return float(np.median(both / (one * other)[seen]))
