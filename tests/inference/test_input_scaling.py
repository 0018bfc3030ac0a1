"""Statistics that never vary, and those that one absurd simulation would hide, are told."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.input_scaling import input_scaling
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.inference.sequential import sequential
from torchrl_bayessim.randomness import generator

PRIOR = BoxPrior({"a": (0.0, 1.0)})
NO_NEWS = r"None of the 2 statistics varies over \d+ simulations.*the posterior is what they were"


def pairs(count=400):
    theta = PRIOR.sample((count,), generator=generator("theta"))
    summary = 0.05 * torch.randn(count, 2, generator=generator("noise"))
    summary[:, 1:] += theta  # the other is noise
    return TensorDict({"theta": theta, "summary": summary}, [count])


def learned(data, **options):
    posterior = MixtureDensityPosterior(PRIOR, 2, **options)
    fit(posterior, data, epochs=30, progress=False)
    return posterior.condition(torch.tensor([0.0, 0.3]), check=False)


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("value", [3e38, -1e12])
def test_one_absurd_summary_is_named_and_hides_no_other(value, compress):
    data = pairs()
    data["summary"][123, 1] = value
    match = rf"Statistic 1 of pair 123 is {value:.3g}".replace("+", r"\+")
    with pytest.warns(UserWarning, match=match) as told:
        q = learned(data, compress=compress)
    assert len(told) == 1
    assert abs(q.mean - 0.3) < 0.1
    assert q.stddev < 0.12  # 0.05 without it, and 0.29 in the prior


def test_absurd_summaries_on_disk_are_named_too(tmp_path):
    data = pairs()
    data["summary"][7] = 1e30
    with pytest.warns(UserWarning, match="pair 7 is 1e") as told:
        q = learned(data.memmap_(str(tmp_path / "pairs")))
    assert [str(w.message)[:11] for w in told] == ["Statistic 0", "Statistic 1"]
    assert abs(q.mean - 0.3) < 0.1


def test_heavy_tails_and_rare_events_are_scaled_as_ever():
    heavy = torch.randn(1000, 1, generator=generator("x")) / torch.randn(
        1000, 1, generator=generator("y")
    )
    rare = (torch.arange(1000)[:, None] % 10 == 0).float() + 1e-9 * heavy
    rows = torch.cat([heavy, rare, torch.zeros(1000, 1), 1e15 * heavy], -1)
    found = input_scaling(rows.split(300))
    assert not found.absurd.any()
    torch.testing.assert_close(found.scale[[0, 3]], rows.std(0)[[0, 3]])
    assert found.scale[2].isinf()


def test_statistics_that_are_all_constant_are_said_to_say_nothing():
    data = pairs()
    data["summary"] = torch.full((400, 2), 5.0)
    with pytest.warns(UserWarning, match=NO_NEWS):
        learned(data)
    same, observed = (lambda theta: torch.full((len(theta), 2), 5.0)), torch.full((2,), 5.0)
    refinement = PosteriorRefinement(
        PRIOR, simulations=64, networks=1, fit_options={"epochs": 30, "progress": False}
    )
    with pytest.warns(UserWarning, match=NO_NEWS):
        refinement.refine(same, observed, key=(0,))
    assert abs(refinement.posterior.mean - 0.5) < 0.1
    assert refinement.posterior.stddev > 0.2
    rounds = sequential(same, PRIOR, observed, rounds=1, simulations=64, epochs=2, progress=False)
    with pytest.warns(UserWarning, match=NO_NEWS):
        next(rounds)
    data["summary"][:, 0] = data["theta"][:, 0]  # one that varies is enough
    learned(data)
