"""How many control steps a segment has: as many as show the effects best."""

from __future__ import annotations

__all__ = ["chosen_horizon"]

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import Effect
from ..logs.log import Log
from .objective import Objective, Point, Unit, origin, parameters_at
from .prediction import Predictor
from .segments import cut_for_fits
from .whitening import whitening

Array = NDArray[np.float64]
_LADDER = (3, 10, 20, 40, 80, 160)
_LARGEST, _LARGEST_UNSURE = 0.2, 0.4  # of the median log's length
_UNSURE = 20  # the least where start states were estimated
_FILTERED = 10  # where the depth of contacts was
_PROBE = 100  # control steps on which horizons are compared
_WORTH = 0.2  # nats per effect that a longer horizon must bring


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
    range, as long as second differences stay below first ones. Where start states were estimated,
    few steps hardly say how a segment began, and nothing else; nor where contacts were.
    """
    prior = predictor.system.prior
    z = origin(prior)
    usual: dict[str, Effect] = {}  # of its forms the first
    for unit in units:
        usual.setdefault(unit.name, unit.effect)
    units = list({u.name: u for u in units if u.effect == usual[u.name]}.values())
    typical = float(np.median([len(log) for log in logs]))
    guessed = any(log.uncertainty is not None for log in logs)
    filtered = any(log.touching is not None for log in logs)
    least = _UNSURE if guessed else _FILTERED if filtered else 0
    ladder = [steps for steps in _LADDER if steps >= least]
    best, choice = -np.inf, ladder[0]
    for steps in ladder:
        if steps > typical * (_LARGEST_UNSURE if guessed else _LARGEST):
            break
        pieces = cut_for_fits(logs, steps, history=history, most=max(4, _PROBE // steps))
        white = whitening(predictor, pieces, parameters_at(prior, z), noise)
        if white.curvature > 1.0 and np.isfinite(best):
            break
        objective = Objective(predictor, prior, pieces, white)
        points = [Point(z), *(Point(z, {unit: 0.1 * unit.high}) for unit in units)]
        innovations = objective(points)
        change = ((innovations[1:] - innovations[0]) ** 2).sum((1, 2))
        per_row = change * (sum(len(log) for log in logs) / (len(pieces) * steps))
        value = float(np.log1p(per_row).sum())
        if value > best + _WORTH * len(units):
            best, choice = value, steps
    return choice
