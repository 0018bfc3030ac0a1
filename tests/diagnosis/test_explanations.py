"""Which fits the search goes on with."""

from plain_models import A, B, C, plain

from torchrl_bayessim.diagnosis.explanations import _elsewhere, _fittest


def fit(misfit, *units):
    return plain(units, misfit).fit


def test_an_effect_at_one_place_stays_beside_the_same_at_several_that_fits_a_little_better():
    at_one, at_both, other = fit(400.0, A), fit(200.0, A, B), fit(900.0, C)
    worse, anything = fit(500.0, B), fit(950.0, A, C)
    fits = [at_both, at_one, worse, other, anything]
    assert _fittest(fits, 2, alike=1) == [at_both, at_one, other]
    assert _fittest(fits, 2, there=[C], alike=1) == [at_both, at_one, other]
    pair, at_both_with_other = fit(250.0, A, C), fit(300.0, A, B, C)
    assert _fittest([at_both_with_other, pair, other], 2, alike=1) == [pair, other]


def test_of_one_kind_only_so_many_go_on():
    fits = [fit(100.0 + i, unit) for i, unit in enumerate((A, B))]
    assert _fittest(fits, 4, alike=1) == fits[:1]
    assert _fittest(fits, 4, alike=2) == fits


def test_the_same_effect_elsewhere_is_added_like_any_other():
    elsewhere, other, two = fit(300.0, A, B), fit(200.0, A, C), fit(100.0, A, B, C)
    fits = [elsewhere, other, two]
    assert _fittest(fits, 2, alike=1) == [two, other, elsewhere]
    assert _fittest(fits, 2, there=[A], alike=1) == [other, elsewhere]


def test_the_best_effect_at_another_place_goes_on_if_a_few_steps_hardly_tell():
    at_all, at_one, next_one = fit(100.0, A), fit(140.0, B), fit(150.0, A, B)
    far, other = fit(900.0, B), fit(90.0, C)
    assert _elsewhere(at_all, [other, next_one, at_one, at_all]) == [at_one]
    assert _elsewhere(at_all, [fit(110.0, A), far, other]) == []
    assert _elsewhere(other, [at_all, at_one, other]) == []
