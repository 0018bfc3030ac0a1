"""When runs show that a model is better: those that judge, or all together."""

import numpy as np
import pytest
from plain_models import A

from torchrl_bayessim.diagnosis.model import Model, shown
from torchrl_bayessim.diagnosis.objective import Point
from torchrl_bayessim.diagnosis.refit import Fit

LOGS = np.repeat(np.arange(5), 4)  # the last two judge
WIDTH = 25


def model(units, gains, level=1.0):
    """Return a model that leaves so much less in each run than white noise at that level."""
    each = np.repeat(level * 4 * WIDTH - np.asarray(gains, float), 4) / 4
    left = np.sqrt(each / WIDTH)[:, None] * np.ones(WIDTH)
    jacobian = np.ones((12 * WIDTH, 1 + len(units)))
    fit = Fit(Point(np.zeros(1), dict.fromkeys(units, 1.0)), tuple(units), left[:12], jacobian)
    return Model(fit=fit, validation=left[12:], logs=LOGS)


@pytest.mark.parametrize(
    ("gains", "level", "says"),
    [
        ([0, 0, 0, 3, 2], 1.0, True),  # runs that judge
        ([10, 9, 8, 2, 1], 1.0, True),  # all together
        ([10, 9, 8, 2, 1], 1.25, False),  # where more than noise is left, that says little
        ([10, 9, 8, -2, -1], 1.0, False),  # runs that judge say the opposite
        ([6, 5, 4, 2, 1], 1.0, False),  # as much as the best of many makes by chance
        ([28, 0, 0, 1, 1], 1.0, False),  # one run alone, which may be odd
        ([50, 0, 0, 1, 1], 1.0, True),  # twice as surely
    ],
)
def test_what_shows_that_there_is_an_effect(gains, level, says):
    assert shown(model((), np.zeros(5), level), model((A,), gains, level)) is says


def test_beside_an_effect_several_runs_have_to_show_another():
    """What makes up for its form may be worth as much."""
    base = model((A,), np.zeros(5))
    assert not shown(base, model((A, A._replace(where="x")), [10, 9, 8, 2, 1]))
    assert shown(base, model((A, A._replace(where="x")), [25, 24, 8, 2, 1]))
