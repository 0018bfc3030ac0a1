"""What was found: effects with their strengths, and how far the gap shrinks with them."""

from __future__ import annotations

__all__ = ["Found"]

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..effects.effect import Effect
from ..effects.robot import Robot
from ..effects.sensors import SensorDropout
from .as_recorded import Sent
from .candidates import strength_errors
from .confusion import confusion_set
from .model import gain, needed
from .objective import Objective, Point, Unit, at_targets, strengths_of
from .preparation import Prepared
from .report import Finding
from .scatter import Scatter
from .selection import Selection
from .shrinkage import Shrinkage, shrinkage
from .validation import NEGLIGIBLE

_WORTH = 0.01  # of the gap on test runs, to name chance beside another cause
_CERTAIN = 100.0  # deviance on training and validation runs, to be named for less
_REST = 0.25  # of what effects leave
_PLAIN, _MOST = 1.5, 0.5  # of the noise, what effects leave; what chance takes of that
_LEFT, _MUCH = 1.5, 0.4  # of the noise, what bridges leave; what is no stopgap takes of that


@dataclass(frozen=True)
class Found:
    """What was found, and how far the gap shrinks with it.

    Attributes:
        measured: How far it shrinks.
        effects: What was found, as the report has it.
        strengths: By effect and target, as `Report.apply` sets them.
        confused: Names that cannot be told from the first cause, itself first.
    """

    measured: Shrinkage
    effects: tuple[Finding, ...]
    strengths: Mapping[Effect, Mapping[str, float]]
    confused: tuple[str, ...]

    @classmethod
    def of(
        cls,
        prepared: Prepared,
        selection: Selection,
        scatter: Scatter,
        credit: Mapping[str, float],
        *,
        points: Mapping[str, Point],
        generator: np.random.Generator,
    ) -> Found:
        """Return what the search found, and what was found of chance.

        Args:
            prepared: Split, noise, horizon, nominal fit.
            selection: What the search found.
            scatter: What was found of effects of chance.
            credit: Each effect's share of the deviance that all remove.
            points: The simulator at the prior's mean, with fitted parameters, and with effects.
            generator: Of the bootstrap.
        """
        robot = prepared.predictor.system.robot
        measured = shrinkage(
            prepared.sets["test"],
            list(points.values()),
            generator,
            floor=1.0 if prepared.varied else _floor(selection, prepared.sets),
            beside=prepared.sets["validation"],
        )
        equals = {name: confusion_set(selection, name) for name in credit}
        lasting = cls(
            measured,
            _effects(selection, credit, equals, measured, robot=robot),
            _by_target(selection.best.fit.point, robot),
            equals[max(credit, key=credit.__getitem__)] if credit else (),
        )
        return _with_chance(lasting, scatter, robot, generator)


def _with_chance(
    found: Found, scatter: Scatter, robot: Robot, generator: np.random.Generator
) -> Found:
    """Return the same with the effects of chance, beside those that last or in their place."""
    if scatter.sent is not None:
        arrived = scatter.scattered(found.measured, generator)
        return _with_arrivals(replace(found, measured=arrived), scatter, scatter.sent, robot)
    if scatter.beside:
        measured = scatter.measured(found.measured, generator)
        if _matters(scatter, found.measured, measured):
            others = max(found.measured.explained, 0.0)
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
        found = Found(measured, effects, scatter.strengths(robot), scatter.names)
    return _with_holds(found, scatter) if scatter.holds else found


def _matters(scatter: Scatter, before: Shrinkage, after: Shrinkage) -> bool:
    """Return whether chance beside effects explains some of the gap, or of what they leave.

    Most of that where it is plainly more than noise; some of it, if chance is certain. Test runs of
    which effects leave noise alone say nothing against what is certain of others.
    """
    if after.explained - before.explained > _WORTH:
        return True
    certain = max(one.gain for one in scatter.found) > _CERTAIN
    left, removed = before.effects - 1.0, before.effects - after.effects
    if left > _PLAIN - 1.0 and removed > _MOST * left:
        return True
    return certain and (left < NEGLIGIBLE - 1.0 or removed > _REST * left)


