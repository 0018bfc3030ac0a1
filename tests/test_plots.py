import matplotlib as mpl
import numpy as np
import pytest
import torch
from matplotlib.collections import FillBetweenPolyCollection

from torchrl_bayessim.plots import learning_curves, pair_plot, return_per_round


@pytest.fixture(autouse=True)
def untouched_settings():
    before = dict(mpl.rcParams)
    yield
    assert dict(mpl.rcParams) == before


def lines(axes, colour):
    return [line for line in axes.lines if line.get_color() == colour]


def test_pair_plot_shows_every_pair_once_with_names_and_units(tmp_path):
    samples = torch.randn(400, 3)
    truth = torch.tensor([0.5, -0.5, 1.0])
    figure = pair_plot(
        samples,
        names=["mass", "length", "mu"],
        units=["kg", "m", ""],
        prior_samples=3 * torch.randn(400, 3),
        truth=truth,
    )
    assert len(figure.axes) == 6
    assert [axes.get_xlabel() for axes in figure.axes[3:]] == ["mass [kg]", "length [m]", "mu"]
    assert figure.axes[1].get_ylabel() == "length [m]"
    vertical, horizontal = lines(figure.axes[1], "#D55E00")
    assert vertical.get_xdata()[0] == 0.5
    assert horizontal.get_ydata()[0] == -0.5
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["posterior", "prior", "truth"]
    figure.savefig(tmp_path / "pair.png")
    assert (tmp_path / "pair.png").stat().st_size > 10_000


def test_marginals_integrate_to_one():
    figure = pair_plot(torch.rand(2_000, 1), names=["x"], prior_samples=torch.randn(2_000, 1))
    for colour in ("#0072B2", "#8A8A8A"):
        (line,) = lines(figure.axes[0], colour)
        assert np.trapezoid(line.get_ydata(), line.get_xdata()) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("far", [3.0, 300.0])
def test_a_sample_far_out_leaves_the_shape_of_the_rest(far):
    normal = torch.distributions.Normal(0.0, 1.0).icdf(torch.linspace(0.0005, 0.9995, 4000))
    samples = torch.stack([normal, normal.reshape(2, -1).T.flatten()], -1)
    samples[0] = far
    figure = pair_plot(samples, names=["a", "b"], zoom=True)
    (line,) = figure.axes[0].get_lines()
    assert (line.get_ydata() > 0.5 * line.get_ydata().max()).sum() > 10
    assert line.get_xdata()[line.get_ydata().argmax()] == pytest.approx(0, abs=0.5)
    steps = np.unique(np.round(figure.axes[1].collections[-1].get_paths()[0].vertices[:, 0], 3))
    assert len(steps) > 20  # the contour, too


def test_contours_hold_half_and_nine_tenths_of_the_samples():
    samples = torch.randn(20_000, 2) @ torch.tensor([[1.0, 0.8], [0.0, 0.3]])
    figure = pair_plot(samples, names=["a", "b"])
    contour = figure.axes[1].collections[-1]
    shares = []
    for path in contour.get_paths():
        polygons = [mpl.path.Path(p) for p in path.to_polygons(closed_only=True)]
        inside = np.any([p.contains_points(samples.numpy()) for p in polygons], axis=0)
        shares.append(inside.mean())
    assert shares == pytest.approx([0.9, 0.5], abs=0.04)


def test_a_point_mass_can_be_drawn(tmp_path):
    figure = pair_plot(torch.ones(50, 2), names=["a", "b"], truth=torch.ones(2))
    figure.savefig(tmp_path / "point.png")


def test_a_name_of_the_palette_has_its_colour_whichever_curves_are_drawn():
    def colours(*names):
        curves = {name: (torch.arange(3), torch.rand(3)) for name in names}
        axes = learning_curves(curves, palette=["prior", "posterior", "oracle"]).axes[0]
        return {line.get_label(): line.get_color() for line in axes.lines}

    every = colours("prior", "posterior", "oracle")
    assert len(set(every.values())) == 3
    assert colours("oracle", "prior") == {name: every[name] for name in ("oracle", "prior")}


def test_learning_curves_have_a_band_for_several_seeds_only():
    x = torch.arange(4)
    figure = learning_curves({"many": (x, torch.rand(3, 4)), "one": (x, torch.rand(4))})
    (axes,) = figure.axes
    bands = [c for c in axes.collections if isinstance(c, FillBetweenPolyCollection)]
    assert len(bands) == 1
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["many", "one"]


@pytest.mark.parametrize(("end", "shown"), [(2.0, "0.5"), (4000.0, "1k")])
def test_curves_over_physics_have_marks_and_plain_numbers(end, shown, tmp_path):
    x = torch.linspace(0.0, end, 5)
    figure = learning_curves({"prior": (x, torch.rand(3, 5))}, marks={"the robot": end / 4})
    (axes,) = figure.axes
    assert any(list(line.get_xdata()) == [end / 4, end / 4] for line in axes.lines)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["prior", "the robot"]
    figure.savefig(tmp_path / "curves.png")
    assert any(label.get_text().startswith(shown) for label in axes.get_xticklabels())


def test_return_per_round_draws_intervals_and_the_baseline():
    figure = return_per_round(
        [1.0, 2.0], [(0.5, 1.25), (1.5, 2.0)], baseline=0.8, baseline_interval=(0.7, 0.9)
    )
    (axes,) = figure.axes
    (bars,) = axes.collections
    segments = [segment[:, 1].tolist() for segment in bars.get_segments()]
    assert segments == [[0.5, 1.25], [1.5, 2.0]]
    assert lines(axes, "#8A8A8A")[0].get_ydata()[0] == 0.8


@pytest.mark.parametrize(
    ("draw", "match"),
    [
        (lambda: pair_plot(torch.rand(5, 3), names=["a", "b"]), "samples with 2 columns"),
        (lambda: pair_plot(torch.rand(0, 1), names=["a"]), "samples with 1 columns"),
        (lambda: pair_plot(torch.rand(5, 1) / 0, names=["a"]), "finite samples"),
        (lambda: pair_plot(torch.rand(5, 1), names=["a"], units=["m", "s"]), "one unit per name"),
        (
            lambda: pair_plot(torch.rand(5, 1), names=["a"], truth=torch.rand(2)),
            "truth with 1 columns",
        ),
        (lambda: learning_curves({}), "at least one curve"),
        (
            lambda: learning_curves({"a": (torch.rand(3), torch.rand(3))}, palette=["b", "c"]),
            r"curves that palette names, got \['a'\]. Available: b, c",
        ),
        (
            lambda: learning_curves({"a": (torch.rand(3), torch.rand(4))}),
            r"x \(P,\) and y .* in curve 'a'",
        ),
        (lambda: return_per_round([], []), r"one \(low, high\) per mean"),
        (lambda: return_per_round([1.0], [(2.0, 3.0)]), "low <= mean <= high"),
    ],
)
def test_bad_input_is_refused(draw, match):
    with pytest.raises(ValueError, match=match):
        draw()
