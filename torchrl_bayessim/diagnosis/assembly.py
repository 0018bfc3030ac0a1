"""From a finished search to a report: figures on the test runs, the verdict, and its reasons."""

from __future__ import annotations

__all__ = ["assemble"]

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import Effect
from ..effects.robot import Robot
from ..effects.sensors import SensorDropout
from ..effects.units import unit_at
from ..logs.sanity import Finding as SanityFinding
from ..logs.system import System
from .candidates import candidates, concluded, strength_errors
from .confusion import confusion_set, settled
from .credit import credit_of, unit_credit, worthwhile
from .divergence import divergence_alarms, diverges_throughout
from .doubts import baseless, doubts
from .experiment import experiments
from .figures import figures
from .location import location
from .model import Model, gain, needed
from .objective import Objective, Point, Unit, strengths_of
from .odd_runs import odd_run_alarms, odd_runs
from .preparation import Prepared
from .report import Candidate, Finding, Gap, Parameter, Report
from .rollout import rollout_errors, worse_rollouts
from .scatter import Scatter
from .selection import Selection
from .shrinkage import Shrinkage, shrinkage
from .verdict import conclude

Array = NDArray[np.float64]
_WORTH = 0.01  # of the gap on test runs, to name chance beside another cause


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
    selection = worthwhile(selection, prepared.sets)
    credit = credit_of(selection)
    if credit:
        selection = settled(selection, max(credit, key=credit.__getitem__), prepared.sets)
    credit, best = credit_of(selection), selection.best
    points = _points(selection)
    found = _with_chance(
        _lasting(prepared, selection, credit, points=points, generator=generator),
        scatter,
        system.robot,
        generator,
    )
    seen = (
        *candidates(selection, found.confused, system.robot, alpha),
        *scatter.candidates(system.robot),
    )
    parameters = _parameters(system, prepared, selection)
    where, remainder = _locations(prepared, selection, credit, found.confused)
    rollouts = rollout_errors(prepared, points)
    units = _every_unit(selection, scatter)
    odd = odd_runs(prepared.sets, prepared.logs, best.fit.point)
    verdict, summary, more = conclude(
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
        odd=odd,
        baseless=baseless(found.effects, units),
        doubts=doubts(found.effects, units, prepared),
        alpha=alpha,
    )
    if verdict in {"none", "unknown", "not_testable"}:
        # what little was tried is among the candidates
        found = replace(found, effects=(), strengths={}, confused=())
    names, measured = {effect.name for effect in found.effects}, found.measured
    left = measured.effects if names else measured.refit
    seen = concluded(seen, verdict, names, left=left)
    alarms = [*prepared.alarms, *(str(f) for f in findings), *_absorbed(parameters)]
    alarms += odd_run_alarms(odd)
    named = ["as described", "with fitted parameters", "with the effects"][: 2 + bool(best.units)]
    alarms += divergence_alarms(
        prepared.sets["test"], dict(zip(named, points.values(), strict=False))
    )
    if names:
        alarms += worse_rollouts(rollouts)
    return Report(
        verdict=verdict,
        summary=summary,
        effects=found.effects,
        confusion_set=found.confused,
        where=where,
        remainder=remainder,
        gap=_gap(found.measured, prepared, rollouts),
        candidates=seen,
        parameters=parameters,
        alarms=(*alarms, *more),
        next_experiment=experiments(
            prepared, selection, found.confused, _not_excited(selection, seen), generator=generator
        ),
        audit=_audit(system, prepared, selection, begun=begun),
        strengths=found.strengths,
        figures=figures(prepared, selection, found.measured),
    )


@dataclass(frozen=True)
class _Found:
    """What was found, and how far the gap shrinks with it."""

    measured: Shrinkage
    effects: tuple[Finding, ...]
    strengths: Mapping[Effect, Mapping[str, float]]
    confused: tuple[str, ...]


def _every_unit(selection: Selection, scatter: Scatter) -> list[Unit]:
    return [*selection.screens[0].units, *(chance.unit for chance in scatter.found)]


def _points(selection: Selection) -> dict[str, Point]:
    """Return the simulator at the prior's mean, with fitted parameters, and with effects."""
    nominal = selection.nominal.fit.point
    zero = Point(np.zeros_like(nominal.z))
    return {"raw": zero, "refit": nominal, "with_effects": selection.best.fit.point}


def _lasting(
    prepared: Prepared,
    selection: Selection,
    credit: Mapping[str, float],
    *,
    points: Mapping[str, Point],
    generator: np.random.Generator,
) -> _Found:
    """Return what the search found of effects that are the same in every run."""
    robot = prepared.predictor.system.robot
    measured = shrinkage(
        prepared.sets["test"],
        list(points.values()),
        generator,
        floor=_floor(selection, prepared.sets),
        beside=prepared.sets["validation"],
    )
    confused = confusion_set(selection, max(credit, key=credit.__getitem__)) if credit else ()
    effects = _effects(selection, credit, measured, robot)
    return _Found(measured, effects, _by_target(selection.best.fit.point, robot), tuple(confused))


