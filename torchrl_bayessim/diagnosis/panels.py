"""The panels of a report's page, one function each: in words, pictures and tables."""

from __future__ import annotations

__all__ = [
    "audit",
    "confusability",
    "evidence",
    "next_experiment",
    "parameters",
    "place",
    "segments",
    "signature",
    "size",
]

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from .cells import bar, cell, chance, grid, legend, percent, plain, ratio, strength, words
from .drawing import Step, curves, means, number, strip, waterfall
from .markup import Markup, element, joined, table
from .report import Candidate, Finding, Report

_STATUS = {
    "named": "named",
    "confounded": "cannot be told from the cause, or from parameters",
    "rejected": "explains less",
    "ruled_out": "ruled out",
    "not_excited": "not tested by these data",
}
_LEGEND = {"real": "real", "without": "simulated, fitted", "with": "simulated, with the effects"}


def size(report: Report) -> Markup:
    """Return how large the gap is, and who is credited with what of it."""
    gap, intervals = report.gap, report.figures.get("waterfall", {})
    steps = [
        Step("at the prior's mean", 0.0, gap.raw, "total"),
        Step("credit to parameters", gap.raw, gap.refit, "parameters"),
        Step("parameters fitted", 0.0, gap.refit, "total", intervals.get("refit")),
    ]
    level, whole = gap.refit, sum(e.share_of_gap for e in report.effects)
    for effect in report.effects:
        share = effect.share_of_gap / whole if whole > 0 else 1 / len(report.effects)
        lower = level - share * (gap.refit - gap.with_effects)
        steps.append(Step(f"credit to {words(effect.name, effect.where)}", level, lower, "effect"))
        level = lower
    if report.effects:
        interval = intervals.get("with_effects")
        steps.append(Step("with effects", 0.0, gap.with_effects, "total", interval))
    steps.append(Step("perfect simulator: noise", 0.0, gap.floor, "floor"))
    low, high = gap.ci95
    told = (
        f"Mean squared innovation over {gap.horizon_steps} control steps on test runs, 1 for a "
        "perfect simulator; whiskers are 95 % intervals over trajectories, or over segments of "
        "fewer than four."
    )
    if report.effects:
        told += (
            f" The effects explain {percent(gap.explained_fraction)} of what fitting leaves above "
            f"the floor, interval {percent(low)} to {percent(high)}."
        )
    bars = grid([waterfall(steps)], "grid wide")
    return joined([element("p", told), bars, _rollouts(report)])


def _rollouts(report: Report) -> Markup | None:
    errors = report.gap.rollout_rmse
    raw, before, after = (errors.get(n, {}) for n in ("raw", "refit", "with_effects"))
    if not before:
        return None
    head = ["output", "prior's mean", "parameters fitted", "with effects", "ratio"]
    rows = [
        [name, number(raw.get(name)), *map(number, pair), ratio(*pair)]
        for name, pair in ((n, (error, after.get(n))) for n, error in before.items())
    ]
    if not report.effects:
        head, rows = head[:3], [row[:3] for row in rows]
    return table("Open-loop error over whole test runs, root mean square, SI units", head, rows)


def place(report: Report) -> Markup:
    """Return where the error sits, before the effects and after."""
    title = "Before the effects" if report.effects else "The error"
    parts: list[object] = [_shares_of(report.where, title)]
    if report.verdict == "none":
        parts.insert(0, element("p", "No gap was found: what follows is mostly noise."))
    if report.effects:
        parts.append(_shares_of(report.remainder, "What remains after the effects"))
    return joined([_heat(report.figures.get("heat", {})), *parts])


def _shares_of(where: Mapping[str, Any], title: str) -> Markup:
    """Return bars of channels, joints, outputs and time, and rules in words."""
    channels = [
        {"name": name, "share": share} for name, share in dict(where.get("channel", {})).items()
    ]
    quarters = [
        {"name": f"{number(q['t0'])} to {number(q['t1'])}", "share": q["share"]}
        for q in where.get("time", ())
    ]
    groups = {
        "part of the robot": channels,
        "joint": where.get("joints", ()),
        "output": where.get("outputs", ()),
        "time, s": quarters,
    }
    tables = [
        table(f"Share by {name}", [name, "share"],
              [[e["name"], bar(e["share"])] for e in entries], shown=8)
        for name, entries in groups.items() if any(e["share"] > 0 for e in entries)
    ]  # fmt: skip
    cause = where.get("regimes_of")
    part = f"what {plain(cause)} changes" if cause else "the excess"
    rules = [
        element("li", element("code", r["rule"]),
                f": {percent(r['support'])} of the rows, {percent(r['share'])} of {part}")
        for r in where.get("regimes", ())
    ]  # fmt: skip
    told = element("ul", *rules) if rules else element("p", "No regime stands out.")
    return joined([element("h3", title), told, grid(tables, "grid small")])


