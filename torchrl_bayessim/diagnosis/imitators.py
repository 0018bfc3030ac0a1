"""Effects that would change what an explanation changes, beside parameters that move elsewhere.

A payload on a driven link is, beside a damping, a motor that is too weak. Where one of the two was
found, the other needs other parameters, and from those of the nominal fit it may look like nothing.
"""

from __future__ import annotations

__all__ = ["imitators"]

import numpy as np
from numpy.typing import NDArray

from .model import Model
from .objective import Point, Unit
from .refit import with_prior
from .screening import Screen

Array = NDArray[np.float64]
_UNLIKE = 0.1  # of the change beyond parameters: what an imitator may not make
_ALONE = 1e-9  # of a change: what parameters cannot do of it, for it to be anything


def imitators(start: Model, best: Model, first: Screen, *, most: int) -> list[Point]:
    r"""Return where to begin with other effects that would do what the best model's do.

    With the derivatives :math:`J` by parameters, :math:`M = I - QQ^T` for an orthonormal basis
    :math:`Q` of them, the best model's change :math:`d` of the innovations and that of a unit in
    the screen :math:`c`, those with :math:`\cos^2(Mc, Md) > 0.9`, at the amplitude
    :math:`a = (Mc)^T Md / |Mc|^2`, beside the parameters that make up for :math:`d - a c`.

    Args:
        start: Parameters alone.
        best: An explanation.
        first: All units, compared with the parameters alone.
        most: How many effects, the most alike first.
    """
    # all were compared on every so many of the segments, few on all
    part = start.fit.spread(round(float(first.growth.max(initial=1.0)) ** 2))
    before, size = start.fit.take(part), len(start.fit.point.z)
    change = (best.fit.innovations[part] - before.innovations).ravel()
    jacobian = before.jacobian[:, :size]
    basis = np.linalg.qr(jacobian)[0]
    wanted = change - basis @ (basis.T @ change)
    alike: list[tuple[float, Unit, float, Array]] = []
    for unit, strength, changed in zip(first.units, first.strengths, first.changes, strict=True):
        if unit.name in best.names:
            continue
        whole = len(changed) == len(start.fit.innovations)
        other: Array = (changed[part] if whole else changed).ravel().astype(np.float64)
        own = other - basis @ (basis.T @ other)
        norm, product = float(own @ own), float(own @ wanted)
        if norm > _ALONE * float(other @ other) and product > 0:
            cosine = product**2 / (norm * float(wanted @ wanted))
            amplitude = product / norm
            alike.append((cosine, unit, amplitude * float(strength), amplitude * other))
    chosen: dict[str, Point] = {}
    for cosine, unit, level, does in sorted(alike, key=lambda found: -found[0]):
        if cosine <= 1 - _UNLIKE or len(chosen) == most:
            break
        rest = np.r_[change - does, np.zeros(size)]
        moved = np.linalg.lstsq(with_prior(jacobian, size), rest, rcond=None)[0]
        chosen.setdefault(unit.name, Point(start.fit.point.z + moved, {unit: unit.inside(level)}))
    return list(chosen.values())