def _with_chance(
    found: _Found, scatter: Scatter, robot: Robot, generator: np.random.Generator
) -> _Found:
    """Return the same with the effects of chance, beside those that last or in their place."""
    if scatter.beside:
        measured = scatter.measured(found.measured, generator)
        if measured.explained - found.measured.explained > _WORTH:
            others = found.measured.explained
            found = replace(
                found,
                measured=measured,
                effects=(*found.effects, *scatter.findings(measured, robot, others=others)),
                strengths={**found.strengths, **scatter.strengths(robot)},
            )
    elif scatter.hidden:
        found = replace(found, confused=(*found.confused, *scatter.hidden))
    elif scatter.found:
        measured = scatter.measured(found.measured, generator)
        effects = scatter.findings(measured, robot)
        found = _Found(measured, effects, scatter.strengths(robot), scatter.names)
    return _with_holds(found, scatter) if scatter.holds else found


def _with_holds(found: _Found, scatter: Scatter) -> _Found:
    """Return the same with samples that were not renewed, of the gap as it was recorded.

    What explains next to nothing of that is a stopgap for what bridges leave.
    """
    measured, before = scatter.with_holds(found.measured), found.measured
    gap = max(measured.refit - 1.0, 1e-9)
    if measured.refit - before.refit <= _WORTH * gap:
        return found
    lasting, strengths, confused = found.effects, found.strengths, found.confused
    if before.refit - before.effects <= _WORTH * gap:
        lasting, strengths, confused = (), {}, ()
    smaller = max(before.refit - 1.0, 0.0) / gap
    lasting = tuple(replace(e, share_of_gap=smaller * e.share_of_gap) for e in lasting)
    (held,) = scatter.held_findings(measured, sum(e.share_of_gap for e in lasting))
    effects = sorted([*lasting, held], key=lambda e: -e.share_of_gap)
    first = effects[0] is held or not confused
    strengths = {**strengths, SensorDropout(): dict(held.strengths)}
    return _Found(measured, tuple(effects), strengths, (held.name,) if first else confused)


def _absorbed(parameters: Sequence[Parameter]) -> list[str]:
    return [
        f"{p.name} was fitted to {p.without_effects:.3g}, at the edge of its prior "
        f"[{p.prior[0]:.3g}, {p.prior[1]:.3g}]: an effect is being absorbed by parameters"
        for p in parameters
        if p.at_bound
    ]


def _gap(measured: Shrinkage, prepared: Prepared, rollouts: Mapping[str, Any]) -> Gap:
    return Gap(
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


def _held_out(selection: Selection) -> float:
    """Return how likely chance gains on validation what the best of all units gained there.

    A gap that no small strength explains may be one that a large one does.
    """
    better = gain(selection.nominal, selection.best) - needed(selection.nominal, selection.best)
    return float(min(1.0, len(selection.screens[0].units) * np.exp(-max(better, 0.0) / 2)))


def _by_target(point: Point, robot: Robot) -> dict[Effect, dict[str, float]]:
    """Return strengths by effect and name of the target, zeros left out."""
    return {
        effect: {
            name: float(s) for name, s in zip(effect.targets(robot), strength[0], strict=True) if s
        }
        for effect, strength in strengths_of([point], robot).items()
    }


def _effects(
    selection: Selection, credit: Mapping[str, float], measured: Shrinkage, robot: Robot
) -> tuple[Finding, ...]:
    """Return the effects of the best model, units of one effect together."""
    best = selection.best
    size = len(best.fit.point.z)
    errors = strength_errors(best.fit, best.dispersion(), size)
    p_value = min(selection.p_values[0], _held_out(selection))
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
                p_value=p_value,
                share_of_gap=max(0.0, credit.get(name, 0.0) * measured.explained),
                strengths={u.where: s for u, s in zip(units, strengths, strict=True)},
                form=units[int(np.argmax(np.abs(strengths)))].effect.form,
                rivals=tuple(confusion_set(selection, name)[1:]),
            )
        )
    return tuple(sorted(found, key=lambda f: -f.share_of_gap))


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
    credit: Mapping[str, float],
    confused: Sequence[str],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return where the error sits before the effects, and after them."""
    train, judged = prepared.sets["train"], prepared.sets["validation"]
    found = unit_credit(selection, credit)

    def left(model: Model) -> tuple[tuple[Objective, Array], tuple[Objective, Array]]:
        point = model.fit.point
        return (train, _raw(train, point)), (judged, _raw(judged, point))

    before = location(*left(selection.nominal), selection.screens[0], found, confused=confused)
    after = location(*left(selection.best), selection.screens[-1], {})
    return before, after


def _raw(objective: Objective, point: Point) -> Array:
    return objective.raw([point])[0]
