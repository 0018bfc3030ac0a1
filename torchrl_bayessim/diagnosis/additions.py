"""What may be added to an explanation: single units, pairs, one effect at several targets.

All from the correlations of a screen, without a simulation.
"""

from __future__ import annotations

__all__ = ["groups", "one_for_all", "pairs", "singles"]

import numpy as np
from scipy.optimize import nnls

from ..effects.effect import Effect
from ..effects.transmission import ServoGain
from .objective import Unit
from .screening import Screen

_PAIRS, _GROUPS = 4, 3  # at most


def singles(seen: Screen) -> list[dict[Unit, float]]:
    """Return each effect at its best place, and at all of its targets together."""
    best = seen.best(1.0)
    chosen: dict[tuple[Effect, bool], Unit] = {}
    for unit in best:
        if best[unit][0] > 2.0:
            chosen.setdefault((unit.effect, unit.where == "all"), unit)
    return [{unit: best[unit][1]} for unit in chosen.values()]


def pairs(seen: Screen) -> list[dict[Unit, float]]:
    """Return the pairs of different effects that explain most together."""
    usable = np.flatnonzero((seen.norms > 0) & (seen.growth == seen.growth.min(initial=np.inf)))
    scores, norms = seen.scores[usable], seen.norms[usable]
    cosine = seen.correlation[np.ix_(usable, usable)]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (1 - cosine**2)
        first = (scores[:, None] - cosine * scores[None]) * inverse
        second = first.T
        gain = first * scores[:, None] + second * scores[None]
    names = np.array([seen.units[i].name for i in usable])
    alike = names[:, None] == names[None]
    gain[(first <= 0) | (second <= 0) | (np.abs(cosine) > 0.98) | alike] = -np.inf
    gain[np.tril_indices(len(gain))] = -np.inf
    found: list[dict[Unit, float]] = []
    taken: set[frozenset[Unit]] = set()
    for flat in np.argsort(-gain, axis=None)[:400]:
        i, j = np.unravel_index(flat, gain.shape)
        if not np.isfinite(gain[i, j]) or len(found) == _PAIRS:
            break
        key = frozenset({seen.units[usable[i]], seen.units[usable[j]]})
        if key not in taken:
            taken.add(key)
            amplitudes = first[i, j] / norms[i], second[i, j] / norms[j]
            both = [(usable[i], amplitudes[0]), (usable[j], amplitudes[1])]
            found.append(
                {
                    seen.units[n]: seen.units[n].inside(
                        float(np.clip(a, 0.1, 10) * seen.strengths[n])
                    )
                    for n, a in both
                }
            )
    return found


def groups(seen: Screen) -> list[dict[Unit, float]]:
    """Return each effect at several of its targets, strengths of their own by non-negative fits.

    Gains of servos are one at all or at single ones: of either sign at each, they imitate friction.
    """
    found = []
    usable = (seen.norms > 0) & (seen.growth == seen.growth.min(initial=np.inf))
    for name in dict.fromkeys(unit.name for unit in seen.units):
        best: dict[str, int] = {}  # by target: one law of the name at each
        for i, unit in enumerate(seen.units):
            if unit.name == name and unit.where != "all" and usable[i] and not one_for_all(unit):
                known = best.setdefault(unit.where, i)
                best[unit.where] = i if seen.scores[i] > seen.scores[known] else known
        if len(best) < 2:
            continue
        rows = list(best.values())
        values, vectors = np.linalg.eigh(seen.correlation[np.ix_(rows, rows)])
        root = np.sqrt(np.maximum(values, 1e-6))
        scores = seen.scores[rows]
        amplitude, _ = nnls((vectors * root).T, vectors.T @ scores / root)
        on = {
            seen.units[i]: seen.units[i].inside(float(a / seen.norms[i] * seen.strengths[i]))
            for i, a in zip(rows, amplitude, strict=True)
            if a > 0
        }
        if len(on) > 1:
            found.append((float(amplitude @ scores) - 4 * len(on), on))
    found.sort(key=lambda pair: -pair[0])
    return [on for _, on in found[:_GROUPS]]


def one_for_all(unit: Unit) -> bool:
    """Return whether an effect has no strength of its own at each of several targets."""
    return isinstance(unit.effect, ServoGain)
