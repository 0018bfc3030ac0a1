"""Pictures: what is known about the physics, and what the policy earns.

Every function returns a new `matplotlib.figure.Figure`, which saves itself
(``figure.savefig("name.png")``). Neither pyplot nor matplotlib's settings are touched, so the
pictures look the same everywhere and need no display. Colours are those of Okabe & Ito (2008),
which colour-blind readers can tell apart.
"""

from __future__ import annotations

__all__ = ["learning_curves", "pair_plot", "return_per_round"]

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from .errors import message

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BLUE, _ORANGE, _GREEN, _VERMILION, _PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
_INK, _GREY, _LIGHT = "#222222", "#8A8A8A", "#D9D9D9"
_LEGEND = {"framealpha": 1.0, "edgecolor": "none"}  # lines end at its text, not in it
_CYCLE = (_BLUE, _VERMILION, _GREEN, _PURPLE, _ORANGE, _INK)


def pair_plot(
    samples: Tensor,
    *,
    names: Sequence[str],
    units: Sequence[str] | None = None,
    prior_samples: Tensor | None = None,
    truth: Tensor | None = None,
    zoom: bool = False,
) -> Figure:
    """Draw marginals on the diagonal and pairs below it, as densities with contours.

    The contours hold 50 % and 90 % of the samples. Both marginals are probability densities on
    one scale, so that heights compare.

    Args:
        samples: Posterior draws, shape ``(S, D)``.
        names: Name of each parameter.
        units: Unit of each parameter; an empty string for none.
        prior_samples: Prior draws, shape ``(S', D)``, drawn in grey; they set the axes.
        truth: The true parameters where known, shape ``(D,)``.
        zoom: Let the posterior set the axes, when it is too narrow to be seen beside the prior.

    Raises:
        ValueError: Shapes do not agree, or a value is not finite.

    Example:
        >>> figure = pair_plot(torch.randn(500, 2), names=["mass", "length"], units=["kg", "m"])
        >>> len(figure.axes)
        3
    """
    points = _points(samples, len(names), "samples")
    prior = None if prior_samples is None else _points(prior_samples, len(names), "prior_samples")
    true = None if truth is None else _points(torch.as_tensor(truth)[None], len(names), "truth")[0]
    units = [""] * len(names) if units is None else units
    if len(units) != len(names):
        raise ValueError(message("one unit per name", f"{len(units)} for {len(names)} names"))
    labels = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
    limits = _limits(points if prior is None or zoom else prior, true)
    low, high = np.array(limits).T
    shown = points[((points >= low) & (points <= high)).all(1)]
    d = len(names)
    figure = _figure(width=max(3.4, 2.1 * d + 0.6), height=max(3.0, 2.0 * d + 0.5))
    grid = figure.add_gridspec(d, d, hspace=0.08, wspace=0.08)
    for row in range(d):
        for column in range(row + 1):
            axes = _axes(figure, grid[row, column])
            axes.set_xlim(*limits[column])
            if row == column:
                _marginal(axes, points[:, row], prior if prior is None else prior[:, row])
            else:
                pair = [column, row]
                if prior is not None:
                    # Dots: contours of a flat density would show nothing but its noise.
                    axes.plot(*prior[:1_000, pair].T, ".", color="#C4C4C4", ms=1.5, zorder=0)
                _pair(axes, shown[:, pair])
                axes.set_xlim(*limits[column])
                axes.set_ylim(*limits[row])
            if true is not None:
                axes.axvline(true[column], color=_VERMILION, lw=1.2)
                if row != column:
                    axes.axhline(true[row], color=_VERMILION, lw=1.2)
            _label_edges(axes, labels, row=row, column=column, last=d - 1)
    handles = _handles(prior=prior is not None, truth=true is not None)
    figure.legend(
        handles=handles, loc="upper right", bbox_to_anchor=(0.98, 0.98), frameon=False, fontsize=9
    )
    return figure


