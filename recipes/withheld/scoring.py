"""Scores of the blind check, with Wilson intervals, by tier, robot and detectability."""

from __future__ import annotations

__all__ = ["NAMING", "Record", "finite", "record", "scores", "share", "uniform"]

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from intervals import wilson
from scipy.stats import kstest

from .classes import class_of

Record = dict[str, Any]
NAMING = {"named", "named_partial", "ambiguous"}
_CHANNELS = {"actuation", "body", "contact", "sensing"}
_PERHAPS = 0.1  # share of the gap from which a report says that a channel may be at fault


def share(hits: Iterable[bool]) -> dict[str, Any]:
    """Return a proportion with its number of cases and interval."""
    hits = list(hits)
    value = sum(hits) / len(hits) if hits else None
    return {"n": len(hits), "value": value, "ci95": wilson(sum(hits), len(hits))}


def finite(value: Any) -> Any:
    """Return what JSON can hold: tuples as lists, numbers of arrays as numbers, no NaN."""
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def record(
    label: Mapping[str, Any], report: Mapping[str, Any], shrinks: float | None = None
) -> Record:
    """Return what is true of a case and what was said, side by side.

    Args:
        label: As sealed.
        report: Of the diagnosis.
        shrinks: True share of the gap that the named effects remove.
    """
    truths = label["truths"]
    # a verdict that explains nothing names nothing, whatever was tried
    effects = report.get("effects", []) if report["verdict"] in NAMING else []
    named = [effect["name"] for effect in effects]
    confused = report.get("confusion_set", [])
    true = [truth["name"] for truth in truths]
    one: Record = {
        **{k: label[k] for k in ("tier", "robot", "form", "engine", "detectability")},
        **{k: label[k] for k in ("excitation", "velocities", "runs", "noise_told")},
        "truth": true, "class": [class_of(name) for name in true],
        "verdict": report["verdict"], "summary": report.get("summary", ""),
        "named": named, "named_class": [class_of(name) for name in named],
        "confusion_set": confused, "seconds": report["seconds"],
        "p_value": next(iter(report.get("audit", {}).get("p_values", ())), None),
    }  # fmt: skip
    if shrinks is not None and report["verdict"] in NAMING:
        gap = report["gap"]
        one["shrinkage"] = {
            "true": shrinks, "predicted": gap["explained_fraction"], "ci95": gap["ci95"]
        }  # fmt: skip
    if len(truths) == 1:
        one |= _single(truths[0], effects, confused) | _located(truths[0], effects, report)
    if len(truths) == 2:
        found, wanted = set(one["named_class"]), set(one["class"])
        one["exact"] = found == wanted and len(named) == 2
        one["extra"] = bool(found - wanted) or len(named) > 2
    return one


def _single(
    truth: Mapping[str, Any], effects: Sequence[Mapping], confused: Sequence[str]
) -> Record:
    first = effects[0] if effects else None
    one: Record = {
        "top1": first is not None and first["name"] == truth["name"],
        "top1_class": first is not None and class_of(first["name"]) == class_of(truth["name"]),
        "covered": truth["name"] in confused,
        "covered_class": class_of(truth["name"]) in {class_of(name) for name in confused},
        "set_size": len(confused),
    }
    if first is None:
        return one
    if one["top1"] and first["unit"] in truth["strength"] and first["where"] != "all":
        value = truth["strength"][first["unit"]]
        low, high = first["ci95"]
        one["strength_error"] = abs(first["strength"] - value) / abs(value)
        one["strength_covered"] = low <= value <= high
    return one


def _located(
    truth: Mapping[str, Any], effects: Sequence[Mapping], report: Mapping[str, Any]
) -> Record:
    """Return whether channel and joint are right; who names nothing has found neither."""
    one: Record = {}
    if truth["channel"] in _CHANNELS:
        channels = (report.get("where") or {}).get("channel") or {}
        said = max(channels, key=lambda name: channels[name]) if effects and channels else None
        one["channel"] = said == truth["channel"]
        perhaps = [name for name, part in channels.items() if part >= _PERHAPS] if effects else []
        one["channels"] = len(perhaps)
        one["channel_among"] = truth["channel"] in perhaps
    if truth["joint"] != "all":
        place = _place(effects[0]["where"], effects[0]["strengths"]) if effects else ""
        one["joint"] = any(f"{place} ".startswith(f"{name} ") for name in truth["places"])
    return one


def _place(where: str, strengths: Mapping[str, float]) -> str:
    """Return the place with the largest strength, a column's without its prefix."""
    place = where
    if where == "all" and strengths:
        place = max(strengths, key=lambda name: abs(strengths[name]))
    return place.removeprefix("q_").removeprefix("v_")


