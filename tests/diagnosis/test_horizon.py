"""How many control steps a segment has."""

from dataclasses import replace

import numpy as np
import pytest
from noisy_cheetah import cheetah

from torchrl_bayessim.diagnosis import horizon
from torchrl_bayessim.diagnosis.objective import units_of
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.whitening import whitening
from torchrl_bayessim.effects.catalogue import CATALOGUE, effect
from torchrl_bayessim.logs.touching import Touching

SYSTEM, LOGS, NOISE = cheetah()
UNITS = units_of([effect(name) for name in CATALOGUE], SYSTEM.robot)


def chosen(logs=LOGS, *, noisier=1.0):
    units = [unit for unit in UNITS if not unit.effect.random]
    return horizon.chosen_horizon(
        Predictor(SYSTEM), logs, units=units, noise=noisier * NOISE, history=8
    )


def test_no_longer_than_a_signature_survives_the_noise_of_the_start(monkeypatch):
    """At ten times the noise a foot comes down in another row, and all after it is another."""
    assert chosen(noisier=10.0) == 3
    monkeypatch.setattr(horizon, "_alike", lambda *_: 1.0)
    assert chosen(noisier=10.0) > 3


def _linear(*arguments, generator):
    return whitening(*arguments)


def test_rows_that_contacts_make_loud_tell_less(monkeypatch):
    system, logs, noise = cheetah(amplitude=1.0)
    names = "viscous_friction", "coulomb_friction", "action_gain", "sensor_bias"
    units = units_of([effect(name) for name in names], system.robot)
    given = {"units": units, "noise": noise, "history": 8}
    assert horizon.chosen_horizon(Predictor(system), logs, **given) == 3
    monkeypatch.setattr(horizon, "whitening", _linear)
    assert horizon.chosen_horizon(Predictor(system), logs, **given) > 3


def settled(rows):
    """Return the logs as far as that, as if contacts had said something of their starts."""
    size = 2 * SYSTEM.task.model.nv
    free = np.broadcast_to(np.eye(size), (rows, size, size))
    nothing = Touching(np.zeros((rows, size)), free, np.zeros((rows, size, size)))
    return [
        replace(
            log,
            time=log.time[:rows],
            qpos=log.qpos[:rows],
            qvel=log.qvel[:rows],
            ctrl=log.ctrl[:rows],
            touching=nothing,
        )
        for log in LOGS
    ]


@pytest.mark.parametrize(
    ("rows", "noisier", "steps"), [(80, 1.0, 10), (80, 10.0, 3), (40, 1.0, 10)]
)
def test_where_contacts_were_filtered_fewer_steps_only_if_ten_are_scrambled(rows, noisier, steps):
    assert chosen(settled(rows), noisier=noisier) == steps


def test_effects_that_do_not_show_are_not_scrambled():
    nothing, loud = (np.full((3, 4, 6), value) for value in (1e-6, 2.0))
    assert horizon._alike(nothing, -nothing) == 1.0
    assert horizon._alike(loud, -loud) == pytest.approx(-1.0)
