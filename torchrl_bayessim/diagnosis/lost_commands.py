"""Effects that last, beside commands that were lost: each hides the other.

What losses spoil is more than what many an effect does, and an effect that is missing spoils the
segments in which no command was lost. Where losses are evident, whatever else there is, the search
is done again on the commands that arrived (`arrivals`), which commands these are is decided on
again in the simulator that it found, and so on, until nothing but losses is needed or nothing is
gained. In the end losses have to explain the segments that
have them in that simulator, by the standard that is theirs elsewhere (`losses`).
"""

from __future__ import annotations

__all__ = ["beside_lost_commands"]

from dataclasses import replace

import numpy as np

from .arrivals import Arrivals, fewer
from .beside_losses import CERTAIN, Beside, Sought
from .chance import Chance
from .elimination import parts
from .evident_losses import Evident, evident, lost_beside
from .model import WHITE, takes_most
from .preparation import Prepared
from .prepared_anew import with_other_logs
from .searching import Searching
from .selection import Selection

_ROUNDS = 3  # of deciding which commands arrived and searching on


def beside_lost_commands(sought: Sought) -> Beside | None:
    """Return effects that last and losses that explain more together than what was found.

    Or losses alone, where none were found with the commands as they were sent.
    """
    prepared, selection, found = sought.prepared, sought.selection, sought.found
    seen = evident(sought)
    if seen is None:
        return None
    some = fewer(prepared, len(seen.actuators))
    best = _searched(some, selection, seen, search=sought.search, generator=sought.generator)
    if best is None:
        return None
    lasting, chance = _needed(seen, *best)
    if found and not lasting.best.units:
        return None  # losses alone explain it with the commands that were sent
    if chance is None or chance.deviance > seen.without - CERTAIN:
        return None
    if any(chance.deviance > one.deviance - CERTAIN for one in found):
        return None
    return Beside(some, best[0], lasting, replace(chance, beside=bool(lasting.best.units)))


def _needed(
    seen: Evident, arrived: Prepared, selection: Selection
) -> tuple[Selection, Chance | None]:
    """Return the selection without effects that only mend wrong decisions, and the losses beside.

    Judged with the commands as they were sent and all that may have been lost of them.
    """
    chance, sets = lost_beside(seen, selection.best), arrived.sets
    while len(selection.best.names) > 1:
        smaller = parts(sets["train"], sets["validation"], selection.best)
        found = [(lost_beside(seen, model), model) for model in smaller]
        known = [(one.deviance, one, model) for one, model in found if one is not None]
        least, one, model = min(known, key=lambda each: each[0], default=(np.inf, chance, None))
        if model is None or (chance is not None and least > chance.deviance + CERTAIN):
            break
        chance = one
        selection = selection.reduced(model, smaller)
    return selection, chance


def _matters(selection: Selection) -> bool:
    """Return whether effects take half of what parameters leave, or wrong decisions may be all."""
    before, after = selection.nominal, selection.best
    return before.mean_square > WHITE and takes_most(before, after)


def _searched(
    prepared: Prepared,
    sent: Selection,
    seen: Evident,
    *,
    search: Searching,
    generator: np.random.Generator,
) -> tuple[Prepared, Selection] | None:
    """Return what is found on the commands that arrived, if that explains more than as sent."""
    logs, point, law = prepared.logs, seen.point, seen.law
    result, least = None, sent.best.mean_square
    for _ in range(_ROUNDS):
        logs = Arrivals(prepared, point, seen.actuators, law).decided(logs)
        again = with_other_logs(prepared, logs, generator=generator)
        # what wrong decisions leave, two effects that explain little alone would mend, too: those
        # are looked for with the commands as sent only, where losses hide all but large ones
        again, selection = search(again, pairs=False)
        if selection.best.mean_square >= least:
            break
        least, point = selection.best.mean_square, selection.best.fit.point
        if not selection.best.units:
            return again, selection  # losses are all there is
        if _matters(selection):  # or decisions in this simulator may be better ones
            result = again, selection
        if least < WHITE:
            break
        law = replace(law, scatter=min(law.scatter, max(1.0, least)))
    return result
