"""A wave of which the frequency was read off beside too little is read off anew."""

from functools import partial

import numpy as np
import pytest
from rail_cart import cart, ride

from torchrl_bayessim.diagnosis.model import judged_fits
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.preparation import prepare
from torchrl_bayessim.diagnosis.shapes import shaped
from torchrl_bayessim.diagnosis.waves_anew import with_waves_anew
from torchrl_bayessim.effects.catalogue import effect

NOISE = np.array([0.0005, 0.01])


def on_a_rail(frequency):
    """Return both sets, a function of what is seen beside a model, and a push with a slow wave."""
    rng = np.random.default_rng(1)
    push = lambda time, position: 0.5 + 0.2 * np.sin(2 * np.pi * 0.9 * time + 1.0)
    logs = [ride(rng, 400, push, noise=NOISE, finer=4) for _ in range(6)]
    waves = effect("periodic_disturbance", frequency=frequency, phase=0.0)
    units = units_of([effect("constant_force"), waves], cart().robot)
    known = prepare(cart(), logs, units, generator=np.random.default_rng(0))
    sets = known.sets["train"], known.sets["validation"]
    seen = partial(shaped, known.predictor, known.logs["train"], noise=NOISE, pushes=units[:1])
    z = known.nominal.point.z
    (model,) = judged_fits(*sets, [Point(z, dict(zip(units, (0.4, 0.1), strict=True)))])
    return sets, lambda point: seen(point=point), model


def test_a_wave_at_another_maximum_is_found_where_it_is():
    sets, seen, model = on_a_rail(1.3)
    assert model.mean_square > 1.5
    push, _ = model.units
    better = with_waves_anew(sets, model, seen, model.units)
    assert better.mean_square < 1.2
    (wave,) = (unit for unit in better.units if unit != push)
    assert wave.effect.frequency == pytest.approx(0.9, rel=0.02)
    strengths = better.fit.point.strengths
    assert strengths[push] == pytest.approx(0.5, rel=0.1)
    assert strengths[wave] == pytest.approx(0.2, rel=0.1)
    # noise alone is left
    assert with_waves_anew(sets, better, lambda _: pytest.fail("asked"), better.units) is better


@pytest.mark.parametrize("alone", [True, False])
def test_a_wave_stays_where_there_is_no_better_one(alone):
    sets, seen, model = on_a_rail(1.3)
    if alone:  # it was read off beside nothing else
        wave = model.units[1]
        (model,) = judged_fits(*sets, [Point(model.fit.point.z, {wave: 0.1})])
    assert with_waves_anew(sets, model, seen if alone else lambda _: [], model.units) is model


def test_of_several_waves_each_is_read_off_anew():
    """The second is looked for where the first one's fit has left it."""
    sets, seen, model = on_a_rail(1.3)
    (magnets,) = units_of([effect("cogging", number=31.0, phase=0.0)], cart().robot)
    point = model.fit.point.beside({magnets: 0.05})
    (model,) = judged_fits(*sets, [point])
    asked = []

    def waves(point):
        asked.append([unit.name for unit in point.strengths])
        return seen(point) + units_of([effect("cogging", number=47.0)], cart().robot)

    better = with_waves_anew(sets, model, waves, model.units)
    assert better.fit.cost < model.fit.cost
    assert {unit.name for unit in better.units} == {unit.name for unit in model.units}
    assert asked[0] == ["constant_force", "cogging"]
