"""What the report says of effects of chance: findings, figures, candidates."""

from __future__ import annotations

__all__ = ["Recorded", "Scatter", "Sent", "gap_with_holds"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import Effect
from ..effects.robot import Robot
from ..effects.sensors import SensorDropout
from ..logs.log import Log
from .chance import Chance
from .contacts import settled
from .holds import Hold
from .objective import Objective, Point, Unit, strengths_of, units_of
from .preparation import Prepared
from .report import Candidate, Finding
from .segments import Segments
from .selection import Selection
from .shrinkage import Shrinkage
from .splits import split
from .validation import NEGLIGIBLE

_DRAWS = 1000
_MOST = 0.5  # of what effects leave


class Recorded(NamedTuple):
    """Mean squared innovations of test segments, samples that were held among them.

    Attributes:
        refit: As they were recorded, without effects.
        effects: With those that last.
        bridged: The same with other samples in the place of those that were held.
    """

    refit: float = 1.0
    effects: float = 1.0
    bridged: float = 1.0

    @property
    def matter(self) -> bool:
        """Whether held samples are most of what effects leave, and that is more than noise."""
        left = self.effects - 1.0
        return left > NEGLIGIBLE - 1.0 and self.effects - self.bridged > _MOST * left


def gap_with_holds(prepared: Prepared, logs: Sequence[Log], selection: Selection) -> Recorded:
    """Return what is left of test segments cut from the logs as recorded, and as bridged."""
    test = prepared.sets["test"]
    if test.segments.uncertainty is not None:  # the held samples entered the estimates too
        return Recorded()
    whole, size = split(logs)["test"], len(test.segments)
    if test.segments.touching is not None:
        theta = test.theta(selection.nominal.fit.point.z)
        whole = settled(prepared.predictor, whole, theta=theta, noise=prepared.noise)
    pieces = prepared.mode.cut(whole, prepared.horizon, history=test.segments.history, most=size)
    if len(pieces) != size:
        return Recorded()
    points = [selection.nominal.fit.point, selection.best.fit.point]
    return Recorded(*_along(test, pieces, points), *_along(test, test.segments, points[1:]))


def _along(test: Objective, pieces: Segments, points: Sequence[Point]) -> NDArray[np.float64]:
    """Return mean squared innovations of points on other segments of the same runs, ``(P,)``."""
    left = test.along(pieces)(points)
    total = np.asarray((left**2).sum((1, 2)), dtype=np.float64)
    return total / (test.whitening.weights**2).sum() / left.shape[2]


@dataclass(frozen=True)
class Sent:
    """Mean squared innovations of test segments with the commands that were sent.

    Where others are taken to have acted, on which everything else is compared; or of samples as
    they were recorded, where those that were lost are interpolated.

    Attributes:
        raw: At the prior's mean.
        refit: With parameters that were fitted to these.
        effects: With the effects that last, and parameters that were fitted beside them.
        lost: How many commands, or samples, of all runs are taken to have been others.
        of: How many there are.
        samples: Whether they are samples.
    """

    raw: float
    refit: float
    effects: float
    lost: int
    of: int
    samples: bool = False

    @classmethod
    def along(cls, prepared: Prepared, sent: Prepared, selection: Selection) -> Sent:
        """Return them for what was found on the commands that arrived.

        Args:
            prepared: With these.
            sent: The same runs with those that were sent.
            selection: What was found.
        """
        test, nominal = prepared.sets["test"], sent.nominal.point
        size, history = len(test.segments), test.segments.history
        pieces = prepared.mode.cut(sent.logs["test"], prepared.horizon, history=history, most=size)
        points = [Point(np.zeros_like(nominal.z)), nominal, selection.best.fit.point]
        logs = [
            pair
            for name, part in sent.logs.items()
            for pair in zip(part, prepared.logs[name], strict=True)
        ]
        counts = [
            sum(
                int((getattr(one, name) != getattr(other, name)).any(1).sum())
                for one, other in logs
            )
            for name in ("ctrl", "qpos", "qvel")  # a velocity may be estimated from positions
        ]
        lost = next((count for count in counts if count), 0)
        raw, refit, effects = _along(test, pieces, points).tolist()
        rows = sum(len(one) for one, _ in logs)
        return cls(raw, refit, effects, lost, rows, samples=not counts[0])

    def share(self, refit: float, effects: float) -> float:
        """Return the share of the gap that losses have of what they and the effects remove.

        The mean over which of the two comes first (Shapley 1953), at least nothing in either order.

        Args:
            refit: The same of the commands that arrived, with fitted parameters.
            effects: And with the effects.

        Example:
            >>> Sent(raw=9.0, refit=5.0, effects=3.0, lost=4, of=100).share(3.0, 1.0)
            0.5
        """
        alone = max(self.refit - refit, 0.0)
        beside = max(self.effects - effects, 0.0)
        return min(0.5 * (alone + beside) / max(self.refit - effects, 1e-9), 1.0)

    @property
    def note(self) -> str:
        """What the reader must know."""
        if self.samples:
            return (
                f"{self.lost} of {self.of} samples are taken to have been lost, and interpolated; "
                "the gap without causes is of the logs as recorded, all else, of test runs too, "
                "of those with the interpolated"
            )
        return (
            f"{self.lost} of {self.of} commands are taken to have been lost; the gap without "
            "causes is of those that were sent, all else, of test runs too, of those that arrived"
        )


@dataclass(frozen=True, eq=False)
class Scatter:
    """What was found of effects of chance.

    Attributes:
        found: Those that explain the scatter, the likeliest first.
        least: Of each that was looked for, the least strength that would have been seen.
        holds: Channels whose samples were not always renewed.
        recorded: What is left of test segments with samples as they were recorded.
        hidden: Names of those that what was found to be late may be in truth.
        sent: Of the commands that were sent, where others are taken to have arrived.
    """

    found: Sequence[Chance]
    least: Mapping[Unit, float]
    holds: Sequence[Hold]
    recorded: Recorded
    hidden: Sequence[str] = ()
    sent: Sent | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of what was found; the data do not tell them apart."""
        return tuple(dict.fromkeys(chance.unit.name for chance in self.found))

    @property
    def beside(self) -> bool:
        """Whether what was found acts beside the effects of the search, not in their place."""
        return bool(self.found) and self.found[0].beside

    @property
    def groups(self) -> set[str]:
        """The groups of what was found in the place of other effects."""
        return set() if self.beside else {chance.unit.effect.group for chance in self.found}

    def lasting(self, prepared: Prepared, selection: Selection) -> float:
        """Return the share of the gap that effects that last have, beside commands that were lost.

        Args:
            prepared: Logs with the commands that arrived.
            selection: What was found on them.
        """
        if self.sent is None:
            return 1.0
        points = [selection.nominal.fit.point, selection.best.fit.point]
        left = (prepared.sets["test"](points) ** 2).mean((1, 2)).tolist()
        return 1.0 - self.sent.share(*left)

    def measured(self, before: Shrinkage, generator: np.random.Generator) -> Shrinkage:
        """Return how far the gap shrinks with the likeliest, standardised by its own scatter."""
        left, refit = self.found[0].left, before.refit
        if self.found[0].before is not None:
            refit = self.found[0].before
        draws = left[generator.integers(len(left), size=(_DRAWS, len(left)))].mean(1)
        excess = max(refit - 1.0, 1e-2)  # less cannot be shared out
        low, high = np.quantile(draws, [0.025, 0.975]).tolist()
        after = float(left.mean())
        share = [min((refit - value) / excess, 1.0) for value in (after, high, low)]
        if self.beside:
            return _further(before, *share)
        return replace(
            before,
            raw=max(before.raw, refit),
            refit=refit,
            effects=after,
            explained=share[0],
            explained_ci=(share[1], share[2]),
            remainder_ci=(low - 1.0, high - 1.0),
        )

    def scattered(self, before: Shrinkage, generator: np.random.Generator) -> Shrinkage:
        """Return the same by the scatter of the likeliest, where that has one of its own."""
        alone = self.found[0].alone
        if alone is None:
            return before
        refit = min(alone, before.refit)
        part = max(refit - 1.0, 0.0) / max(before.refit - 1.0, 1e-9)
        low, high = before.excess_ci
        measured = self.measured(before, generator)
        return replace(measured, refit=refit, excess_ci=(part * low, part * high))

    def with_holds(self, before: Shrinkage) -> Shrinkage:
        """Return how far the gap of the samples as they were recorded shrinks."""
        refit = max(self.recorded.refit, before.refit)
        return self._from(before, max(before.raw, refit), refit)

    def with_arrivals(self, before: Shrinkage, sent: Sent) -> Shrinkage:
        """Return how far the gap of the commands as they were sent shrinks."""
        return self._from(before, sent.raw, max(sent.refit, before.effects))

    def _from(self, before: Shrinkage, raw: float, refit: float) -> Shrinkage:
        excess = max(refit - 1.0, 1e-9)
        share, high, low = (
            float(np.clip((excess - left) / excess, 0.0, 1.0))
            for left in (before.effects - 1.0, *before.remainder_ci)
        )
        return replace(
            before,
            raw=raw,
            refit=refit,
            explained=share,
            explained_ci=(low, high),
            excess_ci=(
                min(max(before.excess_ci[0], 0.5 * (refit - 1.0)), refit - 1.0),
                refit - 1.0,
            ),
        )

    def held_findings(self, measured: Shrinkage, others: float) -> tuple[Finding, ...]:
        """Return the channels whose samples are held, as the report has them.

        Args:
            measured: How far the gap shrinks.
            others: The share that other effects have.
        """
        if not self.holds:
            return ()
        strengths = {hold.channel: hold.share for hold in self.holds}
        mean = float(np.mean(list(strengths.values())))
        half = 1.96 * float(np.mean([hold.error for hold in self.holds]))
        return (
            Finding(
                name=SensorDropout.name,
                where=next(iter(strengths)) if len(strengths) == 1 else "all",
                strength=mean,
                unit=SensorDropout.unit,
                ci95=(max(mean - half, 0.0), mean + half),
                p_value=0.0,
                share_of_gap=max(measured.explained - others, 0.0),
                strengths=strengths,
            ),
        )

    def findings(
        self, measured: Shrinkage, robot: Robot, *, others: float = 0.0
    ) -> tuple[Finding, ...]:
        """Return the likeliest as the report has it.

        Args:
            measured: How far the gap shrinks.
            robot: Whose effects they are.
            others: The share that effects beside it have.
        """
        first = self.found[0]
        half = 1.96 * first.error
        return (
            Finding(
                name=first.unit.name,
                where=first.unit.where,
                strength=first.strength,
                unit=first.unit.measured_in(robot),
                ci95=(max(first.strength - half, 0.0), first.strength + half),
                p_value=float(np.exp(-first.gain / 2)),
                share_of_gap=max(measured.explained - others, 0.0),
                strengths={first.unit.where: first.strength},
                form=first.unit.effect.form,
            ),
        )

    def credited(self, effects: Sequence[Finding], robot: Robot) -> dict[Unit, float]:
        """Return effects of chance with their credit, where those that last have 1 together.

        Args:
            effects: What was found, as the report has it.
            robot: Whose effects they are.
        """
        units = [chance.unit for chance in self.found[:1]]
        if self.holds:
            units += units_of([SensorDropout()], robot)
        mine = {(unit.name, unit.where): unit for unit in units}
        shares = {mine.get((e.name, e.where)): e.share_of_gap for e in effects}
        others = sum(e.share_of_gap for e in effects if (e.name, e.where) not in mine)
        return {u: share / max(others, 1e-3) for u, share in shares.items() if u is not None}

    def strengths(self, robot: Robot) -> dict[Effect, dict[str, float]]:
        """Return the strength of the likeliest by target, as `Report.apply` sets it."""
        first = self.found[0]
        on = strengths_of([Point(np.zeros(1), {first.unit: first.strength})], robot)
        return {
            effect: dict(zip(effect.targets(robot), values[0].tolist(), strict=True))
            for effect, values in on.items()
        }

    def candidates(self, robot: Robot) -> list[Candidate]:
        """Return what the data say of each that was looked for."""
        every = dict.fromkeys((chance.unit for chance in self.found), np.inf) | dict(self.least)
        return [self._candidate(unit, least, robot) for unit, least in every.items()]

    def _candidate(self, unit: Unit, least: float, robot: Robot) -> Candidate:
        strength, error, gain = self._known(unit)
        return Candidate(
            name=unit.name,
            where=unit.where,
            strength=strength,
            ci95=(strength - 1.96 * error, strength + 1.96 * error) if strength else None,
            likelihood_ratio=gain,
            p_value=float(np.exp(-gain / 2)),
            held_out_gain=None,
            explained_fraction=0.0,
            explained_by_parameters=0.0,
            minimal_detectable_strength=least if np.isfinite(least) else None,
            status=self._status(unit, least),
            form=unit.effect.form,
            unit=unit.measured_in(robot),
        )

    def _known(self, unit: Unit) -> tuple[float, float, float]:
        """Return strength, its error and the deviance gained, zeros where it was not found."""
        for hold in self.holds:
            if (SensorDropout.name, hold.channel) == (unit.name, unit.where):
                return hold.share, hold.error, (hold.share / hold.error) ** 2
        for chance in self.found:
            if chance.unit == unit:
                return chance.strength, chance.error, chance.gain
        return 0.0, 0.0, 0.0

    def _status(self, unit: Unit, least: float) -> Any:
        if self._known(unit)[0]:
            held = unit.name == SensorDropout.name and self.holds
            return "named" if held or unit == self.found[0].unit else "confounded"
        if unit.name in self.hidden:
            return "confounded"
        if self.found or (self.holds and unit.name == SensorDropout.name):
            return "rejected"
        return "ruled_out" if np.isfinite(least) else "not_excited"


def _further(before: Shrinkage, share: float, low: float, high: float) -> Shrinkage:
    """Return how far the gap shrinks if such a share, with its interval, of what is left goes."""

    def more(explained: float, of_rest: float) -> float:
        return explained + max(1.0 - explained, 0.0) * max(of_rest, 0.0)

    return replace(
        before,
        effects=min(before.effects, 1.0 + (before.effects - 1.0) * (1.0 - max(share, 0.0))),
        explained=more(before.explained, share),
        explained_ci=(more(before.explained_ci[0], low), more(before.explained_ci[1], high)),
        remainder_ci=(
            min(before.remainder_ci[0], before.remainder_ci[0] * (1.0 - max(high, 0.0))),
            min(before.remainder_ci[1], before.remainder_ci[1] * (1.0 - max(low, 0.0))),
        ),
    )
