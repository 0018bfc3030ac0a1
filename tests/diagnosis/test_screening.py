"""What moves the data too far to be compared would have been seen."""

import numpy as np
import pytest
import torch
from test_diagnose import logs, run, system

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.objective import Point, Unit, units_of
from torchrl_bayessim.diagnosis.refit import Fit
from torchrl_bayessim.diagnosis.screening import Screen, _levels, crossing, screen
from torchrl_bayessim.effects.catalogue import effect


class Quiet:
    """Randomness of the commands, and a thousandth of the sensors' noise."""

    def __init__(self, seed):
        self._rng = np.random.default_rng(seed)

    def uniform(self, low, high):
        return self._rng.uniform(low, high)

    def normal(self, scale=1.0, size=None):
        return self._rng.normal(scale=scale, size=size) * (1.0 if size is None else 1e-3)


def test_an_effect_that_is_far_too_strong_is_not_called_invisible():
    data = logs()
    for i, log in enumerate(data):
        state, u = run(Quiet(i), len(log))
        log.qpos[:], log.qvel[:] = torch.from_numpy(state).split(1, dim=1)
        log.ctrl[:] = torch.from_numpy(u[:, None])
    names = ("parallel_spring", "coulomb_friction", "action_gain")
    report = diagnose(system(), None, data, effects=names)
    assert not [c.name for c in report.candidates if c.status == "not_excited"]
    spring = next(c for c in report.candidates if c.name == "parallel_spring")
    assert 0 < spring.minimal_detectable_strength < 0.05


@pytest.mark.parametrize(("norms", "found"), [([10.0, 80.0], 0.1), ([10.0, 1000.0], 10**-0.5)])
def test_below_the_lowest_level_norms_fall_as_they_do_above_it(norms, found):
    """In proportion, or faster: a tenth of the norm at 0.1 of the strength, or at 0.32 of it."""
    strengths = np.array([1.0, 10.0])
    assert crossing(strengths, np.array(norms), 1.0) == pytest.approx(found)


def test_limits_are_compared_at_more_strengths_than_what_grows_steadily():
    """Between a limit that is never reached and one that is always is a factor of a few."""
    robot = system().robot
    counts = {
        name: len(_levels(units_of([effect(name)], robot)[0]))
        for name in ("torque_speed_limit", "saturation", "coulomb_friction")
    }
    assert counts["torque_speed_limit"] == counts["saturation"] > counts["coulomb_friction"] == 2


def drawn(columns, left, units):
    """Return a screen of signatures ``(M, G)`` of what is left ``(M,)``."""
    directions = columns / np.linalg.norm(columns, axis=0)
    size = columns.shape[1]
    return Screen(
        units=units, strengths=np.ones(size), norms=np.linalg.norm(columns, axis=0),
        sizes=np.ones(size), scores=directions.T @ left, correlation=directions.T @ directions,
        swallowed=np.zeros(size), residual=float(left @ left), effective=len(left),
        changes=(), growth=np.ones(size),
    )  # fmt: skip


def test_what_others_could_have_explained_is_not_counted():
    """The likelihood ratio is the squared norm that least squares gain beside the others."""
    columns = np.random.default_rng(0).normal([1.0, 1.0, 0.0], size=(200, 3))
    left = columns @ [2.0, 0.5, 1.0]
    found = drawn(columns, left, ("a", "b", "c")).beside({"a"}, 2.0)
    assert found.keys() == {"b", "c"}
    for i, name in ((1, "b"), (2, "c")):
        squares = [np.linalg.lstsq(columns[:, some], left)[1][0] for some in ([0], [0, i])]
        assert found[name] == pytest.approx((squares[0] - squares[1]) / 2.0)


def test_what_others_explain_wholly_is_left_out():
    columns = np.random.default_rng(1).normal(size=(200, 2))
    columns = np.c_[columns, columns @ [1.0, -1.0]]
    assert not drawn(columns, columns[:, 2], ("a", "b", "c")).beside({"a", "b"}, 1.0)
    # and what explains the opposite explains nothing
    assert drawn(columns, -columns[:, 0], ("a", "b", "c")).beside({"b"}, 1.0)["a"] == 0.0


def test_strengths_of_both_signs_are_those_that_were_asked_for():
    """Of an offset that changes everything in proportion."""
    unit = Unit(effect("action_bias"), "motor", (1.0,), -0.3, 0.6)
    slope = np.arange(12.0).reshape(3, 4)

    class Proportional:
        size = 1

        def __call__(self, points):
            return np.stack([slope * point.strengths[unit] for point in points])

    fit = Fit(Point(np.zeros(1)), (), np.zeros((3, 4)), np.zeros((12, 1)))
    seen = screen(Proportional(), fit, [unit], levels=(0.02, 0.06))
    assert len(seen.strengths) == 5  # both, their opposites, and much of the opposite
    for strength, change in zip(seen.strengths, seen.changes, strict=True):
        np.testing.assert_allclose(change, strength * slope, rtol=1e-5)
