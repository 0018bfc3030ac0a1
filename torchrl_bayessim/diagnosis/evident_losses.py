"""Losses of commands that are there whatever else is wrong with the simulator.

They explain nearly all that is wrong with the segments that have them, and most segments are right
with them. Where many commands are lost the parameters make up for some of that, and nothing is
right: then parameters and effects are fitted again on the commands that are likely to have arrived
(`arrivals`), which these are is told again in that simulator, and so on while losses get likelier:
expectation maximization (Dempster, Laird & Rubin 1977) with the likeliest arrivals in the place of
their expectation.
"""

from __future__ import annotations

__all__ = ["Evident", "evident", "lost_beside"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

from ..effects.action import PacketDrop
from .arrivals import Arrivals, fewer
from .beside_losses import CERTAIN, Sought
from .chance import Chance
from .loss_law import LossLaw, Told, Tried, likeliest
from .loss_segments import LossSegments
from .loss_suspects import FEWEST, JUDGED, LIKELIER, SCATTER, SPOILED, Alone, spoiled_share
from .losses import EVIDENT, SHARES, WRONG, found_beside, may_be_beside
from .model import WHITE, Model
from .objective import Point, Unit
from .prepared_anew import with_other_logs
from .refit import refit

_TIMES = 4.0  # errors without losses per those with them
_ROUNDS = 4  # of fitting again
_AGAIN = 6  # steps of these fits
_MOST = 0.5  # of what effects that last explain


@dataclass(frozen=True, eq=False)
class Evident:
    """Losses of commands that are there, whatever else is.

    Attributes:
        unit: Whose commands.
        law: How they come about.
        point: The simulator in which they are likeliest.
        without: Deviance of the best explanation without losses.
        segments: Of each split, with the commands as they were sent, at the nominal fit.
    """

    unit: Unit
    law: LossLaw
    point: Point
    without: float
    segments: Mapping[str, LossSegments]

    @property
    def actuators(self) -> list[int]:
        """Those whose commands are lost together."""
        return self.unit.targets


class _Likely(NamedTuple):
    """The likeliest losses of a unit in one simulator, and whether they are plain."""

    cost: float
    gained: float
    unit: Unit
    law: LossLaw
    data: Mapping[str, LossSegments]
    plain: bool


def evident(sought: Sought) -> Evident | None:
    """Return the likeliest losses of commands, if segments are much likelier with any.

    Or those that were found in the place of effects that last. Where none are plain, those that are
    in a simulator that is fitted again, first with parameters alone; but not where effects leave
    noise alone, and losses leave most of what those explain.

    Args:
        sought: What was found, and short segments.
    """
    suspects, best = sought.suspects, sought.selection.best
    known = {one.unit for one in sought.found if not one.beside}
    units = [u for u in suspects.units if isinstance(u.effect, PacketDrop)]
    bases = [(suspects.nominal, suspects.alone)]
    bases += [(suspects.best, suspects.rival)] if best.units else []
    every = [[_likely(data, unit, alone) for unit in units] for data, alone in bases]
    plain = [one for part in every for one in part if one.plain or one.unit in known]
    if not plain and not _far_behind(sought, every):
        sets = zip(every, bases, strict=True)
        again = (_fitted_again(sought, part, alone) for part, (_, alone) in sets)
        plain = list(islice(filter(None, again), 1))
    if not plain:
        return None
    seen = min(plain, key=lambda one: one.cost)
    least = min(sum(alone.costs) for _, alone in bases)
    return Evident(seen.unit, seen.law, seen.data[JUDGED[0]].point, least, suspects.nominal)


def _far_behind(sought: Sought, every: Sequence[Sequence[_Likely]]) -> bool:
    """Return whether effects leave noise alone, and losses leave most of what those explain.

    Fitting again may make losses a little likelier, but it takes as long as a search.

    Args:
        sought: What was found.
        every: Losses of each unit with parameters alone, and beside the effects if there are any.
    """
    suspects, best = sought.suspects, sought.selection.best
    if not best.units or not suspects.rival.calm or best.mean_square >= WHITE:
        return False
    alone, beside = (max((one.gained for one in part), default=0.0) for part in every)
    explained = sum(suspects.alone.costs) - sum(suspects.rival.costs)
    return alone < _MOST * explained and beside < EVIDENT


def _likely(data: Mapping[str, LossSegments], unit: Unit, alone: Alone) -> _Likely:
    judged = [data[name].tried(unit) for name in JUDGED]
    law = likeliest(judged, SHARES, SCATTER.tolist(), SPOILED, size=alone.law.size)
    cost = law.deviance(judged)
    gained = sum(alone.costs) - cost
    return _Likely(cost, gained, unit, law, data, gained > EVIDENT and _plain(law, judged))


def _plain(law: LossLaw, judged: Sequence[Tried]) -> bool:
    """Return whether losses explain nearly all that is wrong with the segments that have them.

    And whether most segments are right with them: another law than the true one is wrong
    everywhere, and some of that looks like losses.
    """
    told = Told.joined([law.told(one) for one in judged])
    concerned = told.lost > LIKELIER
    if concerned.sum() < FEWEST or spoiled_share(told) > WRONG:
        return False
    return bool(told.before[concerned].mean() > _TIMES * told.after[concerned].mean())


def _fitted_again(sought: Sought, found: Sequence[_Likely], alone: Alone) -> _Likely | None:
    """Return the likeliest losses, in a simulator fitted to the commands that arrived.

    Nothing where they are not plain there, or where they are no likelier than before.

    Args:
        sought: What was found.
        found: Losses of every unit in one simulator.
        alone: That simulator without losses.
    """
    best = min(found, key=lambda one: one.cost, default=None)
    if best is None or best.gained < EVIDENT:
        return None
    prepared = fewer(sought.prepared, len(best.unit.targets))
    logs = prepared.logs
    for _ in range(_ROUNDS):
        point = best.data[JUDGED[0]].point
        logs = Arrivals(prepared, point, best.unit.targets, best.law).decided(logs)
        again = with_other_logs(prepared, logs, generator=sought.generator)
        fit = again.nominal
        if point.strengths:
            fit = refit(again.sets["train"], [point], iterations=_AGAIN)[0]
        data = {name: one.at(fit.point) for name, one in best.data.items()}
        better = _likely(data, best.unit, alone)
        if better.cost > best.cost - CERTAIN:
            break
        best = better
    return best if best.plain else None


def lost_beside(seen: Evident, model: Model) -> Chance | None:
    """Return losses of commands beside the effects of a model, nothing if they may be those.

    Args:
        seen: The losses that are evident, in segments with the commands that were sent.
        model: The effects.
    """
    if not may_be_beside(seen.unit, model.units):
        return None
    data = {name: one.at(model.fit.point) for name, one in seen.segments.items()}
    return found_beside(data, seen.unit, Alone.of(data), model.units)
