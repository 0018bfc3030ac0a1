"""The graded verdict, and one sentence that a roboticist can act on.

A goodness-of-fit test always rejects in the end, so the verdict weighs how large the gap is and
how much of it the effects explain, not only whether it is significant::

    none           nothing significant, or an excess below 5 % of the noise floor
    named          effects explain at least 80 %, and what is left is not significant, or 2 % and
                   no more than the noise
    named_partial  effects explain at least 40 %; the rest is located. Or 80 % on validation runs,
                   where test runs hardly show the gap
    ambiguous      effects of different kinds explain the data equally well
    unknown        the gap is real, and the catalogue explains less than 40 % of it, or perhaps none
    not_testable   the data are too few or too uniform to say
"""

from __future__ import annotations

__all__ = ["conclude"]

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..logs.system import System
from .divergence import HINT
from .preparation import Prepared
from .report import Candidate, Finding, Verdict
from .selection import Selection
from .shrinkage import Shrinkage
from .validation import NAMED, SHOWN, SURE, enough, hardly_shown, share_on_validation

_NEGLIGIBLE = 0.05  # of the noise floor: an excess that no one would chase
_UNEXPLAINED = 1.5  # mean squared innovation of every split, to speak of an unknown cause
_PLAIN = 4.0  # the same, to need no interval: few segments have a wide one, as about impacts
_CERTAIN = 1e-15  # p-value of a gap that is too small to be seen at a glance
_MOST = 0.5  # of the joints without measured velocity
_WORSE = 1.2  # times the error as described, with parameters fitted to other runs
_PLACE = 0.2  # of the error, to say that it sits there
_NOISE_AGAIN = 2.0  # mean squared innovation: as much again as the noise
_ALL, _PARTIAL = 0.98, 0.4
# what readers know a law by, beside its strength
_FORMS = {"frequency": ", {:.3g} Hz", "number": ", {:.3g} per turn or 2π m"}


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
    doubts: Sequence[str],
    alpha: float,
) -> tuple[Verdict, str, list[str]]:
    """Return the verdict, the sentence, and further alarms.

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
        doubts: Why nothing should be named without reserve.
        alpha: Level of the tests.
    """
    weighed = _Weighed.of(selection, measured, effects, scattered=scattered, alpha=alpha)
    obstacle = _obstacle(system, prepared, diverges=diverges)
    verdict: Verdict
    if obstacle is not None:
        verdict = "not_testable"
    elif not effects:
        verdict = "unknown" if weighed.visible else "none"
    else:
        groups = {u.effect.group for u in selection.best.units if u.name in confused[:1]}
        first = selection.screens[:1]
        groups |= {u.effect.group for s in first for u in s.units if u.name in confused}
        verdict = weighed.named(ambiguous=len(groups | scattered) > 1 and len(confused) > 1)
    few = len(prepared.names["train"]) == 1 and prepared.alarms
    if verdict == "named" and (few or doubts):
        verdict = "named_partial"
    alarms = [obstacle[0]] if obstacle else [*doubts] if verdict.startswith("named") else []
    sentence = _sentence(
        verdict,
        system,
        prepared,
        measured=measured,
        effects=effects,
        candidates=candidates,
        confused=confused,
        validated=weighed.validated if weighed.elsewhere else None,
        where=where,
        hint=obstacle[1] if obstacle else "",
    )
    return verdict, sentence, alarms


