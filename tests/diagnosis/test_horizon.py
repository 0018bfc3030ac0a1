"""How many control steps a segment has."""

import pytest
from noisy_cheetah import cheetah

from torchrl_bayessim.diagnosis.horizon import chosen_horizon
from torchrl_bayessim.diagnosis.objective import units_of
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.effects.catalogue import CATALOGUE, effect


@pytest.mark.parametrize(("noisier", "steps"), [(3.0, 5), (10.0, 3)])
def test_no_longer_than_a_signature_survives_the_noise_of_the_start(noisier, steps):
    """At ten times the noise a foot comes down in another row, and all after it is another."""
    system, logs, noise = cheetah()
    units = [
        u
        for u in units_of([effect(name) for name in CATALOGUE], system.robot)
        if not u.effect.random
    ]
    found = chosen_horizon(Predictor(system), logs, units=units, noise=noisier * noise, history=8)
    assert found == steps
