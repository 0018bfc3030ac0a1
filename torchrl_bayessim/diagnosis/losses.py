"""Losses, found one by one: commands that did not arrive, samples that were not renewed.

A value that is lost leaves the last one in its place. If one in fifty is, most segments have none,
and their mean and covariance say little; but where it happened it can be seen. In short segments
every pattern of a few losses is tried (`loss_segments`, `loss_law`), and what must be beaten is the
same law without losses, where some segments are spoiled by something else: losses have to explain
what they spoil, and not only that some segments are worse than others. They are looked for in the
place of the effects that the search found, and beside them.
"""

from __future__ import annotations

__all__ = [
    "EVIDENT", "SHARES", "WRONG",
    "all_found", "found_beside", "losses", "may_be_beside",
]  # fmt: skip

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..effects.action import ActionDelay, PacketDrop
from ..effects.contacts import ContactFriction
from ..effects.sensors import SensorBias, SensorDropout
from .chance import Chance
from .contacts import resting
from .loss_law import LossLaw, Told, Tried, likeliest
from .loss_segments import LossSegments
from .loss_suspects import (
    FEWEST,
    JUDGED,
    LEFT,
    LIKELIER,
    NOISE,
    SCATTER,
    SPOILED,
    Alone,
    Suspects,
    spoiled_share,
)
from .objective import Unit
from .preparation import Prepared
from .selection import Selection

Array = NDArray[np.float64]
SHARES = (0.01, 0.02, 0.04, 0.08, 0.15, 0.25, 0.4, 0.6)  # s
# deviances: to be found (contacts that come late look like a few losses), and that chance makes
_NEEDED, _LIKELY = 40.0, 6.0
# of the excess of the segments concerned, by what is left; beside effects also taken of noise
_EXPLAINED = 0.5
_CLEARLY = 0.1  # of it may be left of what is found clearly
_ELSEWHERE = 0.5  # of what lost commands of a drive explain, by those of another
_AS_MUCH = 0.15  # of what losses explain in the runs of the fit, by those in runs that judge
_FEW = 0.1  # of the deviance that such losses explain: what they may cost in runs without any
_BIASED = 0.1  # of the excess of the segments concerned, which parameters leave in all
_OTHERS = 1 / 6  # of the segments that something else may have spoiled
_REMAIN = 0.6  # or of those that were spoiled without losses
_SEEN = 4.0  # deviance that losses beside an effect explain in a segment that has them, on average
_LONE = 0.2  # of what lost samples of a sensor explain, by those of any other
EVIDENT, WRONG = 100.0, 0.3  # deviance, to be evident, and segments that losses do not explain
_LATE = ActionDelay.group
_INTERVAL = 3.92  # standard deviations that are 95 %
_WIDER = 1.5  # times: errors were, on robots whose share was known


def losses(prepared: Prepared, selection: Selection, suspects: Suspects) -> list[Chance]:
    """Return the losses that explain what is wrong with the segments that have them.

    The likeliest first, with those that are nearly as likely.

    Args:
        prepared: Logs, noise and nominal fit.
        selection: What the search without chance found.
        suspects: Short segments, and what may have been lost: commands, of one actuator or of all
            at once, and samples of one target.
    """
    some = _telling(prepared, suspects.units)
    nominal, best, rival = suspects.nominal, suspects.best, suspects.rival
    alone = suspects.alone
    # what the best explanation without chance gains by the same standard
    found, least = all_found(nominal, some, alone), sum(alone.costs) - sum(rival.costs)
    able = [unit for unit in some if may_be_beside(unit, selection.best.units)]
    if selection.best.units and able:
        others = _of_one_drive(all_found(best, able, rival, selection.best.units))
        beside = [replace(one, beside=True) for one in others]
        if _most(beside) > _most(found) - least + _NEEDED:
            found, least = beside, 0.0
    kept = [one for one in found if one.gain > max(_NEEDED, least)]
    kept.sort(key=lambda one: -one.gain)
    return [one for one in kept if one.gain > kept[0].gain - _LIKELY]