@dataclass(frozen=True)
class _Weighed:
    """What speaks for a gap, and for what was found.

    Attributes:
        measured: How far the gap shrinks on test runs.
        significant: Whether the search, or chance, found something.
        certain: Whether noise alone would never do this.
        visible: Whether the gap can be seen without a cause.
        validated: Share of the gap that is explained on validation runs.
        unsaid: Whether test runs do not say that what was found explains it.
        elsewhere: Whether validation runs do in their place.
    """

    measured: Shrinkage
    significant: bool
    certain: bool
    visible: bool
    validated: float
    unsaid: bool
    elsewhere: bool

    @classmethod
    def of(
        cls,
        selection: Selection,
        measured: Shrinkage,
        effects: Sequence[Finding],
        *,
        scattered: Set[str],
        alpha: float,
    ) -> _Weighed:
        p_value = selection.p_values[0]
        innovations = selection.nominal.fit.innovations, selection.nominal.validation
        others = [float((m**2).mean()) for m in innovations]
        certain = p_value < _CERTAIN
        least, lowest = min(measured.refit, *others), 1.0 + measured.excess_ci[0]
        shown = least > _UNEXPLAINED or (measured.refit > SHOWN and p_value < SURE)
        shown |= lowest > SHOWN and max(others) > _UNEXPLAINED
        visible = least > _PLAIN or (lowest > 1.0 and shown)
        validated = share_on_validation(selection) if effects else 0.0
        perhaps_nothing = measured.explained_ci[0] <= 0 and validated < _PARTIAL and not scattered
        unsaid = measured.explained < _PARTIAL or perhaps_nothing
        elsewhere = unsaid and hardly_shown(measured) and validated >= enough(p_value)
        significant = p_value <= alpha or bool(scattered)
        return cls(measured, significant, certain, visible, validated, unsaid, elsewhere)

    def named(self, *, ambiguous: bool) -> Verdict:
        """Return the verdict on effects that were found."""
        measured = self.measured
        if measured.refit - 1.0 <= _NEGLIGIBLE and measured.excess_ci[0] <= 0:
            # seen by the search, but too small to matter on the test runs
            return "named_partial" if self.significant else "none"
        if self.unsaid:
            sure = self.visible or self.certain
            return "named_partial" if self.elsewhere else "unknown" if sure else "none"
        if ambiguous:
            return "ambiguous"
        # of a large gap, 2 % may be ten times the noise: proof that the law is another one
        nearly_all = measured.explained >= _ALL and measured.effects <= _NOISE_AGAIN
        left = measured.remainder_ci[0] > _NEGLIGIBLE and not nearly_all
        return "named" if measured.explained >= NAMED and not left else "named_partial"


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
    moved = np.concatenate([segments.qpos, segments.qvel], -1)
    spread = moved.reshape(-1, moved.shape[-1]).std(0)[list(system.channel_index)]
    return bool((spread > 5.0 * prepared.noise).any())


def _too_fast(prepared: Prepared) -> bool:
    """Return whether most velocities that were not measured are guesses."""
    segments = prepared.sets["train"].segments
    guessed = segments.velocity_gain > 0
    known = segments.qvel.reshape(-1, segments.qvel.shape[-1]).std(0)
    return bool(guessed.any() and (segments.velocity_error > known)[guessed].mean() > _MOST)


