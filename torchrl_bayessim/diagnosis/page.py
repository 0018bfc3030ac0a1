"""A report as one HTML file: nothing is loaded, nothing runs, and it prints.

The order is that of the questions: what is it, how large, where, what speaks for it, what does it
look like, what did the parameters do, what to record next, and what was done to find out.
"""

from __future__ import annotations

__all__ = ["page", "write_page"]

from pathlib import Path

from ..whole_file import write_text
from . import panels
from .markup import Markup, element
from .report import Report
from .style import STYLE

_MEANING = {
    "none": "nothing is missing",
    "named": "the cause explains the gap",
    "named_partial": "the cause explains most of the gap, or more than test runs show",
    "ambiguous": "several causes explain it equally well",
    "unknown": "the gap is real, its cause is not in the catalogue",
    "not_testable": "these data cannot say",
}


def write_page(report: Report, path: str | Path) -> None:
    """Write a report as one self-contained HTML file, wholly or not at all."""
    write_text(path, page(report))


def page(report: Report) -> str:
    """Return a report as HTML."""
    policy = "default-src 'none'; style-src 'unsafe-inline'"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="color-scheme", content="light dark"),
        element("title", f"Gap: {report.verdict.replace('_', ' ')}"),
        element("style", Markup(STYLE)),
    )
    content = (
        ("How large is the gap?", panels.size(report)),
        ("Where is it?", panels.place(report)),
        ("What speaks for each effect?", panels.evidence(report)),
        ("The worst test segments", panels.segments(report.figures)),
        ("What the missing force looks like", panels.signature(report.figures)),
        ("Which effects look alike", panels.confusability(report.figures)),
        ("Parameters before and after", panels.parameters(report)),
        ("What to record next", panels.next_experiment(report)),
        ("How this was found", panels.audit(report.audit)),
    )
    sections = [element("section", element("h2", title), body) for title, body in content]
    body = element("body", element("main", _verdict(report), *sections))
    return "<!DOCTYPE html>\n" + element("html", head, body, lang="en") + "\n"


def _verdict(report: Report) -> Markup:
    name = report.verdict
    badge = element("p", element("strong", name.replace("_", " ")), f": {_MEANING[name]}")
    parts = [badge, element("h1", report.summary)]
    if report.alarms:
        items = element("ul", *(element("li", alarm) for alarm in report.alarms))
        count = f"{len(report.alarms)} alarm{'s' if len(report.alarms) > 1 else ''}"
        summary = element("summary", f"{count}: read before believing any of this")
        parts.append(element("details", summary, items, class_="alarms", open=""))
    return element("header", *parts, class_=f"verdict {name}")
