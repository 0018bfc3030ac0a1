"""Fits of problems with a known answer; the objective stands for simulator and whitening."""

import numpy as np
import pytest

from torchrl_bayessim.diagnosis.objective import Objective, Point, Unit
from torchrl_bayessim.diagnosis.refit import Fit, refit, with_width
from torchrl_bayessim.effects.action import ActionBias
from torchrl_bayessim.effects.joints import CoulombFriction

RIGHT = Unit(CoulombFriction(), "hinge", (1.0,), 0.0, 1.0)
WRONG = Unit(ActionBias(), "motor", (1.0,), -1.0, 1.0)


class Bends:
    """40 innovations that the right unit explains, and the wrong one hardly, along a curve."""

    size, prior, width = 1, None, 0.01

    def __init__(self):
        self.evaluations = {RIGHT: 0, WRONG: 0}
        self.truth = np.linspace(1.0, 5.0, 40)

    def __call__(self, points):
        return np.stack([self.one(point) for point in points])

    def one(self, point):
        (unit, strength), *_ = point.strengths.items()
        self.evaluations[unit] += 1
        if unit == RIGHT:
            left = self.truth * (0.5 - strength)
        else:
            left = 0.5 * self.truth + np.cos(np.arange(40)) * np.abs(strength - 0.9) ** 1.5
        return 20.0 * left.reshape(1, 40)


STARTS = [Point(np.zeros(1), {RIGHT: 0.1}), Point(np.zeros(1), {WRONG: 0.1})]


def test_a_race_stops_what_is_far_behind_and_leaves_the_best_alone():
    alone, raced = Bends(), Bends()
    best, _ = refit(alone, STARTS)
    first, second = refit(raced, STARTS, race=np.inf)
    assert first.point.strengths[RIGHT] == pytest.approx(0.5, abs=2e-3)
    assert first.cost == best.cost
    assert raced.evaluations[RIGHT] == alone.evaluations[RIGHT]
    assert raced.evaluations[WRONG] < alone.evaluations[WRONG]
    assert second.units == (WRONG,)


def test_a_fit_goes_on_from_another_without_evaluating_its_point_again():
    once, twice = Bends(), Bends()
    whole = refit(once, STARTS, iterations=2, renew=False)
    first = refit(twice, STARTS, iterations=1, renew=False)
    then = refit(twice, first, iterations=1, renew=False)
    assert twice.evaluations[RIGHT] == once.evaluations[RIGHT]
    assert then[0].point.strengths[RIGHT] == pytest.approx(
        whole[0].point.strengths[RIGHT], abs=1e-3
    )


def test_a_known_cost_may_be_what_a_fit_is_behind():
    alone, raced = Bends(), Bends()
    refit(alone, STARTS[1:])
    refit(raced, STARTS[1:], race=0.0)
    assert raced.evaluations[WRONG] < alone.evaluations[WRONG]


class Rough(Objective):
    """60 innovations that one parameter explains, with a ripple or without."""

    def __init__(self, ripple, coordinates=2):
        self.ripple, self.prior, self.coordinates = ripple, None, coordinates

    @property
    def size(self):
        return self.coordinates

    def __call__(self, points, offsets=None):
        z = np.array([point.z[0] for point in points])[:, None]
        rows = np.arange(60.0)
        left = 0.5 * (z - 1.5) * (1 + rows / 60) + self.ripple * np.sin(400 * z + rows**2)
        return left[:, None]


def test_derivatives_are_wide_where_residuals_are_rough():
    start = Point(np.zeros(2))
    rough, smooth = Rough(0.05), Rough(0.0)
    assert with_width(smooth, start) is smooth
    wide = with_width(rough, start)
    assert wide.width > rough.width
    exact = refit(smooth, [start])[0].point.z[0]
    assert refit(wide, [start])[0].point.z[0] == pytest.approx(exact, abs=0.05)


def test_without_parameters_derivatives_stay_narrow():
    objective = Rough(0.05, coordinates=1)
    assert with_width(objective, Point(np.zeros(1))) is objective


def test_a_strength_is_known_less_well_beside_what_else_was_fitted():
    """By hand: two columns at a correlation of 0.8 leave 1 - 0.64 of the precision."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(3000, 3)))[0]
    column, other = basis[:, 0] * 40.0, basis[:, 1]
    slope = 25.0 * (0.8 * basis[:, 0] + 0.6 * other)
    innovations = rng.normal(size=(100, 30))
    alone = Fit(Point(np.zeros(0), {RIGHT: 0.3}), (RIGHT,), innovations, column[:, None])
    beside = Fit(alone.point, alone.units, innovations, alone.jacobian, slope[:, None])
    assert beside.covariance(1.0).shape == (1, 1)
    ratio = beside.covariance(1.0)[0, 0] / alone.covariance(1.0)[0, 0]
    assert ratio == pytest.approx(1 / (1 - 0.64), rel=0.3)
