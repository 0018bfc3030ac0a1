"""Losses, found one by one: commands that did not arrive, samples that were not renewed.

A value that is lost leaves the last one in its place. If one in fifty is, most segments have none,
and their mean and covariance say little; but where it happened it can be seen. In short segments
every pattern of a few losses is tried (`loss_law`), and what must be beaten is the same law without
losses, where some segments are spoiled by something else: losses have to explain what they spoil,
and not only that some segments are worse than others. They are looked for in the place of the
effects that the search found, and beside them.

Effects of commands are nearly linear in them over so few steps, so every pattern is made of one
simulation per step, in which the command of that step is the one before it: of one loss that is
what happened, whatever the drive does with commands. Those of samples are the simulated values.
"""

from __future__ import annotations

__all__ = ["losses"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..effects.action import PacketDrop
from ..effects.contacts import ContactFriction
from ..effects.sensors import SensorDropout
from .chance import Chance
from .contacts import resting
from .loss_law import LossLaw, Told, Tried, likeliest
from .model import Model
from .modes import Mode
from .objective import Objective, Point, Unit, strengths_of
from .preparation import Prepared
from .segments import cut
from .selection import Selection

Array = NDArray[np.float64]
Patterns = Sequence[tuple[bool, ...]]
_STEPS = 8  # of a segment
_TOGETHER = 4  # losses in a segment, at most
_JUDGED = "train", "validation"  # splits that say what is lost
_MOST = {"train": 90, "validation": 45, "test": 45}  # segments
_SHARES = (0.01, 0.02, 0.04, 0.08, 0.15, 0.25, 0.4, 0.6)  # s
_SCATTER = np.geomspace(0.5, 4.0, 10)  # φ
_SPOILED = (0.003, 0.01, 0.03, 0.1, 0.3)  # η
_NUDGE, _SAME = 0.2, 0.01  # of the largest command, and of that: a change that is none
# deviances: to be found (contacts that come late look like a few losses), and that chance makes
_NEEDED, _LIKELY = 40.0, 6.0
_EXPLAINED = 0.5  # of the excess of the segments concerned, by what is left of them
_NOISE = 1.2  # scatter that noise has
_STANDS_OUT = 1.0  # excess of segments with lost commands, to be found beside an effect
_BIASED = 0.1  # of the excess of the segments concerned, which parameters leave in all
_LEFT = 2.0  # mean squared innovation of what has not explained the losses
_OTHERS = 1 / 6  # of the segments that something else may have spoiled
_REMAIN = 0.6  # or of those that were spoiled without losses
_FEWEST = 4  # segments with a loss
_INTERVAL = 3.92  # standard deviations that are 95 %
_WIDER = 1.5  # times: errors were, on robots whose share was known
_LIKELIER = 0.5  # probability that a segment has a loss, or is spoiled


@dataclass(frozen=True, eq=False)
class _Data:
    """Short segments of a split.

    Attributes:
        objective: Evaluates them.
        point: The simulator.
        left: Its innovations, shape ``(S, M)``.
    """

    objective: Objective
    point: Point
    left: Array

    @classmethod
    def of(cls, objective: Objective, point: Point) -> _Data:
        """Return the segments of an objective in a simulator."""
        return cls(objective, point, objective([point])[0])

    @property
    def without(self) -> Tried:
        """The segments without losses."""
        squares = (self.left**2).mean(-1)[None]
        return Tried(squares, np.zeros(1, dtype=np.int64), self.objective.segments.horizon)

    def tried(self, unit: Unit) -> Tried:
        """Return the segments under every pattern of losses."""
        targets, steps = np.flatnonzero(unit.direction), self.objective.segments.horizon
        commands = isinstance(unit.effect, PacketDrop)
        patterns = _patterns(steps if commands else 1 + steps)
        of = self._of_commands if commands else self._of_samples
        parts = [of(int(target), patterns) for target in targets]  # lost together
        columns, changes = (np.concatenate(part, -1) for part in zip(*parts, strict=True))
        squares = _squares(self.left, columns, changes)
        return Tried(squares, np.array([sum(p) for p in patterns]), len(patterns[0]))

    @cached_property
    def _known(self) -> dict[int, Array]:
        """Slopes by actuator."""
        return {}

    @cached_property
    def _simulated(self) -> Array:
        """What all channels would show, shape ``(S, H, C)``."""
        predictor = self.objective.predictor
        theta = self.objective.theta(self.point.z[None])
        strengths = strengths_of([self.point], predictor.system.robot)
        qpos, qvel = predictor.states(self.objective.segments, theta, strengths)
        return np.nan_to_num(predictor.sensing.values(qpos[0], qvel[0]))

    def _of_commands(self, actuator: int, patterns: Patterns) -> tuple[Array, Array]:
        """Return what a change of each command does, ``(S, M, T)``, and changes, ``(B, S, T)``."""
        segments = self.objective.segments
        at, steps = segments.history, segments.horizon
        sent = segments.ctrl[:, at - 1 : at + steps, actuator]
        changes = [sent[:, _last(lost)] - sent[:, 1:] for lost in patterns]
        return self._slopes(actuator, sent), np.stack(changes)

    def _slopes(self, actuator: int, sent: Array) -> Array:
        """Return what a change of each command of an actuator does, ``(S, M, T)``."""
        if actuator in self._known:
            return self._known[actuator]
        segments, robot = self.objective.segments, self.objective.predictor.system.robot
        at = segments.history
        least = _NUDGE * float(robot.command_scale[actuator])
        nudge = sent[:, :-1] - sent[:, 1:]
        nudge = np.where(np.abs(nudge) < _SAME * least, -least * np.sign(sent[:, 1:]), nudge)
        nudge = np.where(nudge == 0, -least, nudge)
        slopes = []
        for t in range(segments.horizon):
            ctrl = segments.ctrl.copy()
            ctrl[:, at + t, actuator] += nudge[:, t]
            moved = self.objective.along(replace(segments, ctrl=ctrl))([self.point])[0]
            slopes.append((moved - self.left) / nudge[:, t, None])
        self._known[actuator] = np.stack(slopes, -1)
        return self._known[actuator]

    def _of_samples(self, channel: int, patterns: Patterns) -> tuple[Array, Array]:
        """Return the same of samples, the start's first."""
        objective, segments = self.objective, self.objective.segments
        predictor, at = objective.predictor, segments.history
        sensing = predictor.sensing
        first = sensing.values(segments.qpos[:, at], segments.qvel[:, at])[:, channel]
        shown = np.c_[first, self._simulated[..., channel]]
        # a start that was not renewed is where the robot was a step before
        offsets = np.zeros((1, len(segments), 2 * predictor.tangent.size))
        offsets[0, :, sensing.channels[channel]] = shown[:, 1] - shown[:, 0]
        start = objective([self.point], segments.freed(offsets))[0] - self.left
        columns = objective.whitening.inverse[:, :, channel :: len(sensing.channels)]
        begun = np.ones(len(segments))
        changes = [  # what was measured, minus what would have been shown
            np.c_[begin * begun, shown[:, 1:] - shown[:, _last(lost)]] for begin, *lost in patterns
        ]
        return np.concatenate([start[..., None], columns], -1), np.stack(changes)


class _Alone(NamedTuple):
    """The likeliest law without losses, its deviances, and the share of segments it gives up."""

    law: LossLaw
    costs: list[float]
    spoiled: float
    segments: int

    @property
    def calm(self) -> bool:
        """Whether too few segments hold more than noise for losses to be found in them."""
        return self.law.scatter < _NOISE and self.spoiled * self.segments < _FEWEST

    @classmethod
    def of(cls, data: Mapping[str, _Data]) -> _Alone:
        """Return that of training and validation segments."""
        judged, size = [data[name].without for name in _JUDGED], data["train"].left.shape[1]
        law = likeliest(judged, (0.0,), _SCATTER.tolist(), _SPOILED, size=size)
        told = Told.joined([law.told(one) for one in judged])
        return cls(law, [law.deviance([one]) for one in judged], _spoiled(told), len(told.spoiled))


def losses(prepared: Prepared, selection: Selection, units: Sequence[Unit]) -> list[Chance]:
    """Return the losses that explain what is wrong with the segments that have them.

    The likeliest first, with those that are nearly as likely; none where whole trajectories or
    statistics are compared, or where effects that last leave noise alone.

    Args:
        prepared: Logs, noise and nominal fit.
        selection: What the search without chance found.
        units: Random effects at their targets; of those lost commands, of one actuator or of all
            at once, and samples of one target.
    """
    some = [u for u in units if isinstance(u.effect, PacketDrop | SensorDropout) and _as_one(u)]
    if not some or type(prepared.mode) is not Mode:
        return []
    nominal = _cut(prepared)
    best = {n: _Data.of(one.objective, selection.best.fit.point) for n, one in nominal.items()}
    rival = _Alone.of(best)
    if _explained(rival, selection.best):
        return []
    some = _telling(prepared, some)
    alone = _Alone.of(nominal)
    # what the best explanation without chance gains by the same standard
    found, least = _all_found(nominal, some, alone), sum(alone.costs) - sum(rival.costs)
    if selection.best.units and _apart(selection.best.units):
        others = _all_found(best, some, rival, beside=True)
        beside = [replace(one, beside=True) for one in others]
        if _most(beside) > _most(found) - least + _NEEDED:
            found, least = beside, 0.0
    kept = [one for one in found if one.gain > max(_NEEDED, least)]
    kept.sort(key=lambda one: -one.gain)
    return [one for one in kept if one.gain > kept[0].gain - _LIKELY]


def _explained(rival: _Alone, best: Model) -> bool:
    """Return whether effects that last leave noise alone.

    In short segments, where lost commands are hardly more than a lag, and in those of the search.
    """
    return bool(best.units) and rival.calm and best.dispersion() < _LEFT


def _telling(prepared: Prepared, units: Sequence[Unit]) -> list[Unit]:
    """Return the units but for samples of what rests: it chatters, and one is like the next."""
    predictor = prepared.predictor
    still = resting(predictor, prepared.logs["train"], noise=prepared.noise)
    rests = still[predictor.sensing.channels]
    return [u for u in units if isinstance(u.effect, PacketDrop) or not rests[u.direction.index(1)]]


def _apart(others: Sequence[Unit]) -> bool:
    """Return whether losses beside effects could not be another form of those.

    A lag that is not quite the true one, and contacts that stick and slip a little otherwise, err
    as samples and commands would that were lost.
    """
    known = [unit.effect for unit in others]
    alike = any(e.group == "timing" or e.channel == "sensing" for e in known)
    return not alike and not any(isinstance(e, ContactFriction) for e in known)


def _all_found(
    data: Mapping[str, _Data], units: Sequence[Unit], alone: _Alone, *, beside: bool = False
) -> list[Chance]:
    found = [_found(data, unit, alone, beside=beside) for unit in units]
    return [one for one in found if one is not None]


def _most(found: Sequence[Chance]) -> float:
    return max((one.gain for one in found), default=0.0)


def _spoiled(told: Told) -> float:
    return float((told.spoiled > _LIKELIER).mean())


def _as_one(unit: Unit) -> bool:
    """Return whether a unit is lost as one: a packet holds all commands, but no reading of all."""
    alone = unit.where != "all" or len(unit.direction) == 1
    return alone or isinstance(unit.effect, PacketDrop)


def _squares(left: Array, columns: Array, changes: Array) -> Array:
    """Return mean squares of ``left + columns @ changes``, ``(B, S)``.

    Args:
        left: Shape ``(S, M)``.
        columns: Shape ``(S, M, T)``.
        changes: Shape ``(B, S, T)``.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> left, columns, changes = (rng.normal(size=n) for n in ((2, 5), (2, 5, 3), (4, 2, 3)))
        >>> direct = ((left + np.einsum("smt,bst->bsm", columns, changes)) ** 2).mean(-1)
        >>> bool(np.allclose(_squares(left, columns, changes), direct))
        True
    """
    inner, gram = np.einsum("smt,sm->st", columns, left), columns.mT @ columns
    both = np.einsum("bst,bst->bs", changes, np.einsum("bst,stu->bsu", changes, gram))
    total = (left**2).sum(-1) + 2 * np.einsum("bst,st->bs", changes, inner) + both
    return np.maximum(total, 0.0) / left.shape[-1]


def _patterns(values: int) -> Patterns:
    """Return the patterns of a few losses among so many values, none first."""
    some = [c for count in range(_TOGETHER + 1) for c in combinations(range(values), count)]
    return [tuple(value in lost for value in range(values)) for lost in some]


def _last(lost: Sequence[bool]) -> list[int]:
    """Return for every step the one whose value is there, counted from the one before the first."""
    last = [0]
    for step, missing in enumerate(lost, 1):
        last.append(last[-1] if missing else step)
    return last[1:]


def _cut(prepared: Prepared) -> dict[str, _Data]:
    """Return short segments of every split, compared after each of their steps."""
    prior, point = prepared.predictor.system.prior, Point(prepared.nominal.point.z)
    history = max(prepared.sets["train"].segments.history, 1)
    found = {}
    for name, logs in prepared.logs.items():
        pieces = cut(logs, _STEPS, history=history, most=_MOST[name], burn_in=history)
        objective = prepared.mode.objective(
            prepared.predictor, prior, pieces, z=point.z, noise=prepared.noise
        )
        found[name] = _Data.of(objective, point)
    return found


def _found(data: Mapping[str, _Data], unit: Unit, alone: _Alone, *, beside: bool) -> Chance | None:
    """Return the losses of a unit, nothing if they do not explain what they spoil.

    Commands beside an effect have to stand out: a force law that is not quite the true one errs
    everywhere a little, as if ever so many of them were lost.
    """
    tried, base = {name: one.tried(unit) for name, one in data.items()}, alone.law
    judged = [tried[name] for name in _JUDGED]
    scatters = [s for s in _SCATTER.tolist() if s <= base.scatter][-3:]
    law = likeliest(judged, _SHARES, scatters, _SPOILED, size=base.size)
    gains = [cost - law.deviance([one]) for cost, one in zip(alone.costs, judged, strict=True)]
    if sum(gains) < _NEEDED or gains[1] < -_LIKELY:
        return None
    told = {name: law.told(one) for name, one in tried.items()}
    known = Told.joined([told[name] for name in _JUDGED])
    concerned = known.lost > _LIKELIER
    if concerned.sum() < _FEWEST:
        return None
    excess = [float((one[concerned] - law.scatter).mean()) for one in (known.before, known.after)]
    # parameters that were fitted without losses are a little off everywhere
    noise = max(_NOISE, min(_LEFT, 1.0 + _BIASED * excess[0]))
    if law.scatter > noise or _spoiled(known) > max(_OTHERS, _REMAIN * alone.spoiled):
        return None  # something else is wrong everywhere, and may look like this
    if excess[1] > _EXPLAINED * excess[0]:
        return None
    faint = law.share > unit.high or excess[0] < _STANDS_OUT
    if beside and isinstance(unit.effect, PacketDrop) and faint:
        return None
    share, low, high = np.minimum(law.share_within(judged), unit.high)
    shown = told["test"]
    if (shown.lost > _LIKELIER).sum() < _FEWEST:  # so rare that test runs have hardly any
        shown = Told.joined(list(told.values()))
    sound = shown.spoiled <= _LIKELIER
    return Chance(
        unit=unit,
        strength=float(share),
        error=_WIDER * float(high - low) / _INTERVAL,
        gain=sum(gains),
        left=shown.after[sound],
        before=float(shown.before[sound].mean()),
    )
