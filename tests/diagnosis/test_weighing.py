"""What speaks for a cause where test runs hardly show the gap, or speak against it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from plain_models import A, C, plain

from torchrl_bayessim.diagnosis.shrinkage import Shrinkage
from torchrl_bayessim.diagnosis.verdict import _Weighed


def with_fit(model, first, others):
    """Return a model with other mean squared innovations in the segments that it is fitted to."""
    left = np.full_like(model.fit.innovations, np.sqrt(others))
    left[0] = np.sqrt(first)
    return replace(model, fit=replace(model.fit, innovations=left))


def verdict(
    *, refit, left, sure, chance=False, validation=(1.0, 0.99), raw=9.0, ci=(-2.0, 1.0), count=1,
    by_chance=1.0, laws=1, guessed=False, strength=(0.1, 0.3), fitted=None, rest=None, missing=1.0,
):  # fmt: skip
    """Return the verdict on one effect: mean squared innovations of test runs and validation.

    Segments of the fit have those of validation, or before and after what ``fitted`` says of each.
    What is left of test runs beyond noise is known well, or within ``rest``; ``missing`` is how
    often noise would make the search miss something.
    """
    explained = (refit - left) / max(refit - 1.0, 1e-9)
    share = float(np.clip(explained, -1.0, 1.0))
    excess = (-0.2, 0.3) if refit < 1.05 else (0.5 * (refit - 1.0), 2 * refit)
    rest = rest or (left - 1.1, left - 0.9)
    measured = Shrinkage(raw, refit, left, share, ci, excess, rest, by_chance)
    units = (A, C)[:laws]
    models = [
        plain(there, 4000 * mean, segments=40, width=100)
        for there, mean in zip(((), units), validation, strict=True)
    ]
    if fitted is not None:
        models = [with_fit(model, *means) for model, means in zip(models, fitted, strict=True)]
    found = SimpleNamespace(
        p_values=[1.0 if chance else sure],
        missing=missing,
        nominal=models[0],
        best=models[0] if chance else models[1],
        offered=(A,) * 200,
    )
    weighed = _Weighed.of(
        found,
        measured,
        [SimpleNamespace(p_value=sure, ci95=strength, name=A.name)] * count,
        scattered={"losses"} if chance else set(),
        alpha=0.01,
        guessed=guessed,
    )
    return weighed.named(ambiguous=False)


SURE = {"refit": 6.0, "sure": 1e-60, "ci": (0.75, 1.0)}


@pytest.mark.parametrize(
    ("left", "rest", "missing", "said"),
    [
        (1.9, (-0.5, 2.0), 1e-3, "named"),  # more than noise is left, or not: few segments say so
        (1.9, (-0.5, 2.0), 1e-5, "named_partial"),  # and the runs of the search are sure of it
        (1.1, (-0.5, 2.0), 1e-5, "named"),  # of next to nothing of the gap
        (1.02, (-0.01, 0.04), 1e-5, "named"),  # of what no one would chase, say test runs
    ],
)
def test_what_the_search_is_sure_is_missing_is_left_of_test_runs(left, rest, missing, said):
    assert verdict(left=left, rest=rest, missing=missing, **SURE) == said


def test_test_runs_alone_say_that_next_to_nothing_is_left():
    known = {"refit": 1.6, "left": 1.02, "sure": 1e-60, "ci": (0.75, 1.0), "missing": 1e-30}
    assert verdict(rest=(-0.01, 0.04), **known) == "named"
    assert verdict(rest=(-0.01, 0.06), **known) == "named_partial"


def test_what_chance_does_is_no_effect_that_the_search_misses():
    assert verdict(left=1.9, rest=(-0.5, 2.0), missing=1e-30, chance=True, **SURE) == "named"


@pytest.mark.parametrize(
    ("sure", "refit", "said"),
    [
        (1e-60, 1.02, "named_partial"),  # test runs hold hardly any of it
        (1e-12, 1.02, "none"),
        (1e-60, 1.15, "named_partial"),
        (1e-12, 1.15, "none"),
        (1e-12, 3.0, "named_partial"),
    ],
)
def test_of_chance_on_a_small_gap_only_what_is_sure_is_named(sure, refit, said):
    assert verdict(refit=refit, left=1.0, sure=sure, chance=True) == said


@pytest.mark.parametrize(
    ("left", "sure", "validation", "said"),
    [
        (0.9, 1e-3, (1.0, 0.99), "named_partial"),
        (0.9, 1e-3, (1.0, 0.997), "none"),  # a gain that chance often makes of one of many
        (0.99, 1e-3, (1.0, 0.99), "none"),  # test runs are further off with it
        (0.99, 1e-3, (3.0, 1.2), "named_partial"),  # but validation runs are not
        (0.99, 1e-40, (1.0, 0.98), "named_partial"),
        (1.2, 1e-40, (3.0, 1.2), "none"),  # and test runs say plainly that it is nothing
    ],
)
def test_a_cause_of_a_gap_too_small_to_show_must_help_somewhere(left, sure, validation, said):
    assert verdict(refit=0.95, left=left, sure=sure, validation=validation) == said


@pytest.mark.parametrize(("sure", "said"), [(1e-3, "none"), (1e-40, "named_partial")])
def test_an_effect_whose_strength_may_have_either_sign_is_none(sure, said):
    seen = {"refit": 0.95, "left": 0.9, "sure": sure}
    assert verdict(**seen) == "named_partial"
    assert verdict(**seen, strength=(-0.2, 0.1)) == said
    assert verdict(**seen, strength=(np.nan, np.nan)) == said
    assert verdict(**seen, strength=(-0.2, 0.0)) == "named_partial"


@pytest.mark.parametrize(("sure", "said"), [(1e-3, "none"), (1e-40, "named_partial")])
def test_of_velocities_that_are_guessed_only_what_is_certain_counts_unseen(sure, said):
    """What test runs do not show at all."""
    seen = {"refit": 0.95, "left": 0.9, "sure": sure}
    assert verdict(**seen) == "named_partial"
    assert verdict(**seen, guessed=True) == said


@pytest.mark.parametrize(
    ("refit", "guessed", "said"),
    [(3.0, False, "unknown"), (3.0, True, "none"), (6.0, True, "unknown")],
)
def test_of_velocities_that_are_guessed_only_a_plain_gap_is_one(refit, guessed, said):
    found = {"refit": refit, "left": 1.5 * refit, "sure": 1e-4, "validation": (refit, refit)}
    assert verdict(**found, guessed=guessed) == said


@pytest.mark.parametrize(("left", "said"), [(11.0, "named_partial"), (23.0, "unknown")])
def test_validation_runs_name_nothing_that_makes_test_runs_worse(left, said):
    assert verdict(refit=11.3, left=left, sure=1e-20, validation=(12.0, 2.0)) == said


@pytest.mark.parametrize(("raw", "said"), [(9.0, "named"), (2.0, "named"), (1.2, "named_partial")])
def test_a_share_of_an_error_that_fitting_made_larger_is_not_enough(raw, said):
    answer = verdict(raw=raw, refit=9.0, left=1.1, sure=1e-20, validation=(9.0, 1.1), ci=(0.9, 1.0))
    assert answer == said


@pytest.mark.parametrize(
    ("count", "left", "said"),
    [(1, 1.9, "named"), (1, 2.1, "named_partial"), (2, 1.9, "named_partial"), (2, 1.15, "named")],
)
def test_two_effects_may_leave_less_than_one(count, left, said):
    answer = verdict(
        refit=200.0, raw=300.0, left=left, sure=1e-20, validation=(9.0, 1.1), ci=(0.9, 1.0),
        count=count,
    )  # fmt: skip
    assert answer == said


@pytest.mark.parametrize(("laws", "said"), [(1, "named_partial"), (2, "none")])
def test_chance_finds_more_among_pairs_than_among_effects(laws, said):
    known = {"refit": 0.95, "left": 0.9, "sure": 1e-3, "validation": (1.0, 0.995)}
    assert verdict(**known, laws=laws) == said


def test_two_laws_that_are_told_as_one_cause_may_leave_less_than_one():
    known = {"refit": 200.0, "raw": 300.0, "left": 1.9, "sure": 1e-20, "ci": (0.9, 1.0)}
    assert verdict(**known, validation=(9.0, 1.1), laws=1) == "named"
    assert verdict(**known, validation=(9.0, 1.1), laws=2) == "named_partial"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "named_partial"),  # a third of it, perhaps more
        ({"ci": (0.25, 0.35)}, "unknown"),  # surely less than 40 %
        ({"refit": 3.5, "left": 2.6}, "unknown"),  # more than the noise once more remains
        ({"by_chance": 0.05}, "unknown"),
        ({"sure": 1e-12}, "unknown"),
    ],
)
def test_a_certain_cause_that_surely_helps_is_named_with_what_remains(changes, said):
    known = {"refit": 2.0, "left": 1.67, "sure": 1e-20, "ci": (0.25, 0.6), "by_chance": 1e-4}
    assert verdict(validation=(2.0, 1.6), **(known | changes)) == said


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "named_partial"),
        ({"left": 1.13}, "named_partial"),  # what does nothing there is a little off by chance
        ({"left": 1.2}, "none"),  # test runs speak against it
        ({"sure": 1e-3}, "none"),
        ({"guessed": True}, "none"),
        ({"validation": (1.1, 1.098)}, "none"),  # a gain that chance often makes
        ({"validation": (1.3, 1.2)}, "none"),  # something is wrong that an effect may make up for
    ],
)
def test_what_all_other_runs_show_of_a_gap_no_larger_than_noise_is_named(changes, said):
    known = {
        "refit": 1.12,
        "left": 1.08,
        "sure": 1e-5,
        "ci": (-9.0, 1.0),
        "validation": (1.1, 1.08),
    }
    assert verdict(**(known | changes)) == said


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "named_partial"),
        ({"left": 1.12}, "unknown"),  # test runs speak against it
        ({"refit": 1.3, "left": 1.3}, "unknown"),  # which show the gap, but not this law
        ({"validation": (0.95, 0.951)}, "named_partial"),  # a loss that chance often makes
        ({"validation": (0.95, 0.96)}, "unknown"),
        ({"validation": (1.45, 1.45)}, "unknown"),  # validation runs show it, but not this law
        ({"sure": 1e-12}, "none"),
        ({"fitted": ((1.8, 1.8), (1.3, 1.3))}, "unknown"),  # it leaves some
        ({"fitted": ((20.0, 0.9), (0.9, 0.9))}, "unknown"),  # a single segment is odd
    ],
)
def test_what_runs_of_the_fit_show_alone_is_named_if_it_leaves_nothing_there(changes, said):
    known = {
        "refit": 1.08,
        "left": 1.08,
        "sure": 1e-40,
        "validation": (0.95, 0.948),
        "fitted": ((1.8, 1.8), (0.9, 0.9)),
    }
    assert verdict(**(known | changes)) == said
