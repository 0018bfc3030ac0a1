"""The graded verdict, and one sentence that a roboticist can act on.

A goodness-of-fit test always rejects in the end, so the verdict weighs how large the gap is and
how much of it the effects explain, not only whether it is significant::

    none           nothing significant, or an excess below 5 % of the noise floor
    named          effects explain at least 80 %, surely 40 % and of other motions some, and what is
                   left is not significant, there or to the search (p < 1e-4) where test runs say
                   little, or 2 % and no more than the noise, of several effects a fifth of it
    named_partial  effects explain at least 40 %; the rest is located. Or 80 % on validation runs,
                   where test runs hardly show the gap. Or perhaps 40 %, of a cause that is certain
                   and surely helps on test runs, and leaves less than the noise once more. Or of a
                   gap hardly above noise what all other runs together show (p < 1e-4), what those
                   of the fit surely show and noise alone is left of, or chance that is certain,
                   where test runs do not speak against it
    ambiguous      effects of different kinds explain the data equally well
    unknown        the gap is real, and the catalogue explains less than 40 % of it, or perhaps none
    not_testable   the data are too few or too uniform to say
"""

from __future__ import annotations

__all__ = ["conclude"]

from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
from scipy.stats import chi2

from ..logs.system import System
from .divergence import HINT
from .free_numbers import fitted_numbers
from .model import shown_by_the_fit, shown_together, total_gain
from .preparation import Prepared
from .report import Candidate, Finding, Verdict
from .selection import Selection
from .sentence import sentence
from .shrinkage import Shrinkage
from .validation import (
    NAMED,
    NEGLIGIBLE,
    PARTIAL,
    SHOWN,
    SURE,
    enough,
    hardly_shown,
    share_on_validation,
)

_UNEXPLAINED = 1.5  # mean squared innovation of every split, to speak of an unknown cause
_PLAIN = 4.0  # the same, to need no interval: few segments have a wide one, as about impacts
_CERTAIN = 1e-15  # p-value of a gap that is too small to be seen at a glance
_DOUBTLESS = 1e-4  # the same, where all runs of the search together show an effect
_MISSING = 1e-4  # the same, of what is left beside the effects
_MOST = 0.5  # of the joints without measured velocity
_NOISE_AGAIN = 2.0  # mean squared innovation: as much again as the noise
_ALL = 0.98
_NO_WORSE, _WORSE = 1.02, 1.1  # times what parameters alone leave on test runs


def conclude(
    system: System,
    prepared: Prepared,
    *,
    selection: Selection,
    measured: Shrinkage,
    effects: Sequence[Finding],
    candidates: Sequence[Candidate],
    confused: Sequence[str],
    scattered: Set[str],
    where: Mapping[str, Any],
    diverges: bool,
    odd: Collection[str],
    baseless: bool,
    doubts: Sequence[str],
    alpha: float,
) -> tuple[Verdict, str, list[str], float | None]:
    """Return the verdict, the sentence, further alarms, and what validation runs say.

    The last is the share of the gap that is explained on these, where they speak for test runs that
    hardly show the gap, and nothing otherwise.

    Args:
        system: The robot.
        prepared: Split, noise, horizon, nominal fit.
        selection: What the search found.
        measured: How far the gap shrinks.
        effects: What was found, chance among it.
        candidates: What the data say about every effect.
        confused: Names that cannot be told from the cause, itself first.
        scattered: Groups of the effects of chance that were found.
        where: The error's place.
        diverges: Whether the simulator lives through no whole run.
        odd: Runs that depart from the simulator, even with the effects, as no other does.
        baseless: Whether no effect was found that the data bear out.
        doubts: Why nothing should be named without reserve.
        alpha: Level of the tests.
    """
    guessed = prepared.sets["train"].segments.smoothed
    weighed = _Weighed.of(
        selection, measured, effects, scattered=scattered, alpha=alpha, guessed=guessed
    )
    obstacle = _obstacle(system, prepared, diverges=diverges)
    verdict: Verdict
    if obstacle is not None:
        verdict = "not_testable"
    elif baseless:  # nothing was found, or nothing that the data bear out
        verdict = "unknown" if weighed.visible else "none"
    else:
        groups = {u.effect.group for u in selection.best.units if u.name in confused[:1]}
        first = selection.screens[:1]
        groups |= {u.effect.group for s in first for u in s.units if u.name in confused}
        verdict = weighed.named(ambiguous=len(groups | scattered) > 1 and len(confused) > 1)
    few = len(prepared.names["train"]) == 1 and prepared.alarms
    if verdict == "named" and (few or odd or doubts):
        verdict = "named_partial"
    if verdict == "none" and odd:
        verdict = "unknown"
    names = verdict.startswith("named") or verdict == "ambiguous"
    alarms = [obstacle[0]] if obstacle else [*doubts] if names else []
    partly = verdict == "named_partial" and weighed.unsaid
    validated = weighed.validated if weighed.elsewhere and verdict == "named_partial" else None
    text = sentence(
        verdict,
        system,
        prepared,
        measured=measured,
        effects=effects,
        candidates=candidates,
        confused=confused,
        validated=validated,
        unshown=partly and weighed.together and not weighed.helps,
        where=where,
        odd=odd,
        hint=obstacle[1] if obstacle else "",
    )
    return verdict, text, alarms, validated


