"""What the report says of effects of chance: findings, figures, candidates."""

from __future__ import annotations

__all__ = ["Scatter"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..effects.effect import Effect
from ..effects.robot import Robot
from ..effects.sensors import SensorDropout
from .as_recorded import Recorded, Sent, along
from .chance import Chance
from .holds import Hold
from .objective import Point, Unit, strengths_of, units_of
from .preparation import Prepared
from .report import Candidate, Finding
from .selection import Selection
from .shrinkage import Shrinkage

_DRAWS = 1000


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

    def lasting(self, prepared: Prepared, selection: Selection) -> float | None:
        """Return the share of the gap that effects that last have beside what was lost or late.

        Of the same figures as the report's. None where logs are compared as they are, which says
        nothing of chance beside the effects.

        Args:
            prepared: Logs with commands, or samples, in the place of those that were lost.
            selection: What was found on them.
        """
        if self.sent is None:
            return None
        test = prepared.sets["test"]
        points = [selection.nominal.fit.point, selection.best.fit.point]
        refit, effects = along(test, test.segments, points).tolist()
        first = self.found[0]
        if first.alone is not None:  # commands come late by times that vary, and that is noise here
            refit, effects = min(first.alone, refit), min(float(first.left.mean()), effects)
        return 1.0 - self.sent.share(refit, effects)

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