def _sentence(
    verdict: Verdict,
    system: System,
    prepared: Prepared,
    *,
    measured: Shrinkage,
    effects: Sequence[Finding],
    candidates: Sequence[Candidate],
    confused: Sequence[str],
    validated: float | None,
    where: Mapping[str, Any],
    hint: str,
) -> str:
    gap = f"Gap: {measured.refit:.3g} times the noise floor on {prepared.horizon}-step prediction."
    ruled_out = _ruled_out(candidates)
    untested = _untested(candidates)
    parameters = ""
    if system.prior is not None and measured.raw > measured.refit:
        share = (measured.raw - measured.refit) / max(measured.raw - 1.0, 1e-9)
        parameters = f" Retuning parameters alone explains {_percent(share)}."
    elif measured.refit > _WORSE * measured.raw:
        parameters = (
            f" Retuning parameters alone makes test runs worse: {measured.raw:.3g} times the floor "
            "as described."
        )
    if verdict == "none":
        return f"{_no_gap(measured.refit)}{ruled_out}{untested}"
    if verdict == "not_testable":
        return f"These data cannot say: {hint}.{untested}"
    rules = where["regimes"]
    place = f" It sits at {rules[0]['rule']}." if rules and _much(rules[0]) else ""
    if verdict == "unknown":
        best = max((c.explained_fraction for c in candidates), default=0.0)
        best = max(best, measured.explained)
        tried = len({c.name for c in candidates})
        found = f"none of the {tried} effects that were tried explains more than {_percent(best)}"
        if best >= _PARTIAL:
            found = "what could explain it on some runs does not hold on others"
        text = f"{gap} It is real, but {found}."
        return f"{text}{place}{parameters}{untested}"
    causes = ", and ".join(_described(e) for e in effects)
    low, high = measured.elsewhere
    share = f"explains {_percent(measured.explained)} [{100 * low:.0f}, {100 * high:.0f}] of it"
    if validated is not None:
        share = f"explains {_percent(validated)} of it on validation runs, test runs hardly show it"
    if verdict == "ambiguous":
        others = ", ".join(confused)
        return (
            f"{gap} These data cannot tell the causes apart: {others}. The first, {causes}, "
            f"{share}.{parameters}{untested}"
        )
    text = f"{gap} Cause: {causes}, {share}"
    partial = verdict != "named" and validated is None
    text += f"; {_percent(1 - measured.explained)} remain." if partial else "."
    if len(confused) > 1:
        text += f" Not separable from: {', '.join(confused[1:])}."
    return f"{text}{parameters}{untested}"


def _no_gap(refit: float) -> str:
    """Return that nothing is missing, of an error of so many noise floors on test runs.

    >>> _no_gap(1.0312)
    'No gap above noise (1.03 times the floor).'
    >>> _no_gap(1.8)
    'No gap that is surely above noise (1.80 times the floor on test runs).'
    """
    if refit <= SHOWN:
        return f"No gap above noise ({refit:.2f} times the floor)."
    return f"No gap that is surely above noise ({refit:.2f} times the floor on test runs)."


def _much(rule: Mapping[str, Any]) -> bool:
    """Return whether a place holds enough of the error to be where it sits."""
    return bool(rule["share"] >= _PLACE)


def _percent(share: float) -> str:
    return f"{100 * max(share, 0.0):.0f} %"


def _described(effect: Finding) -> str:
    half = (effect.ci95[1] - effect.ci95[0]) / 2
    place = "at all" if effect.where == "all" else f"at {effect.where}"
    name = effect.name.replace("_", " ")
    law = "".join(text.format(effect.form[k]) for k, text in _FORMS.items() if k in effect.form)
    return f"{name} {place} ({effect.strength:.3g} ± {half:.2g} {effect.unit}{law})"


def _ruled_out(candidates: Sequence[Candidate]) -> str:
    """Return what would have been seen, for the effects that were not."""
    found: dict[str, str] = {}
    for c in candidates:
        if c.status == "ruled_out" and c.minimal_detectable_strength is not None:
            name, least = c.name.replace("_", " "), c.minimal_detectable_strength
            text = f"{name} above {least:.2g} {_unit(c)}"
            found.setdefault(c.name, text)
    some = list(found.values())[:4]
    more = f" and {len(found) - 4} more" if len(found) > 4 else ""
    return f" Ruled out: {', '.join(some)}{more}." if some else ""


def _unit(candidate: Candidate) -> str:
    return f"at {candidate.where}" if candidate.where != "all" else "anywhere"


def _untested(candidates: Sequence[Candidate]) -> str:
    by_name: dict[str, list[str]] = {}
    for c in candidates:
        by_name.setdefault(c.name, []).append(c.status)
    names = [name for name, seen in by_name.items() if set(seen) == {"not_excited"}]
    shown = ", ".join(name.replace("_", " ") for name in names[:5])
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f" Could not be tested: {shown}{more}." if names else ""