@dataclass(frozen=True)
class _Weighed:
    """What speaks for a gap, and for what was found.

    Attributes:
        measured: How far the gap shrinks on test runs.
        significant: Whether the search found something that helps, or chance, surely.
        certain: Whether noise alone would never do this.
        visible: Whether the gap can be seen without a cause.
        validated: Share of the gap that is explained on validation runs.
        unsaid: Whether test runs do not say that what was found explains it.
        elsewhere: Whether validation runs do in their place.
        helps: Whether it surely helps on test runs, however much of the gap it explains.
        together: Whether all other runs together show it, of a gap that is hardly above noise, or
            those of the fit surely do, and all of it, or it is chance and certain.
        several: Whether several effects were found.
        remains: Whether the search is sure that something else is missing, that lasts.
    """

    measured: Shrinkage
    significant: bool
    certain: bool
    visible: bool
    validated: float
    unsaid: bool
    elsewhere: bool
    helps: bool
    together: bool
    several: bool
    remains: bool

    @classmethod
    def of(
        cls,
        selection: Selection,
        measured: Shrinkage,
        effects: Sequence[Finding],
        *,
        scattered: Set[str],
        alpha: float,
        guessed: bool = False,
    ) -> _Weighed:
        p_value = selection.p_values[0]
        innovations = selection.nominal.fit.innovations, selection.nominal.validation
        others = [float((m**2).mean()) for m in innovations]
        certain = p_value < _CERTAIN
        least, lowest = min(measured.refit, *others), 1.0 + measured.excess_ci[0]
        shown = least > _UNEXPLAINED or (measured.refit > SHOWN and p_value < SURE)
        shown |= lowest > SHOWN and max(others) > _UNEXPLAINED
        # where segments begin is itself fitted with this simulator if nobody measured it
        visible = least > _PLAIN or (lowest > 1.0 and shown and not guessed)
        validated = share_on_validation(selection) if effects else 0.0
        # runs that hold little of what chance does say nothing against it, if it is sure
        surely = min((e.p_value for e in effects), default=1.0) < _CERTAIN
        by_chance = bool(scattered) and (surely or measured.refit > SHOWN)
        together = p_value < _DOUBTLESS and shown_together(selection.nominal, selection.best)
        alone = certain and shown_by_the_fit(selection.nominal, selection.best)
        together |= (alone or (bool(scattered) and surely)) and measured.refit < SHOWN
        together &= measured.effects < _NO_WORSE * measured.refit and not guessed
        perhaps_nothing = measured.explained_ci[0] <= 0 and validated < PARTIAL and not by_chance
        unsaid = measured.explained < PARTIAL or perhaps_nothing
        contradicted = measured.effects > SHOWN * measured.refit  # by what test runs do show
        elsewhere = unsaid and hardly_shown(measured, validated) and validated >= enough(p_value)
        elsewhere &= not contradicted
        helps = certain and measured.p_value < alpha and measured.explained_ci[1] >= PARTIAL
        helps &= measured.effects <= _NOISE_AGAIN
        borne_out = certain or measured.effects < measured.refit or validated >= PARTIAL
        found = p_value <= alpha and borne_out
        found &= certain or not guessed
        found &= certain or not _of_either_sign(selection, effects)
        found &= bool(selection.best.units) and _gained_by_noise(selection) <= alpha
        significant = found or by_chance
        # told as one cause or not: together, laws imitate many a third one nearly
        several = len(effects) > 1 or len(selection.best.names) > 1
        return cls(
            measured, significant, certain, visible, validated, unsaid, elsewhere, helps, together,
            several, remains=selection.missing < _MISSING and not scattered,
        )  # fmt: skip

    def named(self, *, ambiguous: bool) -> Verdict:
        """Return the verdict on effects that were found."""
        measured = self.measured
        if measured.refit <= NEGLIGIBLE and measured.excess_ci[0] <= 0:
            # seen by the search, but too small to matter on the test runs, which it must not worsen
            worse = measured.effects > _WORSE * measured.refit
            return "named_partial" if self.significant and not worse else "none"
        if self.unsaid:
            sure = self.visible or self.certain
            borne_out = self.elsewhere or self.helps or self.together
            return "named_partial" if borne_out else "unknown" if sure else "none"
        if ambiguous:
            return "ambiguous"
        # of a large gap, 2 % may be ten times the noise: proof that the law is another one; two
        # laws together imitate many a third one nearly
        most = SHOWN if self.several else _NOISE_AGAIN
        nearly_all = measured.explained >= _ALL and measured.effects <= most
        low, high = (1.0 + end for end in measured.remainder_ci)
        # few test segments say little of what is left; the runs of the search may be sure of it
        left = low > NEGLIGIBLE or (self.remains and high > NEGLIGIBLE)
        left &= not nearly_all
        borne_out = measured.explained >= NAMED and measured.explained_ci[0] >= PARTIAL
        # what may explain nothing of other motions is no cause that is known
        borne_out &= measured.elsewhere[0] > 0.0
        # a share of an error that fitting made larger flatters the effects
        borne_out &= not measured.misled or measured.of_raw >= NAMED
        return "named" if borne_out and not left else "named_partial"


