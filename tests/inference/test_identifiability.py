import math

import pytest
import torch

from torchrl_bayessim.inference.identifiability import identifiability
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.truncation import TruncatedGaussianMixture

BOX = BoxPrior({"mass": (2.0, 6.0), "link length 2": (0.5, 1.5)})


def gaussian(prior, scale_tril, loc=None):
    d = len(prior.names)
    loc = torch.zeros(1, d) if loc is None else torch.tensor([loc])
    mixture = TruncatedGaussianMixture(
        torch.zeros(1), loc, torch.tensor(scale_tril)[None], prior.box
    )
    return PhysicsPosterior(mixture, prior)


def test_what_the_data_say_nothing_about_is_named():
    found = identifiability(gaussian(BOX, [[0.01, 0.0], [0.0, 100.0]]))
    first, second = found.sentences()
    assert first.startswith("These data say much about mass: ")
    assert second == "These data say nothing about link length 2 (0.00 nats over the prior)."
    assert str(found) == f"{first}\n{second}"


def test_nats_of_a_gaussian_within_a_gaussian():
    """KL(N(m, s^2) || N(0, 1)) = (s^2 + m^2 - 1) / 2 - log s."""
    prior = GaussianPrior({"a": (3.0, 2.0), "b": (0.0, 1.0)})
    found = identifiability(gaussian(prior, [[0.5, 0.0], [0.0, 0.1]], loc=[0.3, 0.0]))
    expected = [(0.25 + 0.09 - 1) / 2 - math.log(0.5), (0.01 - 1) / 2 - math.log(0.1)]
    assert found.nats.tolist() == pytest.approx(expected, abs=0.05)
    assert found.narrowing.tolist() == pytest.approx([0.5, 0.1], rel=0.05)


@pytest.mark.parametrize(("share", "nats"), [(0.5, math.log(2)), (0.1, math.log(10))])
def test_nats_count_how_often_the_range_was_halved(share, nats):
    """Against a larger prior, as after a refinement: uniform on a share of the range."""
    small = BoxPrior({"mass": (2.0, 2.0 + 4 * share)})
    found = identifiability(
        gaussian(small, [[1e3]]), prior=BoxPrior({"mass": (2.0, 6.0)}), draws=2000
    )
    assert found.nats.item() == pytest.approx(nats, abs=0.01)


def test_a_logarithmic_parameter_counts_in_its_own_prior():
    prior = BoxPrior({"damping": (0.01, 1.0)}, log=["damping"])
    assert identifiability(gaussian(prior, [[1e3]])).nats.item() == pytest.approx(0.0, abs=1e-3)
    half = prior.within(torch.tensor([0.1]), torch.tensor([1.0]))
    nats = identifiability(gaussian(half, [[1e3]]), prior=prior).nats.item()
    assert nats == pytest.approx(math.log(2), abs=0.01)


@pytest.mark.parametrize(("sign", "what"), [(1.0, "difference"), (-1.0, "sum")])
def test_parameters_known_only_together_are_named_as_a_pair(sign, what):
    found = identifiability(gaussian(BOX, [[0.5, 0.0], [sign * 0.5, 0.05]]))
    ((first, second, r),) = found.pairs
    assert {first, second} == set(BOX.names)
    assert math.copysign(1, r) == sign
    assert found.sentences()[-1].startswith("mass and link length 2 trade off (correlation ")
    assert f"something like their {what}" in found.sentences()[-1]


def test_independent_parameters_are_no_pair():
    assert identifiability(gaussian(BOX, [[0.1, 0.0], [0.0, 0.1]])).pairs == []
