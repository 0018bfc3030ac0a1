"""From a finished search to a report: figures on the test runs, the verdict, and its reasons."""

from __future__ import annotations

__all__ = ["assemble"]

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..logs.sanity import Finding as SanityFinding
from ..logs.system import System
from .acting import acting_regime
from .candidates import candidates, concluded
from .confusion import settled
from .credit import credit_of, unit_credit, worthwhile
from .divergence import divergence_alarms, diverges_throughout
from .doubts import alike, baseless, doubts, numerical, slow, unsigned
from .experiment import experiments
from .figures import figures
from .form_fit import with_slopes_of_forms
from .found import Found
from .late_rows import late_row_alarms
from .location import location
from .model import Model
from .objective import Objective, Point, Unit
from .odd_runs import odd_run_alarms, odd_runs, run_errors, unexplained_run_alarms
from .one_cause import (
    dry_friction,
    dry_friction_alarms,
    lateness,
    lateness_alarms,
    told_together,
)
from .preparation import Prepared
from .report import Candidate, Gap, Parameter, Report
from .rollout import rollout_errors, worse_rollouts
from .scatter import Scatter
from .selection import Selection
from .shrinkage import Shrinkage
from .unsteady_offsets import unrepeated_alarms, unsteady_offset_alarms, unsteady_offsets
from .verdict import conclude
from .wavering import wavering_alarms
from .whole_runs import whole_run_alarm

Array = NDArray[np.float64]
_UNTOLD = 0.0, 1.0  # interval of a share that test runs say nothing of
_TOLD: tuple[str, ...] = "at the prior's mean", "with fitted parameters", "with the effects"


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
    selection = worthwhile(selection, prepared.sets, lasting=scatter.lasting(prepared, selection))
    credit = credit_of(selection)
    for name in sorted(credit, key=lambda name: -credit[name]):
        if name in selection.best.names:
            selection = settled(selection, name, prepared.sets, causes=partial(_number, prepared))
    offered = selection.screens[0].units
    best = with_slopes_of_forms(prepared.sets["train"], selection.best, offered)
    selection = replace(selection, best=best)
    credit, together = _causes(prepared, selection)
    points = _points(selection)
    found = Found.of(prepared, selection, scatter, credit, points=points, generator=generator)
    seen = (
        *candidates(selection, found.confused, system.robot, alpha),
        *scatter.candidates(system.robot),
    )
    parameters = _parameters(system, prepared, selection)
    credited = unit_credit(selection, credit) | scatter.credited(found.effects, system.robot)
    where, remainder = _locations(prepared, selection, credited, found.confused)
    rollouts = rollout_errors(prepared, points)
    units = _every_unit(selection, scatter)
    errors = run_errors(prepared.sets, prepared.logs, best.fit.point)
    by_integration = numerical(found.effects, system.robot)
    verdict, summary, more, validated = conclude(
        system,
        prepared,
        selection=selection,
        measured=found.measured,
        effects=found.effects,
        candidates=seen,
        confused=found.confused,
        scattered=scatter.groups,
        where=where,
        diverges=diverges_throughout(rollouts),
        odd=odd_runs(errors),
        baseless=bool(by_integration) or baseless(found.effects, units),
        doubts=[
            *doubts(found.effects, units, prepared),
            *alike(best.units, system.robot),
            *slow(best.units, system.robot),
            *unsigned(best, prepared),
            *unrepeated_alarms(best, prepared.sets["train"].segments, together),
            *worse_rollouts(rollouts),
        ],
        alpha=alpha,
    )
    found = _on_validation(found, credit, validated)
    if verdict == "none":
        more += whole_run_alarm(prepared, points["refit"])
        more += unexplained_run_alarms(
            run_errors(prepared.sets, prepared.logs, selection.nominal.fit.point)
        )
    if verdict == "unknown":
        more += late_row_alarms(prepared.sets["train"], selection.nominal.fit)
    if verdict in {"none", "unknown", "not_testable"}:
        # what little was tried is among the candidates
        found = replace(found, effects=(), strengths={}, confused=())
    elif credit:
        first = max(credit, key=credit.__getitem__)
        rules = acting_regime(prepared, best.fit.point, first)
        if rules:
            where |= {"regimes": [asdict(rule) for rule in rules], "regimes_of": first}
        more += wavering_alarms(best, prepared.sets["train"].segments)
        more += [
            *unsteady_offset_alarms(together),
            *dry_friction_alarms(best, together, system.robot),
            *lateness_alarms(best, together, system.robot),
        ]
    names, measured = {effect.name for effect in found.effects}, found.measured
    left = measured.effects if names else measured.refit
    seen = concluded(seen, verdict, names | together.keys() if names else names, left=left)
    told = dict(zip(_TOLD[: 2 + bool(best.units)], points.values(), strict=False))
    alarms = [
        *prepared.alarms,
        *(str(f) for f in findings),
        *_absorbed(parameters),
        *(odd_run_alarms(errors) if verdict != "none" else ()),
        *by_integration,
        *divergence_alarms(prepared.sets["test"], told),
        *more,
    ]
    return Report(
        verdict=verdict,
        summary=summary,
        effects=found.effects,
        confusion_set=found.confused,
        where=where,
        remainder=remainder,
        gap=_gap(found.measured, prepared, rollouts, validated=validated),
        candidates=seen,
        parameters=parameters,
        alarms=tuple(alarms),
        next_experiment=experiments(
            prepared, selection, found.confused, _not_excited(selection, seen), generator=generator
        ),
        audit=_audit(system, prepared, selection, begun=begun),
        strengths=found.strengths,
        figures=figures(prepared, selection, found.measured),
    )


