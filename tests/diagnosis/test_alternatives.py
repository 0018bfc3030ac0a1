"""What is tried in the place of an effect."""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from torchrl_bayessim.diagnosis import alternatives
from torchrl_bayessim.diagnosis.model import Model
from torchrl_bayessim.diagnosis.objective import Point


class Unit(NamedTuple):
    name: str
    where: str = "hinge"


GAIN, PAYLOAD, DRAG, OFFSET = (Unit(name) for name in ("gain", "payload", "drag", "offset"))


def model(strengths, deviance, *, z=0.0):
    left = np.full((20, 10), np.sqrt(deviance / 400))
    point = Point(np.array([z]), strengths)
    fit = SimpleNamespace(units=tuple(strengths), innovations=left, point=point, cost=deviance)
    return Model(fit=fit, validation=left, logs=np.arange(40))


@pytest.mark.parametrize(("deviance", "count"), [(1175.0, 1), (5000.0, 0)])
def test_what_was_as_good_alone_is_tried_beside_the_others_from_its_own_parameters(
    monkeypatch, deviance, count
):
    monkeypatch.setattr(alternatives, "refit", lambda _, starts, *, race: starts)
    monkeypatch.setattr(alternatives, "judged", lambda *found: found[-1])
    best = model({GAIN: -0.5, OFFSET: 0.1}, 320.0)
    tried = [
        model({}, 17_000.0),
        model({GAIN: -0.5}, 1172.0),
        model({PAYLOAD: 1.0}, deviance, z=3.0),
        model({DRAG: 1.0, PAYLOAD: 1.0}, 1170.0),  # two in the place of one
        model({OFFSET: 0.3}, 1170.0),  # there already
    ]
    starts = alternatives._as_before(("train", "validation"), best, "gain", tried)
    assert len(starts) == count
    for start in starts:
        assert start.strengths == {OFFSET: 0.1, PAYLOAD: 1.0}
        assert start.z == 3.0
    assert not alternatives._as_before(("train", "validation"), tried[1], "gain", tried)
