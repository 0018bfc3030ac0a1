"""From a finished search to a report: figures on the test runs, the verdict, and its reasons."""

from __future__ import annotations

__all__ = ["assemble"]

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import Effect
from ..effects.robot import Robot
from ..effects.sensors import SensorDropout
from ..effects.units import unit_at
from ..logs.sanity import Finding as SanityFinding
from ..logs.system import System
from .confusion import confusion_set, settled
from .divergence import divergence_alarms
from .experiment import experiments
from .figures import figures
from .location import location
from .model import Model
from .objective import Objective, Point, Unit, strengths_of
from .preparation import Prepared
from .refit import Fit
from .report import Candidate, Finding, Gap, Parameter, Report
from .rollout import rollout_errors
from .scatter import Scatter
from .screening import Screen
from .selection import Selection
from .shrinkage import Shrinkage, shares, shrinkage
from .verdict import conclude

Array = NDArray[np.float64]
_UNTESTED = 0.2  # of an effect's range that does nothing in these data


def assemble(
    system: System,
    *,
    prepared: Prepared,
    selection: Selection,
    scatter: Scatter,
    findings: Sequence[SanityFinding],
    generator: np.random.Generator,
    begun: float,
    alpha: float,
) -> Report:
    """Return the report.

    Args:
        system: The robot.
        prepared: Split, noise, horizon, nominal fit.
        selection: What the search found.
        scatter: What was found of effects of chance.
        findings: Of the sanity gate.
        generator: Of the bootstrap.
        begun: When the diagnosis began, by ``time.perf_counter``.
        alpha: Level of the tests.
    """
    test = prepared.sets["test"]
    credit = _credit(selection)
    if credit:
        selection = settled(selection, max(credit, key=credit.__getitem__), prepared.sets)
    best, nominal = selection.best, selection.nominal
    zero = Point(np.zeros_like(nominal.fit.point.z))
    points = [zero, nominal.fit.point, best.fit.point]
    measured = shrinkage(
        test,
        points,
        generator,
        floor=_floor(selection, prepared.sets),
        beside=prepared.sets["validation"],
    )
    credit = _credit(selection)
    confused = confusion_set(selection, max(credit, key=credit.__getitem__)) if credit else ()
    alarms = [*prepared.alarms, *(str(f) for f in findings)]
    parameters = _parameters(system, prepared, selection)
    alarms += [
        f"{p.name} was fitted to {p.without_effects:.3g}, at the edge of its prior "
        f"[{p.prior[0]:.3g}, {p.prior[1]:.3g}]: an effect is being absorbed by parameters"
        for p in parameters if p.at_bound
    ]  # fmt: skip
    rollouts = rollout_errors(
        prepared, {"raw": zero, "refit": nominal.fit.point, "with_effects": best.fit.point}
    )
    effects = _effects(selection, credit, measured, system.robot)
    strengths = _by_target(best.fit.point, system.robot)
    if scatter.beside:
        alone, measured = measured.explained, scatter.measured(measured, generator)
        effects += scatter.findings(measured, system.robot, others=alone)
        strengths |= scatter.strengths(system.robot)
    elif scatter.found:
        measured, confused = scatter.measured(measured, generator), scatter.names
        effects = scatter.findings(measured, system.robot)
        strengths = scatter.strengths(system.robot)
    if scatter.holds:
        measured = scatter.with_holds(measured)
        others = sum(effect.share_of_gap for effect in effects)
        held = scatter.held_findings(measured, others)
        effects, confused = (*effects, *held), confused or tuple(f.name for f in held)
        strengths |= {SensorDropout(): dict(held[0].strengths)}
    candidates = (*_candidates(selection, confused, alpha), *scatter.candidates())
    gap = Gap(
        horizon_steps=prepared.horizon,
        raw=measured.raw,
        refit=measured.refit,
        with_effects=measured.effects,
        floor=1.0,
        explained_fraction=measured.explained,
        ci95=measured.elsewhere,
        by_parameters=(measured.raw - measured.refit) / max(measured.raw - 1.0, 1e-9),
        rollout_rmse=rollouts,
    )
    where, remainder = _locations(prepared, selection, credit)
    named = ["as described", "with fitted parameters", "with the effects"][: 2 + bool(best.units)]
    alarms += divergence_alarms(test, dict(zip(named, points, strict=False)))
    verdict, summary, more = conclude(
        system,
        prepared,
        selection=selection,
        measured=measured,
        effects=effects,
        candidates=candidates,
        confused=confused,
        scattered=scatter.groups,
        where=where,
        alpha=alpha,
    )
    if verdict in {"none", "unknown", "not_testable"}:
        effects, confused = (), ()  # what little was tried is among the candidates
    return Report(
        verdict=verdict,
        summary=summary,
        effects=effects,
        confusion_set=confused,
        where=where,
        remainder=remainder,
        gap=gap,
        candidates=candidates,
        parameters=parameters,
        alarms=(*alarms, *more),
        next_experiment=experiments(
            prepared, selection, confused, _not_excited(selection, candidates), generator=generator
        ),
        audit={
            **{name: list(names) for name, names in prepared.names.items()},
            "mode": prepared.mode.name,
            "simulator_steps": prepared.predictor.steps,
            "noise_floor_source": prepared.noise_source,
            "noise": dict(zip(system.robot.channels, prepared.noise.tolist(), strict=True)),
            "segments": {name: len(o.segments) for name, o in prepared.sets.items()},
            "p_values": list(selection.p_values),
            "seconds": time.perf_counter() - begun,
        },
        strengths=strengths if effects else {},
        figures=figures(prepared, selection, measured),
    )