def _causes(prepared: Prepared, selection: Selection) -> tuple[dict[str, float], dict[str, str]]:
    """Return the credit of each cause, and the effects that are told with another's name."""
    best, robot = selection.best, prepared.predictor.system.robot
    credit = credit_of(selection)
    together = unsteady_offsets(best, prepared.sets["train"].segments, robot)
    together |= dry_friction(best, credit, robot) | lateness(best, robot)
    return told_together(credit, together), together


def _number(prepared: Prepared, model: Model) -> int:
    """Return of how many causes a model is: an offset and its change are one."""
    segments, robot = prepared.sets["train"].segments, prepared.predictor.system.robot
    return len(model.names) - len(unsteady_offsets(model, segments, robot))


def _every_unit(selection: Selection, scatter: Scatter) -> list[Unit]:
    return [*selection.screens[0].units, *(chance.unit for chance in scatter.found)]


def _points(selection: Selection) -> dict[str, Point]:
    """Return the simulator at the prior's mean, with fitted parameters, and with effects."""
    nominal = selection.nominal.fit.point
    zero = Point(np.zeros_like(nominal.z))
    return {"raw": zero, "refit": nominal, "with_effects": selection.best.fit.point}


def _absorbed(parameters: Sequence[Parameter]) -> list[str]:
    return [
        f"{p.name} was fitted to {p.without_effects:.3g}, at the edge of its prior "
        f"[{p.prior[0]:.3g}, {p.prior[1]:.3g}]: an effect is being absorbed by parameters, or the "
        "prior is too narrow"
        for p in parameters
        if p.at_bound
    ]


def _on_validation(found: Found, credit: Mapping[str, float], explained: float | None) -> Found:
    """Return what was found with shares by credit, where validation runs say what it explains."""
    each = [credit.get(effect.name, 0.0) for effect in found.effects]
    if explained is None or sum(each) <= 0:
        return found
    shares = [explained * part / sum(each) for part in each]
    parts = zip(found.effects, shares, strict=True)
    return replace(found, effects=tuple(replace(e, share_of_gap=share) for e, share in parts))


def _gap(
    measured: Shrinkage,
    prepared: Prepared,
    rollouts: Mapping[str, Any],
    *,
    validated: float | None,
) -> Gap:
    told = validated is None
    return Gap(
        horizon_steps=prepared.horizon,
        raw=measured.raw,
        refit=measured.refit,
        with_effects=measured.effects,
        floor=1.0,
        explained_fraction=measured.explained if told else validated,
        ci95=measured.elsewhere if told else _UNTOLD,
        by_parameters=measured.by_parameters,
        rollout_rmse=rollouts,
    )


def _audit(
    system: System, prepared: Prepared, selection: Selection, *, begun: float
) -> dict[str, Any]:
    return {
        **{name: list(names) for name, names in prepared.names.items()},
        "mode": prepared.mode.name,
        "simulator_steps": prepared.predictor.steps,
        "noise_floor_source": prepared.noise_source,
        "noise": dict(zip(system.robot.channels, prepared.noise.tolist(), strict=True)),
        "segments": {name: len(o.segments) for name, o in prepared.sets.items()},
        "p_values": list(selection.p_values),
        "seconds": time.perf_counter() - begun,
    }


def _not_excited(selection: Selection, candidates: Sequence[Candidate]) -> list[Unit]:
    """Return the units of effects that the data could have shown nowhere, at all targets first."""
    excited = {c.name for c in candidates if c.status != "not_excited"}
    units = dict.fromkeys(replace(u, onset=0.0) for u in selection.screens[0].units)
    return sorted((u for u in units if u.name not in excited), key=lambda u: u.where != "all")


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
    prepared: Prepared,
    selection: Selection,
    found: Mapping[Unit, float],
    confused: Sequence[str],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return where the error sits before the effects, and after them."""
    train, judged = prepared.sets["train"], prepared.sets["validation"]

    def left(model: Model) -> tuple[tuple[Objective, Array], tuple[Objective, Array]]:
        point = model.fit.point
        return (train, _raw(train, point)), (judged, _raw(judged, point))

    before = location(*left(selection.nominal), selection.screens[0], found, confused=confused)
    after = location(*left(selection.best), selection.screens[-1], {})
    return before, after


def _raw(objective: Objective, point: Point) -> Array:
    return objective.raw([point])[0]