def _heat(heat: Mapping[str, Any]) -> Markup | None:
    if not heat:
        return None
    cuts, last = [number(c) for c in heat["cuts"]], len(heat["cuts"])
    columns = [
        f"below {cuts[0]}", *(f"{a} to {b}" for a, b in pairwise(cuts)),
        f"{cuts[last - 1]} and more",
    ]  # fmt: skip
    top = max([1e-12, *(v for row in heat["excess"] for v in row)])
    rows = [
        [name, *(cell(number(v), v / top) for v in row)]
        for name, row in zip(heat["outputs"], heat["excess"], strict=True)
    ]
    caption = f"Excess squared error over noise, by output and {heat['feature']}, in quarters"
    return table(caption, ["output", *columns], rows, shown=24)


def evidence(report: Report) -> Markup:
    """Return what the data say of every effect at every place."""
    units = report.figures.get("units", {})
    order = list(_STATUS)
    some = sorted(report.candidates, key=lambda c: (order.index(c.status), -c.likelihood_ratio))
    rows = [_row(c, units.get(f"{c.name}[{c.where}]", "")) for c in some]
    head = ["effect", "where", "status", "strength", "p alone", "held-out gain",
            "explains alone", "swallowed by parameters", "would have been seen from"]  # fmt: skip
    told = [element("p", _told(effect, units)) for effect in report.effects]
    if len(report.confusion_set) > 1:
        names = ", ".join(plain(name) for name in report.confusion_set)
        told.append(element("p", f"These data cannot tell apart: {names}."))
    if not rows:
        return element("p", "No effect was tried.")
    return joined([*told, table("Every effect at every place", head, rows)])


def _row(c: Candidate, unit: str) -> list[object]:
    return [
        plain(c.name),
        c.where,
        element("span", _STATUS[c.status], class_=f"status {c.status}"),
        "–" if c.ci95 is None else strength(c.strength, c.ci95, unit),
        chance(c.p_value),
        number(c.held_out_gain),
        bar(c.explained_fraction),
        percent(c.explained_by_parameters),
        "–" if c.minimal_detectable_strength is None
        else f"{number(c.minimal_detectable_strength)} {unit}".rstrip(),
    ]  # fmt: skip


def _told(effect: Finding, units: Mapping[str, str]) -> str:
    by_target = ", ".join(f"{name} {number(s)}" for name, s in effect.strengths.items())
    several = f" ({by_target})" if len(effect.strengths) > 1 else ""
    unit = units.get(f"{effect.name}[{effect.where}]", effect.unit)
    amount = strength(effect.strength, effect.ci95, unit)
    rivals = f" Or {', '.join(plain(name) for name in effect.rivals)}." if effect.rivals else ""
    return (
        f"Found: {words(effect.name, effect.where)}, {amount}{several}; "
        f"p-value {chance(effect.p_value)}; {percent(effect.share_of_gap)} of the gap.{rivals}"
    )


def segments(figures: Mapping[str, Any]) -> Markup:
    """Return the worst stretches of the test runs, real and simulated."""
    worst = figures.get("segments", ())
    if not worst:
        return element("p", "None were drawn.")
    shown = [name for name in _LEGEND if name != "with" or _differs(worst)]
    parts: list[object] = [legend({name: _LEGEND[name] for name in shown})]
    for segment in worst:
        begin, end = segment["time"][0], segment["time"][-1]
        parts.append(element("h3", f"{segment['log']}, {number(begin)} to {number(end)} s"))
        parts.append(
            grid([
                curves(segment["time"], {name: channel[name] for name in shown},
                       title=channel["name"], band=channel["noise"])
                for channel in segment["channels"]
            ])
        )  # fmt: skip
    told = "The stretches that the fitted parameters predict worst. The band is twice the noise."
    return joined([element("p", told), *parts])