def _telling(prepared: Prepared, units: Sequence[Unit]) -> list[Unit]:
    """Return the units but for samples of what rests: it chatters, and one is like the next."""
    predictor = prepared.predictor
    still = resting(predictor, prepared.logs["train"], noise=prepared.noise)
    rests = still[predictor.sensing.channels]
    return [u for u in units if isinstance(u.effect, PacketDrop) or not rests[u.direction.index(1)]]


def may_be_beside(unit: Unit, others: Sequence[Unit]) -> bool:
    """Return whether losses beside effects could not be another form of those.

    A lag that is not quite the true one errs as commands would that were lost, and contacts that
    stick and slip a little otherwise as commands and samples would.
    """
    known = [other.effect for other in others]
    late = any(effect.group == _LATE for effect in known)
    commands = isinstance(unit.effect, PacketDrop)
    return not (late and commands) and not any(isinstance(e, ContactFriction) for e in known)


def _sensed(others: Sequence[Unit]) -> bool:
    """Return whether effects are late, or of sensors and more than a constant or a slow drift.

    Samples err with these as if a few were lost.
    """
    known = [unit.effect for unit in others]
    sensing = any(e.channel == "sensing" and e.group != SensorBias.group for e in known)
    return sensing or any(effect.group == _LATE for effect in known)


def all_found(
    data: Mapping[str, LossSegments],
    units: Sequence[Unit],
    alone: Alone,
    others: Sequence[Unit] = (),
) -> list[Chance]:
    """Return the losses of each unit that explain what they spoil, see `found_beside`.

    Args:
        data: Short segments of each split.
        units: What may have been lost.
        alone: The law without losses.
        others: Effects that losses are beside.
    """
    likely = [_Losses.of(data, unit, alone) for unit in units]
    found = [one.explaining(alone, others, lone=_lone(one, likely)) for one in likely]
    return [one for one in found if one is not None]


def _lone(one: _Losses, every: Sequence[_Losses]) -> bool:
    """Return whether of several sensors none but one seems to lose samples."""
    others = [other.gain for other in every if other is not one and _is_sample(other)]
    return _is_sample(one) and bool(others) and max(others) < _LONE * one.gain


def _is_sample(losses: _Losses) -> bool:
    return isinstance(losses.unit.effect, SensorDropout)


def _of_one_drive(found: Sequence[Chance]) -> list[Chance]:
    """Return losses without those of commands that several drives explain, each alone.

    What is a little wrong everywhere looks as if commands of any of them were lost now and then.
    """
    commands = [one for one in found if isinstance(one.unit.effect, PacketDrop)]
    first = max(commands, key=lambda one: one.gain, default=None)
    if first is None or _drives(first) > 1:
        return list(found)
    others = [one.gain for one in commands if one is not first and _drives(one) == 1]
    if max(others, default=0.0) < _ELSEWHERE * first.gain:
        return list(found)
    return [one for one in found if one not in commands]


def _drives(one: Chance) -> int:
    return len(one.unit.targets)


def _most(found: Sequence[Chance]) -> float:
    return max((one.gain for one in found), default=0.0)


def found_beside(
    data: Mapping[str, LossSegments], unit: Unit, alone: Alone, others: Sequence[Unit]
) -> Chance | None:
    """Return the losses of a unit beside others, nothing if they do not explain what they spoil.

    Commands beside an effect have to leave nothing of what they spoil, to be no more than is
    plausible, and to be evident, as one of them is on average, too: a force law that is not quite
    the true one errs everywhere a little, as if ever so many of them were.
    """
    return _Losses.of(data, unit, alone).explaining(alone, others)


