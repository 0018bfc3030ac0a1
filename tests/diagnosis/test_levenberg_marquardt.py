import numpy as np
import pytest
from scipy.optimize import least_squares

from torchrl_bayessim.diagnosis.levenberg_marquardt import LevenbergMarquardt


def run(descent, function, most=50):
    calls = 0
    for _ in range(most):
        points = descent.ask()
        if descent.done:
            break
        calls += len(points)
        if points:
            descent.tell([function(point) for point in points])
    return calls


def rosenbrock(x):
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


WIDE = np.full(2, -5.0), np.full(2, 5.0)


def test_a_linear_problem_with_its_prior_is_solved_in_one_step():
    rng = np.random.default_rng(0)
    matrix, target = rng.standard_normal((20, 3)), rng.standard_normal(20)
    exact = np.linalg.solve(matrix.T @ matrix + np.diag([1.0, 1.0, 0.0]), matrix.T @ target)
    descent = LevenbergMarquardt(np.zeros(3), (np.full(3, -9.0), np.full(3, 9.0)), size=2)
    calls = run(descent, lambda x: matrix @ x - target)
    assert descent.done
    assert calls == 1 + 3 + 1  # the step kept its promise: derivatives are not made anew
    assert descent.vector == pytest.approx(exact, abs=2e-3)  # what its damping left


def test_a_curved_valley_is_followed_to_its_end():
    descent = LevenbergMarquardt(np.array([-1.2, 1.0]), WIDE, size=0)
    run(descent, rosenbrock)
    assert descent.vector == pytest.approx([1.0, 1.0], abs=0.05)


def test_a_step_from_a_known_origin_teaches_what_was_not_known():
    # r = (x0, 3 x1): the derivative by x1 is claimed to be zero, one step along x1 corrects it
    descent = LevenbergMarquardt(
        np.array([0.0, 2.0]),
        WIDE,
        size=0,
        origin=(np.zeros(2), np.zeros(2), np.array([[1.0, 0.0], [0.0, 0.0]])),
    )
    descent.ask()
    descent.tell([np.array([0.0, 6.0])])
    assert descent.jacobian == pytest.approx(np.diag([1.0, 3.0]))
    assert len(descent.ask()) == 1


def test_it_does_not_ask_for_what_it_was_told():
    start, slope = np.array([2.0, 1.0]), np.diag([1.0, 3.0])
    known = start, slope @ start, slope
    descent = LevenbergMarquardt(start, WIDE, size=0, origin=known, begun=True)
    assert descent.ask() == []
    assert not descent.done
    assert descent.cost == 4.0 + 9.0
    assert run(descent, lambda x: slope @ x) == 1
    assert descent.vector == pytest.approx([0.0, 0.0], abs=3e-3)


def test_derivatives_that_mislead_are_made_anew():
    wrong = -np.eye(2)
    descent = LevenbergMarquardt(
        np.array([2.0, 2.0]), WIDE, size=0, origin=(np.array([2.0, 2.0]), np.full(2, 2.0), wrong)
    )
    run(descent, lambda x: x)
    assert descent.vector == pytest.approx([0.0, 0.0], abs=3e-3)


def test_without_renewal_it_gives_up_instead():
    wrong = -np.eye(2)
    start = np.array([2.0, 2.0])
    descent = LevenbergMarquardt(start, WIDE, size=0, origin=(start, start, wrong), renew=False)
    run(descent, lambda x: x)
    assert descent.done
    assert descent.cost <= 8.0


def test_bounds_hold():
    descent = LevenbergMarquardt(np.zeros(1), (np.array([-1.0]), np.array([0.5])), size=0)
    run(descent, lambda x: x - 3.0)
    assert descent.vector == pytest.approx([0.5])


def test_it_ends_where_least_squares_with_derivatives_at_every_step_does():
    rng = np.random.default_rng(1)
    matrix = rng.standard_normal((40, 8))

    def function(x):
        return matrix @ (x + 0.1 * x**2) - 1.0

    descent = LevenbergMarquardt(np.zeros(8), (np.full(8, -3.0), np.full(8, 3.0)), size=8)
    calls = run(descent, function)
    peer = least_squares(lambda x: np.r_[function(x), x], np.zeros(8), x_scale="jac")
    assert descent.cost == pytest.approx(2 * peer.cost, rel=1e-3)
    assert calls < peer.nfev + 8 * peer.njev