def _with_holds(found: Found, scatter: Scatter) -> Found:
    """Return the same with samples that were not renewed, of the gap as it was recorded.

    What is a stopgap for what bridges leave is no cause.
    """
    measured, before = scatter.with_holds(found.measured), found.measured
    gap = max(measured.refit - 1.0, 1e-9)
    if measured.refit - before.refit <= _WORTH * gap and not scatter.recorded.matter:
        return found
    if _is_stopgap(before, gap):
        found = replace(found, effects=(), strengths={}, confused=())
    smaller = max(before.refit - 1.0, 0.0) / gap
    lasting = [replace(e, share_of_gap=smaller * e.share_of_gap) for e in found.effects]
    (held,) = scatter.held_findings(measured, sum(e.share_of_gap for e in lasting))
    known = {**found.strengths, SensorDropout(): dict(held.strengths)}
    return _ranked(found, measured, [*lasting, held], known)


def _is_stopgap(bridged: Shrinkage, gap: float) -> bool:
    """Return whether effects explain next to nothing, but for what bridges leave.

    Where that is much, and effects explain most of it, they are causes of their own.

    Args:
        bridged: How far the gap shrinks of samples with bridges in the places of those held.
        gap: As it was recorded.
    """
    explained, left = bridged.refit - bridged.effects, bridged.refit - 1.0
    much = bridged.refit > _LEFT and explained > _MUCH * left
    return explained <= _WORTH * gap and not much


def _with_arrivals(found: Found, scatter: Scatter, sent: Sent, robot: Robot) -> Found:
    """Return the same with commands that were lost or late, of the gap with those sent."""
    measured = scatter.with_arrivals(found.measured, sent)
    others = (1.0 - sent.share(found.measured.refit, found.measured.effects)) * measured.explained
    total = max(sum(effect.share_of_gap for effect in found.effects), 1e-9)
    lasting = [replace(e, share_of_gap=others * e.share_of_gap / total) for e in found.effects]
    (lost,) = scatter.findings(measured, robot, others=others)
    known = {**found.strengths, **scatter.strengths(robot)}
    return _ranked(found, measured, [*lasting, lost], known)


def _ranked(
    found: Found,
    measured: Shrinkage,
    effects: Sequence[Finding],
    strengths: Mapping[Effect, Mapping[str, float]],
) -> Found:
    """Return effects by their share of the gap as it was recorded, the last one new."""
    ranked = sorted(effects, key=lambda e: -e.share_of_gap)
    new = ranked[0] is effects[-1] or not found.confused
    return Found(measured, tuple(ranked), strengths, (effects[-1].name,) if new else found.confused)


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


def _together(
    units: Sequence[Unit], strengths: Sequence[float], errors: Sequence[float]
) -> tuple[float, float]:
    """Return the strength and its error: the mean of places, at each the sum of the laws there."""
    places = len({unit.where for unit in units})
    return sum(strengths) / places, math.hypot(*errors) / places


def _effects(
    selection: Selection,
    credit: Mapping[str, float],
    equals: Mapping[str, tuple[str, ...]],
    measured: Shrinkage,
    *,
    robot: Robot,
) -> tuple[Finding, ...]:
    """Return the effects of the best model, units of one effect together."""
    best = selection.best
    size = len(best.fit.point.z)
    errors = strength_errors(best.fit, best.dispersion(), size)
    p_value = min(selection.p_values[0], _held_out(selection))
    found = []
    for name, confused in equals.items():
        units = [u for u in best.units if u.name == name]
        strengths = [u.actual(best.fit.point.strengths[u]) for u in units]
        mean, error = _together(units, strengths, [errors[u] for u in units])
        found.append(
            Finding(
                name=name,
                where=units[0].where if len({u.where for u in units}) == 1 else "all",
                strength=mean,
                unit=units[0].measured_in(robot),
                ci95=(mean - 1.96 * error, mean + 1.96 * error),
                p_value=p_value,
                share_of_gap=max(0.0, credit[name] * measured.explained),
                strengths=at_targets(dict(zip(units, strengths, strict=True)), robot),
                form=units[int(np.argmax(np.abs(strengths)))].effect.form,
                rivals=confused[1:],
            )
        )
    return tuple(sorted(found, key=lambda f: -f.share_of_gap))
