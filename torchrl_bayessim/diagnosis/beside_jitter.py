"""Jitter of commands, in the place of what is late or beside what lasts.

Jitter is a delay on average, so what is late is taken out of the explanation that was found, and
jitter put in its place. A delay that is the same for each command, or nearly so, is likelier beside
a little jitter than jitter alone; and what pushes by itself is likelier as such. Then all that
lasts is looked for again: with the commands that act on average, and with their scatter as noise,
since jitter that nobody knows of hides the rest and calls for stopgaps.
"""

from __future__ import annotations

__all__ = ["Shaken", "beside_jitter", "outdone"]

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..effects.action import ActionJitter
from ..logs.log import Log
from .as_recorded import Sent
from .beside_losses import CERTAIN
from .chance import CALM, Chance, calm
from .jitter import Jitter, Responses, jitter, moments, shaken
from .loss_suspects import JUDGED, Suspects
from .model import LIKELY, Model, judged_fits
from .modes import Mode
from .moved_innovations import deviances_without, everywhere
from .objective import Objective, Point, Unit
from .preparation import Prepared
from .prepared_anew import with_other_logs
from .searching import Searching
from .selection import Selection
from .varying import widened

Array = NDArray[np.float64]
_SEGMENTS, _FEW = 40, 8  # of each split, and to see whether it is worth a closer look
_NEEDED = 10.0  # deviance on a few segments
_PLAINLY = 0.2  # of what losses gain: by how much jitter has to be likelier
# of what jitter gains beside what is late: by how much it may be worse in its place, and at most
_ROUGH, _MUCH = 0.2, 150.0
_AGAIN = 4  # steps of a fit without what is late
_NOTE = (
    "commands at {} are taken to act as late as jitter makes them on average, and its scatter "
    "counts as noise where other causes are looked for; the gap without causes is of the commands "
    "as they were sent"
)


@dataclass(frozen=True, eq=False)
class Shaken:
    """What was found of jitter, and beside it.

    Attributes:
        prepared: With the commands that act on average; as it was where jitter is all there is.
        selection: The effects that last beside it; as it was where there are none.
        chance: The jitter.
        sent: Figures of the commands as they were sent; none where jitter is all there is.
    """

    prepared: Prepared
    selection: Selection
    chance: Chance
    sent: Sent | None


@dataclass(frozen=True, eq=False)
class _Seen:
    """Jitter in the place of what is late.

    Attributes:
        base: What lasts beside it.
        jitter: Where and how much.
        without: Deviances by segment of what was found without it.
    """

    base: Model
    jitter: Jitter
    without: Array

    @property
    def price(self) -> float:
        """Its deviance and what chance often gains with so many effects."""
        return self.jitter.cost + LIKELY * len(self.base.units)


def beside_jitter(
    prepared: Prepared,
    selection: Selection,
    units: Sequence[Unit],
    *,
    search: Searching,
    generator: np.random.Generator,
) -> Shaken | None:
    """Return jitter, and what lasts beside it, if they explain more than what was found.

    Args:
        prepared: What the search started from.
        selection: What it found.
        units: Effects at their targets, jitter among them.
        search: Searches for effects that last.
        generator: Of simulated noise.
    """
    units = [unit for unit in units if isinstance(unit.effect, ActionJitter)]
    if not units or calm(selection) or type(prepared.mode) is not Mode:
        return None
    seen = _seen(prepared, selection, units)
    if seen is None:
        return None
    again = _with_jitter(prepared, seen, generator)
    _, more = search(again, known=_without_late(selection, seen.base), varied=True)
    found, more = _better(prepared, again, seen, more=more.seen_as(selection), units=units)
    gains = found.without - found.jitter.told.costs
    if found.jitter.told.scatter > CALM or not everywhere(gains):
        return None
    return _told(prepared, again, found, before=selection, more=more)


def _better(
    prepared: Prepared, again: Prepared, seen: _Seen, *, more: Selection, units: Sequence[Unit]
) -> tuple[_Seen, Selection]:
    """Return jitter beside what was found again, if that is worth it, or beside what there was."""
    if set(more.best.units) == set(seen.base.units):
        return seen, more
    judged = _judged(prepared, more.best.fit.point, _SEGMENTS)
    found = _Seen(more.best, jitter(judged, units), seen.without)
    if found.price < seen.price:
        return found, more
    sets = again.sets["train"], again.sets["validation"]
    base = judged_fits(*sets, [seen.base.fit.point], iterations=_AGAIN)[0]
    return seen, more.reduced(base)


def outdone(suspects: Suspects, found: Sequence[Chance], units: Sequence[Unit]) -> bool:
    """Return whether jitter explains more than losses of commands, in the segments that have them.

    Args:
        suspects: Short segments.
        found: Losses of commands.
        units: Effects at their targets, jitter among them.
    """
    units = [unit for unit in units if isinstance(unit.effect, ActionJitter)]
    if not units:
        return False
    segments = suspects.best if found[0].beside else suspects.nominal
    each = [segments[name] for name in JUDGED]
    judged = [Responses.of(one.objective, one.point, len(one.left)) for one in each]
    likeliest, losses = jitter(judged, units), min(found, key=lambda one: one.deviance)
    # losses in bursts are not what losses are taken for either
    margin = max(CERTAIN, _PLAINLY * losses.gain)
    return likeliest.cost < losses.deviance - margin


