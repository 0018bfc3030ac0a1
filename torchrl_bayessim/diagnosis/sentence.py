"""The sentence that a diagnosis ends in."""

from __future__ import annotations

__all__ = ["sentence"]

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from ..effects.catalogue import CATALOGUE
from ..logs.system import System
from .cells import plain
from .preparation import Prepared
from .report import Candidate, Finding, Verdict
from .shrinkage import Shrinkage
from .validation import NEGLIGIBLE, PARTIAL, SHOWN

_MUCH = 0.2  # of the error, to say that it sits there
# what readers know a law by, beside its strength
_FORMS = {"frequency": ", {:.3g} Hz", "number": ", {:.3g} per turn or 2π m"}
_BENT = {
    "hardening": ", hardening by {:.2g} x²", "rise": ", and {:+.2g} of it per unit of speed",
    "power": ", by the power {:.2g} of speed",
    "softness": ", softness {:.2g}", "bend": ", bent by {:+.2g}",
    "settling": ", settling at {:.2g} per second",
    "second": ", {:.0%} of it in a second filter",
    "presliding": ", after {:.2g} of presliding", "onset": ", beginning over a speed of {:.2g}",
    "kinetic": ", {:.0%} of it at any speed",
    "aside": ", {:+.2g} of its distance beside the end",
    "wind": ", wound up by {:.2g} of its width",
    "external": ", of the load with what acts from outside",
}  # fmt: skip


def sentence(
    verdict: Verdict,
    system: System,
    prepared: Prepared,
    *,
    measured: Shrinkage,
    effects: Sequence[Finding],
    candidates: Sequence[Candidate],
    confused: Sequence[str],
    validated: float | None,
    unshown: bool,
    where: Mapping[str, Any],
    odd: Collection[str],
    hint: str,
) -> str:
    """Return the verdict in words: gap, causes, what they explain, what could not be tested.

    Args:
        verdict: Its grade.
        system: The robot.
        prepared: Split, noise, horizon, nominal fit.
        measured: How far the gap shrinks.
        effects: What was found.
        candidates: What the data say about every effect.
        confused: Names that cannot be told from the cause, itself first.
        validated: Share that is explained on validation runs, where they speak for test runs.
        unshown: Whether the effects are sure from other runs, and test runs cannot confirm them.
        where: The error's place.
        odd: Runs that depart from the simulator as no other does.
        hint: What keeps these data from saying anything.
    """
    gap = f"Gap: {measured.refit:.3g} times the noise floor on {prepared.horizon}-step prediction."
    ruled_out = _ruled_out(candidates)
    untested = _untested(candidates)
    parameters = _retuned(measured, fitted=system.prior is not None, found=verdict != "unknown")
    if verdict == "none":
        return f"{_no_gap(measured.refit)}{ruled_out}{untested}"
    if verdict == "not_testable":
        return f"These data cannot say: {hint}.{untested}"
    if verdict == "unknown":
        real = _unknown(measured, candidates, odd, where["regimes"])
        return f"{gap} It is real, {real}{parameters}{untested}"
    causes = ", and ".join(_described(e) for e in effects)
    low, high = measured.elsewhere
    least, most = (f"{100 * max(end, 0.0):.0f}" for end in (low, high))
    verb = "explains" if len(effects) == 1 else "together explain"
    share = f"{verb} {_percent(measured.explained)} [{least}, {most}] of it"
    if validated is not None:
        share = f"{verb} {_percent(validated)} of it on validation runs, test runs hardly show it"
    elif measured.refit <= NEGLIGIBLE:
        share = "found on other runs, too small to matter on test runs"
    elif unshown:
        share = "found on other runs, test runs show too little to say how much it explains"
    others = _rivals_of_others(effects, confused)
    if verdict == "ambiguous":
        equals = ", ".join(map(plain, confused))
        return (
            f"{gap} These data cannot tell the causes apart: {equals}. The first, {causes}, "
            f"{share}.{others}{parameters}{untested}"
        )
    text = f"{gap} {'Cause' if len(effects) == 1 else 'Causes'}: {causes}, {share}"
    told = validated is None and not unshown and measured.refit > NEGLIGIBLE
    partial = verdict != "named" and told
    text += f"; {_percent(1 - measured.explained)} remain." if partial else "."
    if len(confused) > 1:
        text += f" Not separable from: {', '.join(map(plain, confused[1:]))}."
    return f"{text}{others}{parameters}{untested}"


def _rivals_of_others(effects: Sequence[Finding], confused: Sequence[str]) -> str:
    """Return what may stand in the place of effects beside the first."""
    return "".join(
        f" In the place of {plain(e.name)} it may be: {', '.join(map(plain, e.rivals))}."
        for e in effects
        if e.rivals and e.name not in confused[:1]
    )