class _Losses(NamedTuple):
    """The likeliest losses of a unit.

    Attributes:
        unit: Whose.
        law: How they come about.
        tried: Patterns of losses, by split.
        gains: By how much they are likelier than none, of the splits that judge.
    """

    unit: Unit
    law: LossLaw
    tried: Mapping[str, Tried]
    gains: Sequence[float]

    @classmethod
    def of(cls, data: Mapping[str, LossSegments], unit: Unit, alone: Alone) -> _Losses:
        tried, base = {name: one.tried(unit) for name, one in data.items()}, alone.law
        judged = [tried[name] for name in JUDGED]
        scatters = [s for s in SCATTER.tolist() if s <= base.scatter][-3:]
        law = likeliest(judged, SHARES, scatters, SPOILED, size=base.size)
        gains = [cost - law.deviance([one]) for cost, one in zip(alone.costs, judged, strict=True)]
        return cls(unit, law, tried, gains)

    @property
    def gain(self) -> float:
        """By how much they are likelier than none, of all splits that judge."""
        return sum(self.gains)

    def explaining(
        self, alone: Alone, others: Sequence[Unit], *, lone: bool = False
    ) -> Chance | None:
        """Return them as found if they explain what they spoil.

        Args:
            alone: The law without losses.
            others: Effects that they are beside.
            lone: Whether no other of several sensors seems to have lost samples, too.
        """
        law = self.law
        if self.gain < _NEEDED:
            return None
        told = {name: law.told(one) for name, one in self.tried.items()}
        known = Told.joined([told[name] for name in JUDGED])
        if not _explain(self, known, alone=alone, others=others, lone=lone):
            return None
        judged = [self.tried[name] for name in JUDGED]
        share, low, high = np.minimum(law.share_within(judged), self.unit.high)
        shown = told["test"]
        if (shown.lost > LIKELIER).sum() < FEWEST:  # so rare that test runs have hardly any
            shown = Told.joined(list(told.values()))
        sound = shown.spoiled <= LIKELIER
        return Chance(
            unit=self.unit,
            strength=float(share),
            error=_WIDER * float(high - low) / _INTERVAL,
            gain=self.gain,
            deviance=sum(alone.costs) - self.gain,
            left=shown.after[sound],
            before=float(shown.before[sound].mean()),
        )


def _explain(
    losses: _Losses, known: Told, *, alone: Alone, others: Sequence[Unit], lone: bool
) -> bool:
    """Return whether losses explain the segments that have them, and little else is wrong."""
    law, gains = losses.law, losses.gains
    concerned = known.lost > LIKELIER
    if concerned.sum() < FEWEST:
        return False
    before, after = (
        float((e[concerned] - law.scatter).mean()) for e in (known.before, known.after)
    )
    evident = losses.gain > EVIDENT
    clear = evident and after < _CLEARLY * before
    # what is not quite the true delay, or gain, errs in all that moves, and not in one sensor alone
    if _sensed(others) and not clear and not (evident and lone):
        return False
    surely = bool(others) and clear
    # where losses come in bursts, the runs that judge may have had hardly any; and a few segments
    # that something else spoils look a little like losses, in the runs where they are
    least = -max(_LIKELY, _FEW * gains[0] if surely else 0.0)
    if gains[1] < (_AS_MUCH * gains[0] if others and not clear else least):
        return False
    # parameters that were fitted without losses are a little off everywhere
    noise = max(NOISE, min(LEFT, 1.0 + _BIASED * before))
    spoiled = max(_OTHERS, _REMAIN * alone.spoiled, WRONG if surely else 0.0)
    if law.scatter > noise or spoiled_share(known) > spoiled:
        return False  # something else is wrong everywhere, and may look like this
    if (abs(after) if others else after) > _EXPLAINED * before:
        return False
    return not others or _plausible_beside(losses, known, clear=clear, colliding=alone.colliding)


def _plausible_beside(losses: _Losses, known: Told, *, clear: bool, colliding: bool) -> bool:
    """Return whether losses beside effects are what they look like.

    Commands have to be seen one by one. Where a robot may touch something, samples that were lost
    have to leave noise: an impact that is a little off holds a velocity, too, in a few segments and
    not quite.
    """
    law, unit = losses.law, losses.unit
    concerned = known.lost > LIKELIER
    if isinstance(unit.effect, PacketDrop):
        return clear and losses.gain > _SEEN * concerned.sum() and law.share <= unit.high
    return not colliding or law.leaves_noise(known.before[concerned], known.after[concerned])