def scores(records: Sequence[Record], *, threshold: float) -> dict[str, Any]:
    """Return the scores of all tiers; causes that cannot be seen are reported apart."""
    visible = [r for r in records if r["detectability"] >= threshold]
    tiers = {tier: _tier(tier, records, visible) for tier in sorted({r["tier"] for r in records})}
    known = [r for r in visible if r["tier"] in {"T1", "T2"}]
    strengths = sorted(r["strength_error"] for r in known if "strength_error" in r)
    sensed = [r for r in known if "channel" in r]
    placed = [r for r in known if "joint" in r and r["robot"] != "arm"]
    return {
        "threshold": threshold,
        "tiers": tiers,
        "by_robot": {
            robot: _tiers_of([r for r in records if r["robot"] == robot], threshold)
            for robot in sorted({r["robot"] for r in records})
        },
        "by_detectability": _strata(records, "top1_class"),
        "oracle_by_detectability": _strata(records, "oracle_class"),
        "where": {
            "channel": share(r["channel"] for r in sensed),
            "channel_of_right_class": share(r["channel"] for r in sensed if r["top1_class"]),
            "channel_among_reported": share(r["channel_among"] for r in sensed),
            "channel_where_one_is_reported": share(
                r["channel"] for r in sensed if r["channels"] == 1
            ),
            "joint": share(r["joint"] for r in placed),
            "joint_of_right_class": share(r["joint"] for r in placed if r["top1_class"]),
        },
        "regime": _regime([r["regime"] for r in known if r.get("regime")]),
        "strength": {
            "n": len(strengths),
            "median_error": strengths[len(strengths) // 2] if strengths else None,
            "ci_cover": share(r["strength_covered"] for r in known if "strength_covered" in r),
        },
        "shrinkage": _shrinkage([r["shrinkage"] for r in visible if "shrinkage" in r]),
        "crashes": share(r["verdict"] == "crash" for r in records),
        "seconds_per_case": sum(r["seconds"] for r in records) / len(records),
    }


def _regime(pairs: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Return how well rules overlap with when causes act, beside what no rule would."""
    return {
        "n": len(pairs),
        "better_than_no_rule": share(pair["iou"] > pair["of_no_rule"] for pair in pairs),
        **{name: _mean([pair[name] for pair in pairs]) for name in ("iou", "of_no_rule")},
    }


def uniform(p_values: Sequence[float]) -> dict[str, Any]:
    """Return the Kolmogorov-Smirnov test of p-values that should be uniform."""
    if len(p_values) < 2:
        return {"n": len(p_values), "statistic": None, "p_value": None}
    test = kstest(p_values, "uniform")
    return {"n": len(p_values), "statistic": test.statistic, "p_value": test.pvalue}


def _shrinkage(pairs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the error of the predicted shrinkage and the coverage of its interval."""
    errors = [abs(p["predicted"] - p["true"]) for p in pairs]
    covered = share(p["ci95"][0] <= p["true"] <= p["ci95"][1] for p in pairs)
    return {"n": len(pairs), "mae": _mean(errors), "ci_cover": covered}


def _tiers_of(records: Sequence[Record], threshold: float) -> dict[str, Any]:
    visible = [r for r in records if r["detectability"] >= threshold]
    return {tier: _tier(tier, records, visible) for tier in sorted({r["tier"] for r in records})}


def _tier(tier: str, every: Sequence[Record], visible: Sequence[Record]) -> dict[str, Any]:
    mine = [r for r in every if r["tier"] == tier]
    seen = [r for r in visible if r["tier"] == tier]
    alarm: Callable[[Record], bool] = lambda r: r["verdict"] not in {"none", "not_testable"}
    if tier in {"T0", "parameters", "noise"}:
        known = [r["p_value"] for r in mine if r["p_value"] is not None]
        return {
            "n": len(mine),
            "false_alarm": share(alarm(r) for r in mine),
            "p_below_5_percent": share(p < 0.05 for p in known),
            "p_uniform": uniform(known),
        }
    if tier == "renamed":
        return {"n": len(mine), "same": share(r["same"] for r in mine if "same" in r)}
    if tier == "shuffled":
        return {"n": len(mine), "wrong_named": share(r["verdict"] == "named" for r in mine)}
    if tier in {"T3", "T4"}:
        return {
            "n": len(seen),
            "wrong_named": share(r["verdict"] in {"named", "crash"} for r in seen),
            "wrong_named_or_in_part": share(
                r["verdict"] in {"named", "named_partial", "crash"} for r in seen
            ),
            "wrong_with_any_reserve": share(r["verdict"] in {*NAMING, "crash"} for r in seen),
            "silent": share(not alarm(r) for r in seen),
        }
    if tier == "T5":
        return {
            "n": len(seen),
            "exact": share(r["exact"] for r in seen),
            "any_extra": share(r["extra"] for r in seen),
        }
    single = [r for r in seen if len(r["truth"]) == 1]
    result = {
        "n": len(single),
        "top1": share(r["top1"] for r in single),
        "top1_class": share(r["top1_class"] for r in single),
        "set_coverage": share(r["covered"] for r in single),
        "set_coverage_class": share(r["covered_class"] for r in single),
        "set_size": _mean([r["set_size"] for r in single if r["set_size"]]),
        "no_set": share(not r["set_size"] for r in single),
        "named_right": share(r["top1_class"] for r in single if r["verdict"] == "named"),
        **{
            f"right_as_{verdict}": share(
                r["verdict"] == verdict and r["top1_class"] for r in single
            )
            for verdict in sorted(NAMING)
        },
        "silent": share(not alarm(r) for r in single),
    }
    if tier in {"T6", "T6B"}:
        none = [r for r in mine if not r["truth"]]
        # another integrator or contact model is a gap that may be seen; it has no name
        result["none_wrong_named"] = share(r["verdict"] == "named" for r in none)
    return result


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _strata(records: Sequence[Record], score: str) -> dict[str, Any]:
    """Return a score of T1 and T2 by how visible the cause is."""
    edges = (0.0, 10.0, 30.0, 100.0, 1000.0, math.inf)
    single = [r for r in records if r["tier"] in {"T1", "T2"} and score in r]
    return {
        f"{low:g} to {high:g}": share(r[score] for r in single if low <= r["detectability"] < high)
        for low, high in pairwise(edges)
    }
