r"""Whether strengths that waver would do what a further effect does.

A real bias wanders with temperature, and dry friction differs from run to run. What a constant
strength leaves of that is slow, and a slow effect, such as a drift of a sensor, mends some of it
without being there. So before an effect is added, what the base leaves, :math:`r`, is explained by
the strengths that are there already, each free to differ by run and to drift in it,

.. math::
    \min_{z, \delta} \|r + J z + \sum_{u, l, k} \delta_{ulk}\, b_{lk} \odot c_u\|^2 + \|z\|^2
    + \|\delta\|^2 / \sigma^2,

with :math:`c_u` what unit :math:`u` changes altogether, :math:`b_{lk}` the run :math:`l` of a
segment times its place in it to the power :math:`k = 0, 1`, and :math:`\sigma = 0.3` of a strength.
If that leaves no more than the further effect does, by what the numbers cost, the effect is not
needed: what remains lies in strengths that are not constant (random coefficients, Swamy 1970).
"""

from __future__ import annotations

__all__ = ["waver", "wavering_alarms"]

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .cells import plain
from .model import WHITE, Model, price
from .objective import Unit
from .refit import Fit, with_prior
from .segments import Segments

Array = NDArray[np.float64]
_PART = 0.3  # standard deviation of a strength that wavers, of itself
_POWERS = 2  # of time in a run: a constant, and a trend
_MOST = 0.5  # of what remains


def waver(base: Model, better: Model, segments: Segments) -> bool:
    """Return whether the base with strengths that waver explains as much as a better model.

    Args:
        base: With the effects that there are already.
        better: With further ones.
        segments: The training segments, of both.
    """
    if not base.units or len(base.fit.innovations) != len(segments):
        return False
    loose, scale = _loose(base.fit, base.units, segments), better.dispersion()
    left, _ = _left(base.fit, loose, scale)
    more = _numbers(loose) - (len(better.units) - len(base.units))
    return left + scale * price(base) * more < better.fit.cost


def wavering_alarms(model: Model, segments: Segments) -> list[str]:
    """Return an alarm if most of what a model leaves is due to one strength that wavers.

    Args:
        model: With the effects that were found.
        segments: The training segments.
    """
    fit, beyond = model.fit, model.fit.misfit - model.fit.innovations.size
    if model.mean_square < WHITE or len(fit.innovations) != len(segments) or beyond <= 0:
        return []
    texts: dict[float, str] = {}
    for unit in model.units:
        size = float(np.mean(fit.change(unit) ** 2))
        if size == 0:  # one of several joints that does nothing
            continue
        loose = _loose(fit, [unit], segments)
        left, part = _left(fit, loose, 1.0)
        share = (fit.cost - left - price(model) * _numbers(loose)) / beyond
        spread = float(np.sqrt(np.mean((loose @ part) ** 2) / size))
        texts[share] = (
            f"{plain(unit.name)} at {unit.where} seems to vary by {100 * spread:.0f} % of itself, "
            f"from run to run or within runs: that explains {100 * min(share, 1):.0f} % of what "
            "remains"
        )
    most = max(texts, default=0.0)
    return [texts[most]] if most > _MOST else []


def _left(fit: Fit, loose: Array, scale: float) -> tuple[float, Array]:
    """Return the cost that strengths which waver leave, and by how many deviations they do."""
    size, count = len(fit.point.z), loose.shape[1]
    jacobian = with_prior(fit.jacobian, size)
    moved = np.r_[loose, np.zeros((size, count))]
    held = np.c_[np.zeros((count, jacobian.shape[1])), np.eye(count)]
    columns = np.r_[np.c_[jacobian, moved], held * np.sqrt(scale)]
    target = np.r_[fit.innovations.ravel(), fit.point.z, np.zeros(count)]
    step, *_ = np.linalg.lstsq(columns, -target, rcond=1e-9)
    return float(((target + columns @ step) ** 2).sum()), step[-count:]


def _numbers(loose: Array) -> int:
    return int(np.linalg.matrix_rank(loose))


def _loose(fit: Fit, units: Sequence[Unit], segments: Segments) -> Array:
    """Return what it changes if a strength is off in one run, or drifts there, ``(S·KC, N)``."""
    basis = []
    for log in np.unique(segments.log):
        there = segments.log == log
        place = segments.start - segments.start[there].mean()
        place = place / max(np.abs(place[there]).max(), 1.0)
        basis += [there * place**power for power in range(_POWERS)]
    changes = [fit.change(unit).reshape(fit.innovations.shape) for unit in units]
    columns = [(part[:, None] * change).ravel() for change in changes for part in basis]
    return _PART * np.stack(columns, -1)
