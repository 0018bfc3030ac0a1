"""Small pieces of a report's page: shares as bars, shaded numbers, strengths and names in words."""

from __future__ import annotations

__all__ = [
    "bar",
    "cell",
    "chance",
    "grid",
    "legend",
    "percent",
    "plain",
    "ratio",
    "strength",
    "words",
]

from collections.abc import Mapping, Sequence

from .drawing import number
from .markup import Markup, element


def legend(entries: Mapping[str, str]) -> Markup:
    """Return what each class of line stands for."""
    keys = [
        element("span", element("i", class_=f"key {name}", aria_hidden="true"), text)
        for name, text in entries.items()
    ]
    return element("p", *keys, class_="legend")


def grid(charts: Sequence[Markup], class_: str = "grid") -> Markup:
    """Return charts side by side, as many as there is room for."""
    return element("div", *(element("figure", chart) for chart in charts), class_=class_)


def bar(share: float) -> Markup:
    """Return a share as a number on a bar."""
    width = min(max(share, 0.0), 1.0)
    fill = element("i", style=f"width:{100 * width:.0f}%", class_="fill", aria_hidden="true")
    return element("span", fill, element("b", percent(share)), class_="share")


def cell(text: str, share: float) -> Markup:
    """Return text on a ground whose depth is ``share``."""
    return element("span", text, class_="heat", style=f"--share:{100 * share:.0f}%")


def strength(value: float, interval: Sequence[float] | None, unit: str) -> str:
    """Return a strength with half the width of its interval, and its unit."""
    half = "" if interval is None else f" ± {(interval[1] - interval[0]) / 2:.2g}"
    return f"{number(value)}{half} {unit}".rstrip()


def chance(p: float) -> str:
    """Return a p-value."""
    return "< 1e-12" if p < 1e-12 else f"{p:.2g}"


def percent(share: float) -> str:
    """Return a share as a percentage."""
    return f"{100 * share:.0f} %"


def ratio(before: float, after: float | None) -> str:
    """Return how many times smaller it is after, a dash where that cannot be said."""
    return "–" if not after or not before else number(before / after)


def plain(name: str) -> str:
    """Return a name of the catalogue in plain words."""
    return name.replace("_", " ")


def words(name: str, where: str) -> str:
    """Return an effect and its place."""
    return f"{plain(name)} {'everywhere' if where == 'all' else f'at {where}'}"