def _seen(prepared: Prepared, selection: Selection, units: Sequence[Unit]) -> _Seen | None:
    """Return jitter in the place of what is late, if it explains more, and nothing else does so."""
    best = selection.best
    for base in _bases(prepared, selection):
        few = _judged(prepared, base.fit.point, _FEW)
        if jitter(few, units).cost > _without(few, best).sum() - _NEEDED:
            continue
        judged = _judged(prepared, base.fit.point, _SEGMENTS)
        found = _Seen(base, jitter(judged, units), _without(judged, best))
        gained = found.without.sum() - found.jitter.cost
        if gained < CERTAIN or found.jitter.cost > shaken(judged, found.jitter.unit):
            continue
        if base is not best:
            late = _judged(prepared, best.fit.point, _SEGMENTS)
            beside = jitter(late, [found.jitter.unit]).cost
            slack = min(max(LIKELY, _ROUGH * (found.without.sum() - beside)), _MUCH)
            if found.jitter.cost > beside + slack:
                continue
        return found
    return None


def _bases(prepared: Prepared, selection: Selection) -> Iterator[Model]:
    """Yield what was found without what is late, and parameters alone: all may make up for it.

    Or without what is late of commands, where sensors are.
    """
    best, sets = selection.best, (prepared.sets["train"], prepared.sets["validation"])
    strengths = best.fit.point.strengths
    given: list[dict[Unit, float]] = [{}]
    for late in (_late, lambda unit: _late(unit) and unit.effect.channel != "sensing"):
        kept = {unit: strength for unit, strength in strengths.items() if not late(unit)}
        if kept in given:
            continue
        given.append(kept)
        if kept == strengths:
            yield best
        else:
            yield judged_fits(*sets, [Point(best.fit.point.z, kept)], iterations=_AGAIN)[0]
    yield selection.nominal


def _late(unit: Unit) -> bool:
    return unit.effect.group == ActionJitter.group


def _judged(prepared: Prepared, point: Point, most: int) -> list[Responses]:
    return [Responses.of(prepared.sets[name], point, most) for name in JUDGED]


def _without(judged: Sequence[Responses], best: Model) -> Array:
    return deviances_without([one.judged for one in judged], best.fit.point)


def _without_late(selection: Selection, base: Model) -> Selection:
    """Return where a search goes on from, without what is late: of one kind with jitter."""

    def other(unit: Unit) -> bool:
        return not _late(unit) or unit in base.units

    offered = tuple(unit for unit in selection.offered if other(unit))
    tried = tuple(model for model in selection.tried if all(map(other, model.units)))
    return replace(selection, best=base, tried=tried, offered=offered)


def _with_jitter(prepared: Prepared, seen: _Seen, generator: np.random.Generator) -> Prepared:
    """Return the logs with the commands that act on average, and a covariance so much wider."""
    unit, strength = seen.jitter.unit, seen.jitter.strength
    dt = prepared.predictor.system.control_dt
    logs = {
        name: [_on_average(log, unit, strength / dt) for log in part]
        for name, part in prepared.logs.items()
    }
    again = with_other_logs(prepared, logs, generator=generator)
    roots = {}
    for name in JUDGED:
        sent = again.sets[name].along(prepared.sets[name].segments)  # what is late is what was sent
        moved = Responses.of(sent, seen.base.fit.point, len(sent.segments)).moved(unit, strength)
        roots[name] = moved.vectors * np.sqrt(moved.values)[:, None]
    where = "all actuators" if unit.where == "all" else unit.where
    return widened(again.alarmed(_NOTE.format(where)), roots)


def _on_average(log: Log, unit: Unit, steps: float) -> Log:
    """Return a log with the commands that act on average, the first ones as they are."""
    ctrl = log.ctrl.numpy().copy()
    for target in unit.targets:
        most = unit.direction[target] * steps
        first = int(np.ceil(most)) + 1
        rows = np.arange(first, len(ctrl))
        ctrl[first:, target] += moments(log.ctrl.numpy()[None, :, target], rows, most)[0][0]
    return replace(log, ctrl=torch.from_numpy(ctrl))


def _told(
    prepared: Prepared, again: Prepared, found: _Seen, *, before: Selection, more: Selection
) -> Shaken:
    jittered, test = found.jitter, prepared.sets["test"]
    after, mean = _left(test, found.base.fit.point, jittered)
    chance = Chance(
        unit=jittered.unit,
        strength=jittered.strength,
        error=jittered.error,
        gain=float(found.without.sum() - jittered.cost),
        left=after,
    )
    if not more.best.units:
        return Shaken(prepared, before, chance, None)
    alone = float(_left(test, more.nominal.fit.point, jittered)[0].mean())
    chance = replace(chance, before=mean, beside=True, alone=alone)
    return Shaken(again, more, chance, Sent.along(again, prepared, more))


def _left(test: Objective, point: Point, jittered: Jitter) -> tuple[Array, float]:
    """Return mean squares of test segments by the scatter of jitter, and with its mean alone."""
    one = Responses.of(test, point, len(test.segments))
    moved = one.moved(jittered.unit, jittered.strength)
    size, change = one.judged.derivatives.shape[-1], jittered.told.change
    change = change if len(change) == size else np.zeros(size)  # of this point, or another
    error = one.judged.left + moved.mean + one.judged.derivatives @ change
    return moved.deviances(one.judged, change)[1], float((error**2).mean())