def learning_curves(
    curves: Mapping[str, tuple[Tensor, Tensor]],
    *,
    xlabel: str = "frames",
    ylabel: str = "return",
    baseline: Mapping[str, float] | None = None,
    marks: Mapping[str, float] | None = None,
    palette: Sequence[str] = (),
) -> Figure:
    """Draw a line per entry of ``curves``, with a band where there are several seeds, and say so.

    Args:
        curves: Name to ``(x, y)``: x of shape ``(P,)``, y of shape ``(P,)`` or ``(seeds, P)``. The
            band runs from the smallest to the largest seed, the line is their mean.
        xlabel: What the horizontal axis counts.
        ylabel: What the vertical axis shows.
        baseline: Names and heights of horizontal lines.
        marks: Names and places of vertical lines.
        palette: Names that have the colours of their places in it, whichever are drawn; default
            those of ``curves``.

    Raises:
        ValueError: No curve, a curve that ``palette`` does not name, or shapes that do not agree.

    Example:
        >>> figure = learning_curves({"prior": (torch.arange(3), torch.rand(5, 3))})
        >>> figure.axes[0].get_ylabel()
        'return'
    """
    if not curves:
        raise ValueError(message("at least one curve", {}))
    figure = _figure(width=5.2, height=3.3)
    axes = _axes(figure)
    named = list(palette or curves)
    if not curves.keys() <= set(named):
        raise ValueError(message("curves that palette names", list(curves), available=named))
    colours = dict(zip(named, _cycle(len(named)), strict=True))
    for (name, (x, y)), width in zip(curves.items(), _widths(len(curves)), strict=True):
        colour = colours[name]
        steps, values = _array(x), np.atleast_2d(_array(y))
        if steps.ndim != 1 or values.ndim != 2 or values.shape[1] != len(steps):
            raise ValueError(
                message(
                    f"x (P,) and y (P,) or (seeds, P) in curve {name!r}",
                    f"{steps.shape} and {values.shape}",
                )
            )
        marker = "o" if len(steps) == 1 else None
        axes.plot(steps, values.mean(0), color=colour, lw=width, marker=marker, label=name)
        if len(values) > 1:
            low, high = values.min(0), values.max(0)
            axes.fill_between(steps, low, high, color=colour, alpha=0.18, lw=0)
    for name, height in (baseline or {}).items():
        axes.axhline(height, color=_GREY, lw=1.2, ls="--", label=name)
    for name, place in (marks or {}).items():
        axes.axvline(place, color=_INK, lw=1.0, ls=":", label=name)
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.grid(axis="y", color=_LIGHT, lw=0.6)
    if axes.get_xlim()[1] >= 1000:
        _thousands(axes)
    several = any(np.atleast_2d(_array(y)).shape[0] > 1 for _, y in curves.values())
    title = "mean, least and greatest of the seeds" if several else None
    longest = max(map(len, axes.get_legend_handles_labels()[1]))
    columns = {"ncols": max(2, 68 // (4 + longest)), "columnspacing": 1.0, "handlelength": 1.2}
    look = {"fontsize": 9, "title": title, "title_fontsize": 8, **columns, **_LEGEND}
    figure.legend(loc="outside upper center", **look)  # bands leave no corner empty
    return figure


def return_per_round(
    means: Sequence[float],
    intervals: Sequence[tuple[float, float]],
    *,
    baseline: float | None = None,
    baseline_interval: tuple[float, float] | None = None,
    ylabel: str = "return at the real system",
) -> Figure:
    """Draw the return after each round with its confidence interval, and the prior's as a band.

    Args:
        means: Mean return after rounds 1, 2, ….
        intervals: Confidence interval ``(low, high)`` of each.
        baseline: Mean return of the policy trained under the prior.
        baseline_interval: Its confidence interval.
        ylabel: What is shown.

    Raises:
        ValueError: No round, or not one interval around each mean.

    Example:
        >>> figure = return_per_round([310.0, 480.0], [(280, 340), (470, 490)], baseline=250.0)
        >>> figure.axes[0].get_xlabel()
        'round'
    """
    centre, bounds = np.asarray(means, float), np.asarray(intervals, float)
    if not centre.size or bounds.shape != (len(centre), 2):
        raise ValueError(
            message("one (low, high) per mean", f"shapes {centre.shape} and {bounds.shape}")
        )
    spread = np.stack([centre - bounds[:, 0], bounds[:, 1] - centre])
    if not (spread >= 0).all():
        raise ValueError(message("low <= mean <= high in every round", bounds.tolist()))
    figure = _figure(width=4.2, height=3.2)
    axes = _axes(figure)
    rounds = np.arange(1, len(centre) + 1)
    if baseline is not None:
        if baseline_interval is not None:
            axes.axhspan(*baseline_interval, color=_GREY, alpha=0.22, lw=0)
        axes.axhline(baseline, color=_GREY, lw=1.4, ls="--", label="trained under the prior")
    axes.errorbar(
        rounds,
        centre,
        yerr=spread,
        color=_BLUE,
        marker="o",
        ms=6,
        lw=1.6,
        capsize=4,
        label="trained under the posterior",
    )
    axes.set_xlim(0.6, len(centre) + 0.4)
    axes.set_xticks(rounds)
    axes.set_xlabel("round")
    axes.set_ylabel(ylabel)
    axes.grid(axis="y", color=_LIGHT, lw=0.6)
    axes.margins(y=0.15)
    # a difference of less than a twentieth of the return should not fill the picture
    low, high = axes.get_ylim()
    least = 0.05 * max(abs(low), abs(high))
    if high - low < least:
        middle = (low + high) / 2
        axes.set_ylim(middle - least / 2, middle + least / 2)
    axes.legend(fontsize=9, loc="best", **_LEGEND)
    return figure


def _figure(*, width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=150, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _axes(figure: Figure, cell: Any = (1, 1, 1)) -> Axes:
    axes = figure.add_subplot(*cell) if isinstance(cell, tuple) else figure.add_subplot(cell)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_INK)
    axes.tick_params(labelsize=8, color=_INK, labelcolor=_INK, length=3)
    axes.xaxis.label.set(size=10, color=_INK)
    axes.yaxis.label.set(size=10, color=_INK)
    return axes


def _array(values: Tensor) -> np.ndarray:
    return torch.as_tensor(values).detach().cpu().double().numpy()


def _points(values: Tensor, dimension: int, what: str) -> np.ndarray:
    points = _array(values)
    if points.ndim != 2 or points.shape[1] != dimension or not len(points):
        raise ValueError(message(f"{what} with {dimension} columns", tuple(points.shape)))
    if not np.isfinite(points).all():
        raise ValueError(message(f"finite {what}", "NaN or infinity"))
    return points


def _limits(points: np.ndarray, true: np.ndarray | None) -> list[tuple[float, float]]:
    low, high = np.quantile(points, [0.001, 0.999], axis=0)
    if true is not None:
        low, high = np.minimum(low, true), np.maximum(high, true)
    pad = np.where(high > low, 0.04 * (high - low), 0.5)
    return list(zip(low - pad, high + pad, strict=True))


def _marginal(axes: Axes, values: np.ndarray, prior: np.ndarray | None) -> None:
    limits = axes.get_xlim()
    if prior is not None:
        centres, heights = _density(prior, limits)
        axes.fill_between(centres, heights, color=_LIGHT, lw=0)
        axes.plot(centres, heights, color=_GREY, lw=1.0)
    centres, heights = _density(values, limits)
    axes.fill_between(centres, heights, color=_BLUE, alpha=0.25, lw=0)
    axes.plot(centres, heights, color=_BLUE, lw=1.6)
    axes.set_ylim(bottom=0)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)


def _density(values: np.ndarray, limits: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return where the density of ``values`` was estimated, and the estimate, within ``limits``."""
    shown = values[(values >= limits[0]) & (values <= limits[1])]
    if not len(shown):
        return np.zeros(0), np.zeros(0)
    edges = _edges(shown)  # not of all: one sample far out would leave the rest a single bin
    share = len(shown) / len(values)
    heights = share * gaussian_filter(np.histogram(shown, edges, density=True)[0], 2.0)
    centres = (edges[1:] + edges[:-1]) / 2
    return np.pad(centres, 1, mode="edge"), np.pad(heights, 1)


def _pair(axes: Axes, points: np.ndarray) -> None:
    """Draw the smallest regions that hold 90 % and 50 % of the ``points``."""
    edges = [_edges(points[:, 0]), _edges(points[:, 1])]
    counts = np.histogram2d(points[:, 0], points[:, 1], bins=edges)[0]
    # A rim of nothing closes the contours at the edge of the support.
    density = np.pad(gaussian_filter(counts.T, 2.0), 1)
    # Samples are counted, not smoothed density, so smoothing does not widen the regions.
    densest = np.argsort(density.ravel())[::-1]
    held = np.cumsum(np.pad(counts.T, 1).ravel()[densest]) / len(points)
    outer, inner = (
        density.ravel()[densest[np.searchsorted(held, share - 1e-9)]] for share in (0.9, 0.5)
    )
    if not 0 < outer < inner < density.max():
        axes.plot(points[:, 0], points[:, 1], ".", color=_BLUE, ms=3)
        return
    x, y = (np.pad((e[1:] + e[:-1]) / 2, 1, mode="reflect", reflect_type="odd") for e in edges)
    axes.contourf(x, y, density, [outer, inner, density.max()], colors=["#B5D6EA", "#5FA8D3"])
    axes.contour(x, y, density, [outer, inner], colors=[_BLUE], linewidths=1.0)


def _edges(values: np.ndarray) -> np.ndarray:
    low, high = values.min(), values.max()
    if low == high:
        low, high = low - 0.5, high + 0.5
    return np.linspace(low, high, 51)


def _label_edges(axes: Axes, labels: list[str], *, row: int, column: int, last: int) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(4, prune="both"))
    if row == last:
        axes.set_xlabel(labels[column])
    else:
        axes.tick_params(labelbottom=False)
    if row != column:
        axes.yaxis.set_major_locator(MaxNLocator(4, prune="both"))
        if column == 0:
            axes.set_ylabel(labels[row])
        else:
            axes.tick_params(labelleft=False)


def _handles(*, prior: bool, truth: bool) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [Patch(facecolor="#BFDBEB", edgecolor=_BLUE, label="posterior")]
    if prior:
        handles.append(Patch(facecolor=_LIGHT, edgecolor=_GREY, label="prior"))
    if truth:
        handles.append(Line2D([], [], color=_VERMILION, lw=1.2, label="truth"))
    return handles


def _widths(count: int) -> list[float]:
    """Return widths of lines, the first drawn the widest: it shows beside those that cover it."""
    return [1.6 + 0.7 * (count - 1 - i) for i in range(count)]


def _cycle(n: int) -> list[str]:
    return [_CYCLE[i % len(_CYCLE)] for i in range(n)]


def _thousands(axes: Axes) -> None:
    from matplotlib.ticker import EngFormatter

    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
