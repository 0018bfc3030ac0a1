"""What force is missing does not depend on whether a part of it is in the model already."""

import numpy as np
import pytest
from rail_cart import cart, ride

from torchrl_bayessim.diagnosis.missing_force import missing_forces
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.effects.catalogue import effect


def test_beside_a_push_less_of_it_is_missing():
    rng = np.random.default_rng(1)
    logs = [ride(rng, 200, lambda *_: 0.5, noise=[0.0005, 0.01]) for _ in range(6)]
    pushes = units_of([effect("constant_force")], cart().robot)
    known = prepare(cart(), logs, pushes, generator=np.random.default_rng(0))
    for there in (0.0, 0.2, 0.5, 1.0):
        point = Point(np.zeros_like(known.nominal.point.z), {pushes[0]: there})
        for found in missing_forces(known.sets["train"], point, pushes):
            mean = np.average(found.forces[:, 0], weights=1 / found.variances[:, 0])
            assert mean == pytest.approx(0.5 - there, abs=0.03)
