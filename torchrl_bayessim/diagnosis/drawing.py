"""Charts as SVG inside HTML: a waterfall, curves over time, means with errors, a mark in a band.

Colours are classes that the page's style sheet gives, so that a chart is readable on light and on
dark paper; every series has a pattern of its own too. Charts are narrow: a phone shows one, a wide
screen several side by side.
"""

from __future__ import annotations

__all__ = ["Step", "curves", "means", "number", "strip", "ticks", "waterfall"]

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

from .markup import Markup, element

_WIDTH, _HEIGHT = 360, 210
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 8, 22, 36
_ROW = 34

Values = Sequence[float | None]


class Step(NamedTuple):
    """One bar of a waterfall.

    Attributes:
        label: What it is.
        begin: Where it begins.
        end: Where it ends.
        kind: Class of its colour: ``total``, ``parameters``, ``effect`` or ``floor``.
        interval: Of its end, where there is one.
    """

    label: str
    begin: float
    end: float
    kind: str
    interval: Sequence[float] | None = None


def number(value: float | None) -> str:
    """Return three digits of a number, a dash for none.

    Example:
        >>> number(0.012345), number(float("nan")), number(123456.0)
        ('0.0123', '–', '1.23e+05')
    """
    if value is None or math.isnan(value):
        return "–"
    return f"{value:.3g}".replace("inf", "∞")


def ticks(low: float, high: float) -> list[float]:
    """Return about four round numbers between two.

    Example:
        >>> ticks(0.0, 1.0)
        [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    """
    raw = max(high - low, 1e-300) / 5
    size = 10.0 ** math.floor(math.log10(raw))
    step = next(size * m for m in (1, 2, 5, 10) if size * m >= raw * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(i * step, 12 - math.floor(math.log10(step))) for i in range(first, last + 1)]


def waterfall(steps: Sequence[Step]) -> Markup:
    """Return horizontal bars, one below the other, with intervals as whiskers."""
    bounds = [v for s in steps for v in (s.begin, s.end, *(s.interval or ())) if math.isfinite(v)]
    high = max([1e-12, *bounds])
    scale = (_WIDTH - 2 * _RIGHT - 74) / high
    parts = []

    def place(value: float) -> float:
        return _RIGHT + scale * min(max(value, 0.0), high)

    for i, step in enumerate(steps):
        y = _ROW * i
        x0, x1 = sorted((place(step.begin), place(step.end)))
        total = step.begin == 0
        sign = "−" if step.end < step.begin else "+"
        shown = number(step.end) if total else f"{sign}{number(abs(_change(step)))}"
        right = max([x1, *map(place, step.interval or ())])
        parts += [
            element("text", step.label, x=_RIGHT, y=y + 12),
            element("rect", x=_p(x0), y=y + 16, width=_p(max(x1 - x0, 1)), height=12,
                    class_=f"bar {step.kind}"),
            element("text", shown, x=_p(right + 5), y=y + 26, class_="value"),
        ]  # fmt: skip
        if step.interval is not None:
            low, top = map(place, step.interval)
            parts.append(element("path", d=_whisker(low, top, y + 22), class_="whisker"))
    told = "; ".join(f"{s.label}: {number(s.end if s.begin == 0 else _change(s))}" for s in steps)
    return _svg(parts, f"Mean squared innovation. {told}", height=_ROW * len(steps) + 4)


def curves(
    x: Sequence[float], series: Mapping[str, Values], *, title: str, band: float = 0.0
) -> Markup:
    """Return lines over time, with a band around the first: two standard deviations of noise.

    Args:
        x: Seconds.
        series: Values by class of the line; gaps where there is none.
        title: What is drawn.
        band: A standard deviation.
    """
    known = {name: [v for v in values if v is not None] for name, values in series.items()}
    first = next(iter(known))
    # a simulation that runs away must not flatten the rest
    reach = _span(known[first], 0.0)
    inside = [v for values in known.values() for v in values if abs(v - reach[0]) < 8 * reach[1]]
    inside = [*inside, *known[first]] or [0.0]
    low, high = min(inside) - 2 * band, max(inside) + 2 * band
    frame = _Frame((x[0], x[-1]), _room(low, high))
    parts = frame.axes(title, "time, s")
    if band:
        upper = [(frame.x(a), frame.y(b + 2 * band)) for a, b in zip(x, series[first], strict=True)
                 if b is not None]  # fmt: skip
        lower = [(frame.x(a), frame.y(b - 2 * band)) for a, b in zip(x, series[first], strict=True)
                 if b is not None]  # fmt: skip
        points = " ".join(f"{_p(a)},{_p(b)}" for a, b in [*upper, *reversed(lower)])
        parts.append(element("polygon", points=points, class_="band"))
    for name, values in series.items():
        parts += [element("path", d=d, class_=f"line {name}") for d in frame.paths(x, values)]
    return _svg(parts, f"{title} over {number(x[-1] - x[0])} s: {', '.join(series)}")