def _differs(segments: Sequence[Mapping[str, Any]]) -> bool:
    return any(c["without"] != c["with"] for s in segments for c in s["channels"])


def signature(figures: Mapping[str, Any]) -> Markup:
    """Return the force that is missing, against what may cause it."""
    seen = figures.get("signature", {})
    if not seen:
        return element("p", "No joint of this robot can be pushed.")
    title = f"force at {seen['joint']}, {seen['unit']}"
    names = {"before": "without", "after": "with"}
    length = "m" if seen["unit"] == "N" else "rad"
    units = {"velocity": f", {length}/s", "position": f", {length}", "time": ", s"}
    charts, shown = [], ["without"]
    for against, by_time in seen["curves"].items():
        series = {names[when]: binned for when, binned in by_time.items()}
        shown = list(series)
        charts.append(means(series, title=title, x=f"{against}{units.get(against, '')}"))
    told = (
        "The constant force that would mend each training segment best, in bins of equally many "
        "segments with two standard errors. A step at zero velocity is dry friction, a slope "
        "over velocity viscous friction, over position a spring, over the command a gain."
    )
    told_by = {"without": "parameters fitted", "with": "what the effects leave"}
    return joined([element("p", told), legend({n: told_by[n] for n in shown}), grid(charts)])


def confusability(figures: Mapping[str, Any]) -> Markup:
    """Return how alike the leading effects' signatures are."""
    effects = figures.get("confusability", {}).get("effects", ())
    if not effects:
        return element("p", "No effect left a trace in these data.")
    numbers = [str(i + 1) for i in range(len(effects))]
    rows = [
        [f"{n} {words(*one)}", *(cell(f"{v:.2f}", v**2) for v in row)]
        for n, one, row in zip(numbers, effects, figures["confusability"]["matrix"], strict=True)
    ]
    told = (
        "Cosines between what the leading effects would change, after the parameters took their "
        "part. Beyond 0.95 these data hardly tell two effects apart."
    )
    return joined([element("p", told), table("Cosines", ["effect", *numbers], rows, shown=24)])


def parameters(report: Report) -> Markup:
    """Return the parameters before and after, with their priors."""
    if not report.parameters:
        return element("p", "The system has no uncertain parameters.")
    rows = []
    for p in report.parameters:
        low, high = p.prior
        label = (
            f"{p.name}: prior {number(low)} to {number(high)}, fitted alone "
            f"{number(p.without_effects)}, with effects {number(p.with_effects)}"
        )
        drawn = strip(p.prior, p.without_effects, p.with_effects, p.sd, label=label)
        alarm = element("span", "at the prior's edge", class_="status rejected")
        rows.append([
            p.name, f"{number(low)} to {number(high)}", number(p.without_effects),
            f"{number(p.with_effects)} ± {number(1.96 * p.sd)}", drawn,
            alarm if p.at_bound else "–",
        ])  # fmt: skip
    head = ["parameter", "prior", "fitted alone", "with effects", "prior (band)", "alarm"]
    told = (
        "Diamond: fitted alone; dot: with the effects. A parameter that leaves its prior alone and "
        "comes back with the effects had absorbed them."
    )
    return joined([element("p", told), table("Parameters, SI units", head, rows, shown=24)])


def next_experiment(report: Report) -> Markup:
    """Return what to record next."""
    if not report.next_experiment:
        return element("p", "No experiment is proposed.")
    rows = [
        [
            str(step.get("excitation", "")),
            " from ".join(plain(str(name)) for name in step.get("separates", ())),
            number(step.get("expected_odds")),
            number(step.get("seconds")),
        ]
        for step in report.next_experiment
    ]
    return table("Experiments", ["excitation", "separates", "expected odds", "seconds"], rows)


def audit(done: Mapping[str, Any]) -> Markup:
    """Return what was done to find all this."""
    rows = [
        [plain(name), element("span", _entry(value), class_="long")] for name, value in done.items()
    ]
    return table("Audit", ["what", "value"], rows, shown=40)


def _entry(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_entry(entry)}" for key, entry in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(_entry(entry) for entry in value)
    return number(value) if isinstance(value, float) else str(value)
