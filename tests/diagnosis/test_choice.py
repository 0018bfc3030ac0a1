"""Which of the explanations that a round has fitted the search goes on with."""

import pytest
from plain_models import Unit, plain

from torchrl_bayessim.diagnosis import choice

COG, FRICTION, LENGTH = (Unit(name) for name in ("cogging", "load_friction", "link_length"))


@pytest.mark.parametrize("white", [False, True])
def test_one_effect_in_the_place_of_two_has_its_forms_fitted_before_rivals_are_compared(
    monkeypatch, white
):
    """Cogging whose rate was bent lets a longer link do nearly what friction does beside it."""
    base = plain([COG], 3110.0)
    single, bent = plain([COG, FRICTION], 30.0 if white else 1699.0), plain([COG, FRICTION], 1406.0)
    both = plain([COG, FRICTION, LENGTH], 1650.0)
    monkeypatch.setattr(choice, "chosen", lambda _, models: single if single in models else None)
    monkeypatch.setattr(choice, "_no_simpler", lambda *_: False)
    monkeypatch.setattr(choice, "with_fitted_forms", lambda *given: bent)
    found = choice.fewest(
        ("train", "validation"),
        base,
        both,
        [both, single],
        worth=lambda *_, **__: False,
        offered=[],
    )
    assert found is (single if white else bent)