def _floor(selection: Selection, sets: Mapping[str, Objective]) -> float:
    """Return the mean squared innovation that a perfect simulator leaves, at most 1.

    Known where effects were found: what the best model leaves of the runs that it was found on.
    """
    best = selection.best
    if not best.units:
        return 1.0
    parts = (best.fit.innovations, sets["train"]), (best.validation, sets["validation"])
    left = sum(float((one**2).sum()) for one, _ in parts)
    size = sum(float((o.whitening.weights**2).sum()) * one.shape[1] for one, o in parts)
    return min(left / size, 1.0)


def _not_excited(selection: Selection, candidates: Sequence[Candidate]) -> list[Unit]:
    """Return the units of effects that the data could have shown nowhere, at all targets first."""
    excited = {c.name for c in candidates if c.status != "not_excited"}
    units = dict.fromkeys(replace(u, onset=0.0) for u in selection.screens[0].units)
    return sorted((u for u in units if u.name not in excited), key=lambda u: u.where != "all")


def _by_target(point: Point, robot: Robot) -> dict[Effect, dict[str, float]]:
    """Return strengths by effect and name of the target, zeros left out."""
    return {
        effect: {
            name: float(s) for name, s in zip(effect.targets(robot), strength[0], strict=True) if s
        }
        for effect, strength in strengths_of([point], robot).items()
    }


def _credit(selection: Selection) -> dict[str, float]:
    """Return each effect's share of the deviance that all of them remove, over all orders."""
    names = list(dict.fromkeys(u.name for u in selection.best.units))
    full = float(selection.best.deviances().sum())
    none = float(selection.nominal.deviances().sum())
    if not names or none <= full:
        return dict.fromkeys(names, 0.0)
    known = {frozenset(names): full, frozenset[str](): none}
    for model in selection.tried:
        inside = frozenset(u.name for u in model.units)
        if inside and inside < frozenset(names) and set(model.units) <= set(selection.best.units):
            known[inside] = min(known.get(inside, np.inf), float(model.deviances().sum()))

    def value(some: frozenset[str]) -> float:
        if some in known:
            return (none - known[some]) / (none - full)
        smaller = [known[other] for other in known if other <= some]
        return (none - min(smaller)) / (none - full)

    return shares(names, value)


def _strength_errors(fit: Fit, dispersion: float, size: int) -> dict[Unit, float]:
    covariance = fit.covariance(dispersion)
    deviations = np.sqrt(np.maximum(np.diag(covariance)[size:], 0.0))
    return {u: float(d * (u.high - u.onset)) for u, d in zip(fit.units, deviations, strict=True)}


def _effects(
    selection: Selection, credit: Mapping[str, float], measured: Shrinkage, robot: Robot
) -> tuple[Finding, ...]:
    """Return the effects of the best model, units of one effect together."""
    best = selection.best
    size = len(best.fit.point.z)
    errors = _strength_errors(best.fit, best.dispersion(), size)
    found = []
    for name in dict.fromkeys(u.name for u in best.units):
        units = [u for u in best.units if u.name == name]
        strengths = [u.actual(best.fit.point.strengths[u]) for u in units]
        mean = float(np.mean(strengths))
        error = float(np.sqrt(np.sum([errors[u] ** 2 for u in units])) / len(units))
        found.append(
            Finding(
                name=name,
                where=units[0].where if len({u.where for u in units}) == 1 else "all",
                strength=mean,
                unit=unit_at(units[0].effect, robot, int(np.argmax(units[0].direction))),
                ci95=(mean - 1.96 * error, mean + 1.96 * error),
                p_value=selection.p_values[0],
                share_of_gap=max(0.0, credit.get(name, 0.0) * measured.explained),
                strengths={u.where: s for u, s in zip(units, strengths, strict=True)},
            )
        )
    return tuple(sorted(found, key=lambda f: -f.share_of_gap))


