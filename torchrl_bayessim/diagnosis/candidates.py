"""What the data say about every effect at every place, found or not."""

from __future__ import annotations

__all__ = ["candidates", "concluded", "strength_errors"]

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..effects.robot import Robot
from .objective import Unit
from .refit import Fit
from .report import Candidate, Verdict
from .selection import Selection
from .validation import SHOWN

_UNTESTED = 0.2  # of an effect's range that does nothing in these data


def candidates(
    selection: Selection, confused: Sequence[str], robot: Robot, alpha: float
) -> tuple[Candidate, ...]:
    """Return what the data say about every unit."""
    seen = selection.screens[0]
    dispersion = max(1.0, selection.nominal.fit.mean_square)
    used = set(selection.best.units)
    # what got another frequency in a later round is the same unit of the first
    later = {str(unit): unit for unit in used - set(seen.units)}
    same = {unit: later.get(str(unit), unit) for unit in seen.units}
    strongest: dict[Unit, tuple[float, float]] = {}
    for unit, value in seen.best(1.0).items():  # the strongest first
        strongest.setdefault(same[unit], value)
    # what is ruled out is ruled out in every form
    hardest: dict[str, tuple[float, Unit]] = {}
    for unit, value in seen.detectable(alpha).items():
        known, form = hardest.get(str(unit), (0.0, unit))
        if unit.actual(value) >= form.actual(known):
            hardest[str(unit)] = value, unit
    detectable = {unit: hardest[str(unit)] for unit in same.values()}
    fitted = {m.units[0]: m for m in selection.tried if len(m.units) == 1}
    excess = max(seen.residual - seen.effective, 1e-9)
    units = [same[unit] for unit in seen.units]
    growth = dict(zip(units, (seen.growth**2).tolist(), strict=True))
    swallowed: dict[Unit, float] = {}
    for unit, share in zip(units, seen.swallowed.tolist(), strict=True):
        swallowed[unit] = max(swallowed.get(unit, 0.0), share)
    result = []
    likely = sorted(strongest, key=lambda unit: (unit not in used, unit not in fitted))
    forms = {str(unit): unit for unit in reversed(likely)}  # one law of each name and place
    for unit, (ratio, strength) in strongest.items():
        if forms[str(unit)] is not unit:
            continue
        model, ci, gain = fitted.get(unit), None, None
        at = selection.best if unit in used else model  # beside the others, as it is named
        strength = unit.actual(strength)  # noqa: PLW2901
        if at is not None:
            strength = unit.actual(at.fit.point.strengths[unit])  # noqa: PLW2901 - knows better
            error = strength_errors(at.fit, at.dispersion(), len(at.fit.point.z))[unit]
            ci = (strength - 1.96 * error, strength + 1.96 * error)
        if model is not None:
            before = float((selection.nominal.validation**2).sum())
            gain = before - float((model.validation**2).sum())
            # a bent fit hides from its derivatives what a fit of the effect then shows
            ratio = max(ratio, selection.nominal.fit.misfit - model.fit.misfit)  # noqa: PLW2901
        least, hidden = detectable[unit]
        result.append(
            Candidate(
                name=unit.name,
                where=unit.where,
                strength=strength,
                ci95=ci,
                likelihood_ratio=ratio,
                p_value=float(min(1.0, len(detectable) * np.exp(-ratio / dispersion / 2))),
                held_out_gain=gain,
                explained_fraction=float(np.clip(ratio * growth[unit] / excess, 0.0, 1.0)),
                explained_by_parameters=swallowed[unit],
                minimal_detectable_strength=hidden.actual(least) if np.isfinite(least) else None,
                form=unit.effect.form,
                unit=unit.measured_in(robot),
                status=_status(
                    unit,
                    used,
                    confused,
                    ratio=ratio / dispersion,
                    least=least,
                    inside=swallowed[unit],
                ),
            )
        )
    return tuple(sorted(result, key=lambda c: -c.likelihood_ratio))


def concluded(
    seen: Sequence[Candidate], verdict: Verdict, named: Collection[str], *, left: float
) -> tuple[Candidate, ...]:
    """Return candidates as a verdict leaves them.

    Only what it names is named. Where it leaves more than noise nothing is ruled out: what else is
    missing may be just what hides an effect. Where there is no gap nothing explains it.

    Args:
        seen: What the data say of each alone.
        verdict: The verdict.
        named: Names of its effects.
        left: Mean squared innovation with these.
    """
    hides = verdict != "none" and left > SHOWN
    result = []
    for one in seen:
        changes: dict[str, Any] = {}
        if one.status == "named" and one.name not in named:
            changes["status"] = "rejected"
        if hides and one.status != "named":
            changes["minimal_detectable_strength"] = None
            if one.status == "ruled_out":
                changes["status"] = "rejected"
        if verdict in {"none", "not_testable"}:
            changes["explained_fraction"] = 0.0
        result.append(replace(one, **changes))
    return tuple(result)


def _status(
    unit: Unit,
    used: set[Unit],
    confused: Sequence[str],
    *,
    ratio: float,
    least: float,
    inside: float,
) -> Any:
    if unit in used:
        return "named"
    if unit.name in confused or inside > 0.98:
        return "confounded"
    if not np.isfinite(least) or least > unit.high or unit.onset > _UNTESTED * unit.high:
        return "not_excited"
    return "rejected" if ratio > 12 else "ruled_out"


def strength_errors(fit: Fit, dispersion: float, size: int) -> dict[Unit, float]:
    """Return the standard error of each strength, beside ``size`` parameters."""
    covariance = fit.covariance(dispersion)
    deviations = np.sqrt(np.maximum(np.diag(covariance)[size:], 0.0))
    result = {}
    for unit, deviation in zip(fit.units, deviations * [u.high for u in fit.units], strict=True):
        between = abs(fit.point.strengths[unit]) + deviation / 2  # at 0 a power has no slope
        result[unit] = float(deviation * unit.slope(between))
    return result