def _retuned(measured: Shrinkage, *, fitted: bool, found: bool) -> str:
    """Return what fitting parameters alone does, and where it harms, what all of it together does.

    >>> harmed = Shrinkage(3.0, 9.0, 2.0, 0.875, (0.8, 0.9), (7.0, 9.0), (0.9, 1.1))
    >>> _retuned(harmed, fitted=True, found=True)  # doctest: +NORMALIZE_WHITESPACE
    " Retuning parameters alone makes test runs worse: 3 times the floor at the prior's mean,
    50 % of which parameters and effects explain together."
    """
    if fitted and measured.raw > measured.refit:
        share = _percent(min(measured.by_parameters, 1.0))
        return (
            f" Retuning parameters alone removes {share} of the gap at the prior's mean "
            f"({measured.raw:.3g} times the floor)."
        )
    if not measured.misled:
        return ""
    together = f", {_percent(measured.of_raw)} of which parameters and effects explain together"
    return (
        f" Retuning parameters alone makes test runs worse: {measured.raw:.3g} times the floor "
        f"at the prior's mean{together if found and measured.raw > SHOWN else ''}."
    )


def _unknown(
    measured: Shrinkage,
    candidates: Sequence[Candidate],
    odd: Collection[str],
    rules: Sequence[Mapping[str, Any]],
) -> str:
    """Return why a gap has no cause that could be named."""
    if odd:
        return f"but only in {', '.join(odd)}: did something happen there?"
    place = f" It sits at {rules[0]['rule']}." if rules and _much(rules[0]) else ""
    best = max((c.explained_fraction for c in candidates), default=0.0)
    best = max(best, measured.explained)
    tried = len({c.name for c in candidates})
    found = f"none of the {tried} effects that were tried explains more than {_percent(best)}"
    if best >= PARTIAL:
        found = "what could explain it on some runs does not hold up"
    return f"but {found}.{place}"


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
    return bool(rule["share"] >= _MUCH)


def _percent(share: float) -> str:
    """Return a share in per cent, all of it and nothing only where it is so.

    >>> [_percent(share) for share in (-0.1, 0.0, 0.002, 0.5, 0.998, 1.0)]
    ['0 %', '0 %', 'under 1 %', '50 %', 'over 99 %', '100 %']
    """
    text = f"{100 * max(share, 0.0):.0f} %"
    if text == "0 %" and share > 0.0:
        return "under 1 %"
    return "over 99 %" if text == "100 %" and share < 1.0 else text


def _described(effect: Finding) -> str:
    half = (effect.ci95[1] - effect.ci95[0]) / 2
    name = plain(effect.name)
    law = _law(effect.name, effect.form)
    if len(effect.strengths) > 1:
        least, most = (pick(effect.strengths.values()) for pick in (min, max))
        if most - least <= 1e-3 * abs(most):
            each = f"{effect.strength:.3g} ± {half:.2g} {effect.unit}{law}"
            return f"{name} at {len(effect.strengths)} places ({each} each)"
        largest = max(effect.strengths, key=lambda place: abs(effect.strengths[place]))
        if effect.where == "all" and effect.strength == effect.strengths[largest]:
            at = f"{effect.strength:.3g} ± {half:.2g} {effect.unit} at {largest}"
            return f"{name} at all at once ({at}, elsewhere in proportion to its range{law})"
        sizes = f"{least:.3g} to {most:.3g} {effect.unit}, mean {effect.strength:.3g} ± {half:.2g}"
        return f"{name} at {len(effect.strengths)} places ({sizes}{law})"
    return f"{name} {_place(effect.where)} ({effect.strength:.3g} ± {half:.2g} {effect.unit}{law})"


def _law(name: str, form: Mapping[str, Any]) -> str:
    """Return what tells a law from others of its name: how fast it oscillates, how it bends."""
    usual = CATALOGUE[name]().form if name in CATALOGUE else {}
    shown = [text.format(form[number]) for number, text in _FORMS.items() if number in form]
    for number, text in _BENT.items():
        said = text.format(form[number]) if form.get(number) else ""
        if number not in usual or said != text.format(usual[number]):
            shown.append(said)
    return "".join(shown)


def _place(where: str) -> str:
    return "at all at once" if where == "all" else f"at {where}"


def _ruled_out(candidates: Sequence[Candidate]) -> str:
    """Return what would have been seen, for the effects that were not."""
    names = dict.fromkeys(c.name for c in candidates if _seen(c))
    found = [_least([c for c in candidates if c.name == name]) for name in names]
    some = found[:4]
    more = f" and {len(found) - 4} more" if len(found) > 4 else ""
    return f" Ruled out: {', '.join(some)}{more}." if some else ""


def _seen(candidate: Candidate) -> bool:
    least = candidate.minimal_detectable_strength
    return candidate.status == "ruled_out" and least is not None


def _least(candidates: Sequence[Candidate]) -> str:
    """Return above which strength an effect would have been seen, and where."""
    single = [c for c in candidates if c.where != "all"]
    shown = [c for c in single if _seen(c)] or [c for c in candidates if _seen(c)]
    worst = max(shown, key=lambda c: c.minimal_detectable_strength or 0.0)
    everywhere = len({c.where for c in single}) > 1 and len(shown) == len(single)
    place = "anywhere" if everywhere else _place(worst.where)
    least = f"{worst.minimal_detectable_strength:.2g} {worst.unit}"
    return f"{plain(worst.name)}{_law(worst.name, worst.form)} above {least} {place}"


def _untested(candidates: Sequence[Candidate]) -> str:
    by_name: dict[str, list[str]] = {}
    for c in candidates:
        by_name.setdefault(c.name, []).append(c.status)
    names = [name for name, seen in by_name.items() if set(seen) == {"not_excited"}]
    shown = ", ".join(map(plain, names[:5]))
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f" Could not be tested: {shown}{more}." if names else ""
