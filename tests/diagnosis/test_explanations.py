"""Which fits the search goes on with."""

import pytest
from plain_models import A, B, C, plain

from torchrl_bayessim.diagnosis.explanations import _at_other_places, _fittest


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


@pytest.mark.parametrize(
    ("best", "tried", "goes_on"),
    [
        ([(100.0, A)], [(90.0, C), (150.0, A, B), (140.0, B)], (140.0, B)),
        ([(100.0, A)], [(138.0, A, B), (140.0, B)], (140.0, B)),  # of two strengths
        ([(100.0, A)], [(120.0, A, B), (140.0, B)], (120.0, A, B)),
        ([(100.0, A)], [(249.0, B)], (249.0, B)),
        ([(100.0, A)], [(251.0, B)], None),
        ([(100.0, A)], [(110.0, A), (90.0, C)], None),
        ([(100.0, A, B)], [(110.0, B, A), (900.0, C)], None),
        ([(100.0, A, B), (120.0, A)], [(120.0, A), (140.0, B)], (140.0, B)),
        ([(90.0, C), (100.0, A)], [(110.0, B)], None),
        ([(100.0, A)], [(110.0, A._replace(high=2.0))], None),
    ],
    ids=[
        "other places",
        "fewer",
        "surely more",
        "as good",
        "worse",
        "the same",
        "the same, turned",
        "one of them goes on",
        "not the best",
        "the same in another form",
    ],
)
def test_the_best_effect_at_other_places_goes_on_if_a_few_segments_hardly_tell(
    best, tried, goes_on
):
    tried = {one: fit(*one) for one in tried}
    found = _at_other_places([fit(*one) for one in best], list(tried.values()))
    assert found == ([] if goes_on is None else [tried[goes_on]])


def test_what_the_prior_holds_against_a_place_counts():
    at_one, far = fit(100.0, A), plain((B,), 150.0, z=8.0).fit
    assert _at_other_places([at_one], [far]) == []
