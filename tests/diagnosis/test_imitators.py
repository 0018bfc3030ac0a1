"""What would do the same beside other parameters, and is found as itself."""

from types import SimpleNamespace

import numpy as np
import pytest
from plain_models import Unit
from test_diagnose import SOME, logs, system

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.imitators import imitators
from torchrl_bayessim.diagnosis.model import Model
from torchrl_bayessim.diagnosis.objective import Point
from torchrl_bayessim.diagnosis.refit import Fit
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.mujoco import MujocoPhysics

SEGMENTS, WIDTH = 12, 5
GAIN, PAYLOAD, DRAG = Unit("gain"), Unit("payload"), Unit("drag")


def model_of(units, innovations, jacobian, z):
    fit = Fit(Point(z, dict.fromkeys(units, 1.0)), tuple(units), innovations, jacobian)
    return Model(fit=fit, validation=innovations, logs=np.arange(2 * SEGMENTS))


@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize(("tilt", "alike"), [(0.1, True), (1.0, False)])
def test_what_parameters_make_up_for_is_no_difference(every, tilt, alike):
    """Half as strong as in the screen, beside parameters that move by 0.2 and -0.3."""
    rng = np.random.default_rng(0)
    innovations, does, other = rng.normal(size=(3, SEGMENTS, WIDTH))
    jacobian = 100.0 * rng.normal(size=(SEGMENTS * WIDTH, 2))
    moved = np.array([0.2, -0.3])
    start = model_of([], innovations, jacobian, np.array([0.5, 0.5]))
    left = innovations + 0.5 * does + (jacobian @ moved).reshape(SEGMENTS, WIDTH)
    best = model_of([GAIN], left, np.c_[jacobian, np.zeros(len(jacobian))], np.zeros(2))
    part = start.fit.spread(every)
    seen = SimpleNamespace(
        units=(GAIN, DRAG, PAYLOAD, DRAG),
        strengths=np.array([0.1, 0.4, 0.4, 0.1]),
        changes=[does[part], -does[part], (does + tilt * other)[part], other],
        growth=np.array([*[np.sqrt(every)] * 3, 1.0]),
    )
    found = imitators(start, best, seen, most=3)
    assert [list(point.strengths) for point in found] == [[PAYLOAD]] * alike
    for point in found:
        assert point.strengths[PAYLOAD] == pytest.approx(0.2, rel=0.1)
        np.testing.assert_allclose(point.z, [0.7, 0.2], atol=0.01)
    assert not imitators(start, best, seen, most=0)
    assert not imitators(start, start, seen, most=3)


def test_nothing_is_alike_where_nothing_was_compared():
    start = model_of([], np.ones((SEGMENTS, WIDTH)), np.ones((SEGMENTS * WIDTH, 1)), np.zeros(1))
    nothing = SimpleNamespace(units=(), strengths=np.zeros(0), changes=[], growth=np.zeros(0))
    assert not imitators(start, start, nothing, most=3)


def test_more_mass_on_a_driven_link_is_not_told_from_a_weaker_motor():
    """Beside a damping; the mass is a tenth more than the simulator's, which has no prior on it."""
    bounds = {"dof_damping[hinge]": (0.0, 0.2)}
    robot = system()
    known = type(robot)(task=robot.task, physics=MujocoPhysics(*bounds), prior=BoxPrior(bounds))
    report = diagnose(known, None, logs(), effects=SOME)
    assert {"payload", "action_gain"} <= set(report.confusion_set)