def _gained_by_noise(selection: Selection) -> float:
    """Return how often noise alone would let fits of any so many effects gain as much.

    The screen extrapolates a match in proportion to strength; a law that is not proportional, such
    as rounding, may gain nothing when it is fitted.
    """
    best, offered = selection.best, selection.offered
    tail = chi2.sf(total_gain(selection.nominal, best), fitted_numbers(best, offered))
    return min(1.0, comb(len(offered), len(best.names)) * float(tail))


def _of_either_sign(selection: Selection, effects: Sequence[Finding]) -> bool:
    """Return whether all effects can push both ways, and may do so by their intervals."""
    signed = {unit.name for unit in selection.best.units if unit.low < 0}
    sure = any(e.name not in signed or e.ci95[0] >= 0 or e.ci95[1] <= 0 for e in effects)
    return bool(effects) and not sure


def _obstacle(system: System, prepared: Prepared, *, diverges: bool) -> tuple[str, str] | None:
    """Return why nothing can be said, and what to do about it, if so."""
    if not _excited(system, prepared):
        why = "commands and motion hardly vary: no effect can be told from another"
        return why, "record motion that exceeds the noise"
    if _too_fast(prepared):
        rate = f"{1 / system.control_dt:.3g} Hz"
        why = f"the robot moves too fast for velocities to be told from positions at {rate}"
        return f"{why}: log velocities, or more rows a second", "sample faster"
    if diverges:
        why = "the simulator diverges on every whole test run, which the robot lived through"
        return f"{why}: {HINT}", f"the simulator diverges, {HINT}"
    return None


def _excited(system: System, prepared: Prepared) -> bool:
    """Return whether the robot moved by more than its sensors' noise."""
    segments = prepared.sets["train"].segments
    turned = prepared.predictor.tangent.difference(segments.qpos[:1, :1], segments.qpos)
    moved = np.concatenate([turned, segments.qvel], -1)
    spread = moved.reshape(-1, moved.shape[-1]).std(0)[list(system.channel_index)]
    return bool((spread > 5.0 * prepared.noise).any())


def _too_fast(prepared: Prepared) -> bool:
    """Return whether most velocities that were not measured are guesses."""
    segments = prepared.sets["train"].segments
    # of other joints' velocities no error is known
    robot = prepared.predictor.system.robot
    guessed = [dof for dof in robot.dof_index if segments.velocity_gain[dof] > 0]
    known = segments.qvel.reshape(-1, segments.qvel.shape[-1]).std(0)
    return bool(guessed) and (segments.velocity_error > known)[guessed].mean() > _MOST
