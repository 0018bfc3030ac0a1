"""What chance does, in the place of what lasts or beside it, and what is found beside that."""

from __future__ import annotations

__all__ = ["with_chance"]

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..effects.action import PacketDrop
from ..effects.sensors import SensorDropout
from ..logs.log import Log
from .as_recorded import Recorded, Sent, gap_with_holds
from .beside_jitter import beside_jitter, outdone
from .beside_losses import Sought
from .chance import Chance, chances, detectable, of_chance, unseen
from .holds import Hold
from .loss_suspects import Suspects
from .losses import losses, may_be_beside
from .lost_commands import beside_lost_commands
from .lost_samples import beside_lost_samples
from .model import WHITE, Model, judged_fits, shown, takes_most
from .objective import Unit
from .preparation import Prepared
from .scatter import Scatter
from .search import MANY
from .searching import Searching
from .selection import Selection
from .varying import varying, with_variation

_AGAIN = 4  # steps of fits whose noise was another
_LOST = 4  # samples of all runs, to be lost at all
_REST = "{}, as it seems: that explains what remains"


def with_chance(
    prepared: Prepared,
    selection: Selection,
    *,
    logs: Sequence[Log],
    units: Sequence[Unit],
    holds: Sequence[Hold],
    alarms: tuple[str, ...],
    search: Searching,
    generator: np.random.Generator,
) -> tuple[Prepared, Selection, Scatter]:
    """Return what was found of chance, and of what lasts beside it.

    Args:
        prepared: What the search for what lasts started from.
        selection: What it found.
        logs: As they were recorded.
        units: Effects at their targets, those of chance among them.
        holds: Channels whose samples were not always renewed.
        alarms: From before that search.
        search: Searches for effects that last.
        generator: Of simulated noise.
    """
    random, suspects = of_chance(units), Suspects.of(prepared, selection, units)
    found = losses(prepared, selection, suspects) if suspects else []
    sent, shaken, recorded = None, None, Recorded()
    seen = replace(prepared, alarms=alarms)
    if holds:
        recorded = gap_with_holds(prepared, logs, selection)
    elif suspects:
        sought = Sought(seen, selection, found, suspects, search, generator)
        prepared, selection, found, sent = _beside_losses(prepared, sought)
    if not holds and sent is None and _may_be_jitter(suspects, found, units):
        shaken = beside_jitter(seen, selection, units, search=search, generator=generator)
    if shaken is not None:
        found, sent = [shaken.chance], shaken.sent
        if sent is not None:
            prepared, selection = shaken.prepared, shaken.selection
    found = found or chances(prepared.sets, selection, random)
    elsewhere = sent is None and shaken is None and not holds
    # where short segments hold more than noise, what is lost is seen there, one by one
    if elsewhere and not found and (suspects is None or suspects.rival.calm):
        lost = [unit for unit in random if _may_be_lost_beside(unit, selection.best)]
        found = chances(prepared.sets, selection, lost, beside=True)
    if elsewhere and not any(chance.beside for chance in found):
        prepared, more = _beside_variation(search, prepared, selection, random)
        if more is not selection:
            found, selection = [], more
    least = detectable(prepared.sets["train"], selection, random)
    hidden = [] if found else unseen(prepared.sets, selection, random)
    return prepared, selection, Scatter(found, least, holds, recorded, hidden, sent)


def _beside_losses(
    prepared: Prepared, sought: Sought
) -> tuple[Prepared, Selection, Sequence[Chance], Sent | None]:
    """Return what is found beside commands or samples that were lost; the same if it is no more.

    Samples that are decided on one by one, of which hardly any is lost, are none that were lost.
    """
    beside = beside_lost_commands(sought)
    if beside is not None:
        return beside.told()
    beside = beside_lost_samples(sought)
    if beside is None:
        return prepared, sought.selection, sought.found, None
    told = beside.told()
    if told[-1].lost >= _LOST:
        return told
    others = [one for one in sought.found if one.unit != beside.chance.unit]
    return prepared, sought.selection, others, None


def _may_be_jitter(
    suspects: Suspects | None, found: Sequence[Chance], units: Sequence[Unit]
) -> bool:
    """Return whether nothing was lost, or jitter is likelier than losses of commands."""
    commands = all(isinstance(one.unit.effect, PacketDrop) for one in found)
    return commands and (suspects is None or not found or outdone(suspects, found, units))


def _may_be_lost_beside(unit: Unit, best: Model) -> bool:
    """Return whether values may be lost beside effects that are there, and are not those."""
    losses = isinstance(unit.effect, PacketDrop | SensorDropout)
    return losses and may_be_beside(unit, best.units)


def _beside_variation(
    search: Searching, prepared: Prepared, selection: Selection, random: Sequence[Unit]
) -> tuple[Prepared, Selection]:
    """Return what is found beside effects that vary by chance; the same if it is no more.

    Where that leaves noise alone without a variation, it is what was missing: a law in a form that
    could not be told from what all of the gap hides is seen where less of it counts.
    """
    # of legs with twelve joints, once more through all of it takes too long
    few = len(selection.offered) <= MANY
    found = varying(prepared, selection.best, selection.offered, random) if few else None
    if found is None:
        return prepared, selection
    # of one kind with what varies, which is known roughly only, everything helps a little
    others = [unit for unit in selection.offered if unit.effect.group != found.group]
    known = replace(selection, offered=tuple(others))
    wider, more = search(with_variation(prepared, found), known=known, varied=True)
    if not more.best.names > selection.best.names:
        rest = more.best.mean_square < WHITE
        return prepared.alarmed(_REST.format(found.what)) if rest else prepared, selection
    plain = _under_noise_alone(prepared, more.best)
    instead = takes_most(selection.best, plain)
    if instead and plain.mean_square < WHITE and shown(selection.best, plain):
        alike, again = search(prepared, known=replace(selection, best=plain))
        if again.best.names > selection.best.names and again.best.mean_square < WHITE:
            return alike, again
    refused = any(more.best.names <= model.names for model in selection.tried)
    # what explains that without a variation and was refused stands in its place, not beside it:
    # where something varies a little of everything helps
    if refused and instead:
        return prepared, selection
    return wider, more.seen_as(selection)


def _under_noise_alone(prepared: Prepared, model: Model) -> Model:
    """Return a model that was found beside a variation, fitted without it."""
    train, validation = prepared.sets["train"], prepared.sets["validation"]
    return judged_fits(train, validation, [model.fit.point], iterations=_AGAIN)[0]