def means(series: Mapping[str, Mapping[str, Sequence[float]]], *, title: str, x: str) -> Markup:
    """Return means with two standard errors, by class: entries ``x``, ``force``, ``error``."""
    xs = [v for one in series.values() for v in one["x"]]
    ys = [f + 2 * s * e for one in series.values()
          for f, e in zip(one["force"], one["error"], strict=True) for s in (-1, 1)]  # fmt: skip
    frame = _Frame(_room(min(xs), max(xs)), _room(min([0.0, *ys]), max([0.0, *ys])))
    parts = [*frame.axes(title, x), frame.level(0.0)]
    for name, one in series.items():
        parts += [element("path", d=d, class_=f"line {name}")
                  for d in frame.paths(one["x"], one["force"])]  # fmt: skip
        for a, b, e in zip(one["x"], one["force"], one["error"], strict=True):
            px, ends = _p(frame.x(a)), (frame.y(b - 2 * e), frame.y(b + 2 * e))
            parts += [
                element("path", d=f"M{px} {_p(ends[0])}V{_p(ends[1])}", class_="whisker"),
                element("circle", cx=px, cy=_p(frame.y(b)), r=3, class_=f"dot {name}"),
            ]
    return _svg(parts, f"{title} against {x}: {', '.join(series)}")


def strip(
    band: Sequence[float], before: float, after: float, spread: float, *, label: str
) -> Markup:
    """Return a parameter's prior as a band, with what was fitted before and after as marks."""
    inside = [*band, before, after]
    low, high = _room(min(inside), max(inside))
    width, y = 150.0, 11

    def place(value: float) -> float:
        return min(max(width * (value - low) / (high - low), 0.0), width)

    a, b = place(band[0]), place(band[1])
    ends = place(after - 2 * spread), place(after + 2 * spread)
    x = place(before)
    parts = [
        element("rect", x=_p(a), y=5, width=_p(b - a), height=12, class_="band"),
        element("path", d=_whisker(*ends, y), class_="whisker"),
        element("path", d=f"M{_p(x - 5)} {y}l5 -5l5 5l-5 5Z", class_="dot without"),
        element("circle", cx=_p(place(after)), cy=y, r=4.5, class_="dot with"),
    ]
    return _svg(parts, label, width=round(width), height=22)


class _Frame:
    """Axes of a chart: where values are on the paper."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float]) -> None:
        self._x, self._y = x, y

    def x(self, value: float) -> float:
        low, high = self._x
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * (value - low) / max(high - low, 1e-300)

    def y(self, value: float) -> float:
        low, high = self._y
        share = min(max((value - low) / max(high - low, 1e-300), -0.04), 1.04)
        return _HEIGHT - _BOTTOM - (_HEIGHT - _BOTTOM - _TOP) * share

    def axes(self, title: str, x: str) -> list[Markup]:
        """Return grid lines with their numbers, the title and the name of ``x``."""
        parts = [element("text", title, x=4, y=13, class_="title")]
        for value in ticks(*self._y):
            parts += [
                self.level(value, "grid"),
                element("text", number(value), x=_LEFT - 5, y=_p(self.y(value) + 4), class_="end"),
            ]
        for value in ticks(*self._x):
            parts.append(
                element("text", number(value), x=_p(self.x(value)), y=_HEIGHT - 20, class_="middle")
            )
        middle = (_LEFT + _WIDTH - _RIGHT) / 2
        return [*parts, element("text", x, x=_p(middle), y=_HEIGHT - 4, class_="middle axis")]

    def level(self, value: float, class_: str = "zero") -> Markup:
        """Return a horizontal line."""
        y = _p(self.y(value))
        return element("path", d=f"M{_LEFT} {y}H{_WIDTH - _RIGHT}", class_=class_)

    def paths(self, x: Sequence[float], y: Values) -> list[str]:
        """Return the lines through points, one per stretch without gaps."""
        points = zip(x, y, strict=True)
        lines = []
        for known, run in groupby(points, key=lambda point: point[1] is not None):
            if known:
                places = [f"{_p(self.x(a))} {_p(self.y(b))}" for a, b in run if b is not None]
                lines.append("M" + "L".join(places))
        return lines


def _svg(
    parts: Sequence[Markup], label: str, *, width: int = _WIDTH, height: int = _HEIGHT
) -> Markup:
    attributes: dict[str, Any] = {"viewBox": f"0 0 {width} {height}", "role": "img"}
    return element("svg", element("title", label), *parts, **attributes, aria_label=label)


def _span(values: Sequence[float], least: float) -> tuple[float, float]:
    """Return the middle of values and half of what they span."""
    if not values:
        return 0.0, 1.0
    half = max((max(values) - min(values)) / 2, least)
    return (max(values) + min(values)) / 2, half or 1.0


def _room(low: float, high: float) -> tuple[float, float]:
    margin = 0.05 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


def _change(step: Step) -> float:
    return step.end - step.begin


def _whisker(low: float, high: float, y: float) -> str:
    return f"M{_p(low)} {y - 4}v8M{_p(low)} {y}H{_p(high)}M{_p(high)} {y - 4}v8"


def _p(value: float) -> str:
    """Return a place on the paper, to a tenth of a pixel."""
    return f"{value:.1f}".removesuffix(".0")