def _candidates(
    selection: Selection, confused: Sequence[str], alpha: float
) -> tuple[Candidate, ...]:
    """Return what the data say about every unit."""
    seen = selection.screens[0]
    dispersion = max(1.0, float((selection.nominal.fit.innovations**2).mean()))
    strongest, detectable = seen.best(1.0), seen.detectable(alpha)
    fitted = {m.units[0]: m for m in selection.tried if len(m.units) == 1}
    used = set(selection.best.units)
    excess = max(seen.residual - seen.effective, 1e-9)
    growth = dict(zip(seen.units, (seen.growth**2).tolist(), strict=True))
    swallowed: dict[Unit, float] = {}
    for unit, share in zip(seen.units, seen.swallowed.tolist(), strict=True):
        swallowed[unit] = max(swallowed.get(unit, 0.0), share)
    result = []
    likely = sorted(strongest, key=lambda unit: (unit not in used, unit not in fitted))
    forms = {str(unit): unit for unit in reversed(likely)}  # one law of each name and place
    for unit, (ratio, strength) in strongest.items():
        if forms[str(unit)] is not unit:
            continue
        model, ci, gain = fitted.get(unit), None, None
        strength = unit.actual(strength)  # noqa: PLW2901
        if model is not None:
            strength = unit.actual(model.fit.point.strengths[unit])  # noqa: PLW2901 - knows better
            error = _strength_errors(model.fit, model.dispersion(), len(model.fit.point.z))[unit]
            ci = (strength - 1.96 * error, strength + 1.96 * error)
            before = float((selection.nominal.validation**2).sum())
            gain = before - float((model.validation**2).sum())
        least = detectable[unit]
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
                minimal_detectable_strength=unit.actual(least) if np.isfinite(least) else None,
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


def _parameters(system: System, prepared: Prepared, selection: Selection) -> tuple[Parameter, ...]:
    """Return the parameters before and after the effects."""
    if system.prior is None:
        return ()
    objective = prepared.sets["train"]
    alone, together = selection.nominal.fit, selection.best.fit
    size = objective.size
    covariance = together.covariance(selection.best.dispersion())[:size, :size]
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    edge = np.sqrt(3.0)
    low = objective.theta(np.full(size, -edge))
    high = objective.theta(np.full(size, edge))
    first, last = objective.theta(alone.point.z), objective.theta(together.point.z)
    spread = objective.theta(together.point.z + 1e-3) - objective.theta(together.point.z - 1e-3)
    return tuple(
        Parameter(
            name=name,
            prior=(float(low[i]), float(high[i])),
            without_effects=float(first[i]),
            with_effects=float(last[i]),
            sd=float(deviations[i] * abs(spread[i]) / 2e-3),
            at_bound=bool(abs(alone.point.z[i]) > 0.98 * edge),
        )
        for i, name in enumerate(system.prior.names)
    )


def _locations(
    prepared: Prepared, selection: Selection, credit: Mapping[str, float]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return where the error sits before the effects, and after them."""
    train, judged = prepared.sets["train"], prepared.sets["validation"]
    found = _unit_credit(selection, credit)

    def where(model: Model, seen: Screen, gains: Mapping[Unit, float]) -> dict[str, Any]:
        point = model.fit.point
        return location((train, _raw(train, point)), (judged, _raw(judged, point)), seen, gains)

    before = where(selection.nominal, selection.screens[0], found)
    after = where(selection.best, selection.screens[-1], {})
    return before, after


def _unit_credit(selection: Selection, credit: Mapping[str, float]) -> dict[Unit, float]:
    best = selection.best
    counts = {name: sum(u.name == name for u in best.units) for name in credit}
    return {u: max(credit.get(u.name, 0.0), 0.0) / counts[u.name] for u in best.units}


def _raw(objective: Objective, point: Point) -> Array:
    return objective.raw([point])[0]
