"""Pairs on disk: the same numbers as in memory, from simulation to posterior."""

import pytest
import torch
from tensordict import MemoryMappedTensor, TensorDict
from torchrl.envs import Compose, TransformedEnv

from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.inference import rows
from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.rows import spread
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.randomness import generator
from torchrl_bayessim.simulate import simulate
from torchrl_bayessim.summaries import SummaryStatistics, linear_dynamics
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

PRIOR = BoxPrior({"length": (0.1, 2.0), "masspole": (0.1, 2.0)})
QUICK = {"epochs": 4, "batch_size": 64, "progress": False}


def simulated(statistics=None, **options):
    randomizer = DomainRandomizer(PRIOR)
    physics = ApplyPhysics(AttributePhysics(*PRIOR.names))
    env = TransformedEnv(CartPoleEnv(50), Compose(physics, randomizer))
    given = {"pairs": 330, "max_steps": 15, "trajectories": 3, "progress": False} | options
    return simulate(
        env, None, statistics or SummaryStatistics(linear_dynamics), randomizer, **given
    )


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """Return the same pairs in memory and on disk."""
    folder = tmp_path_factory.mktemp("pairs") / "stored"
    return simulated(), simulated(folder=folder)


def fitted(pairs, **options):
    posterior = MixtureDensityPosterior(PRIOR, pairs["summary"].shape[-1])
    report = fit(posterior, pairs, **QUICK | options)
    return report, posterior


def test_pairs_on_disk_are_those_in_memory_and_can_be_loaded(both):
    memory, disk = both
    assert isinstance(disk["theta"], MemoryMappedTensor)
    assert isinstance(disk["summary"], MemoryMappedTensor)
    assert disk.batch_size == (330,)
    assert torch.equal(memory["theta"], disk["theta"])
    assert torch.equal(memory["summary"], disk["summary"])
    folder = disk["theta"].filename.rpartition("/")[0]
    assert (TensorDict.load_memmap(folder) == memory).all()


def test_a_fit_from_disk_is_the_fit_from_memory(both):
    (one, memory), (other, disk) = (fitted(pairs) for pairs in both)
    assert one == other
    for name, value in memory.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, disk.state_dict()[name]), name


def test_a_fit_that_reads_many_parts_differs_by_rounding_alone(both, monkeypatch):
    whole, _ = fitted(both[1])
    monkeypatch.setattr(rows, "PART", 70)
    split, _ = fitted(both[1])
    assert split.train == pytest.approx(whole.train, abs=3e-3)
    assert split.validation == pytest.approx(whole.validation, abs=3e-3)


def test_only_minibatches_and_parts_are_read_from_disk(both, monkeypatch):
    sizes = []
    read = rows.Rows.__getitem__

    def watched(self, wanted):
        found = read(self, wanted)
        sizes.append(len(found))
        return found

    monkeypatch.setattr(rows, "PART", 70)
    monkeypatch.setattr(rows.Rows, "__getitem__", watched)
    fitted(both[1])
    assert max(sizes) <= 297  # the first summaries, which are kept: a thousand at most
    assert sorted(set(sizes))[-2] <= 70


def test_diverged_and_weighted_pairs_on_disk(both, tmp_path):
    pairs = both[0].clone()
    pairs["summary"][7] = torch.nan
    pairs["weight"] = torch.rand(len(pairs), generator=generator("weights"))
    with pytest.warns(UserWarning, match="1 of 330 pairs are not finite: left out"):
        one, _ = fitted(pairs)
    with pytest.warns(UserWarning, match="1 of 330"):
        other, _ = fitted(pairs.memmap(tmp_path))
    assert one == other
    assert (one.pairs, one.dropped) == (329, 1)
    pairs["summary"][:] = torch.nan
    with pytest.raises(SimulationError, match="330 diverged simulations of 330"):
        fitted(pairs.memmap(tmp_path / "none"))


def test_parameters_outside_the_prior_are_found_in_later_parts(both, monkeypatch):
    pairs = both[0].clone()
    pairs["theta"][300] = 5.0
    monkeypatch.setattr(rows, "PART", 70)
    match = r"parameters inside the prior .*got '1 outside it, the first \[5.0, 5.0\]'"
    with pytest.raises(ValueError, match=match):
        fitted(pairs)


def test_many_parameters_are_drawn_in_parts_and_the_first_part_alike(monkeypatch, tmp_path):
    few = simulated()["theta"]
    monkeypatch.setattr(rows, "PART", 100)
    many = simulated(pairs=250)
    assert torch.equal(many["theta"][:100], simulated(pairs=100)["theta"])
    assert len(many["theta"].unique(dim=0)) == 250
    assert (simulated(pairs=250, folder=tmp_path / "pairs") == many).all()
    assert few.shape == (330, 2)


def test_a_folder_is_not_written_over_and_half_of_one_does_not_stay(both, tmp_path):
    folder = tmp_path / "pairs"
    simulated(pairs=4, folder=folder)
    with pytest.raises(FileExistsError, match="a folder that does not exist yet"):
        simulated(pairs=4, folder=folder)
    calls = []

    def failing(state, action, following, mask):
        calls.append(len(state))
        if len(calls) > 3:
            raise ArithmeticError("no")
        return linear_dynamics(state, action, following, mask)

    with pytest.raises(ArithmeticError, match="no"):
        simulated(SummaryStatistics(failing), folder=tmp_path / "half")
    assert len(calls) > 3
    assert list(tmp_path.iterdir()) == [folder]


def test_the_spread_of_parts_is_that_of_the_whole():
    values = 1e4 + torch.randn(1000, 3, generator=generator("values")) * torch.tensor([1.0, 5, 0])
    for size in (1000, 300, 1):
        mean, deviation, largest = spread(values.split(size))
        torch.testing.assert_close(mean, values.double().mean(0).float())
        torch.testing.assert_close(deviation, values.double().std(0).float(), rtol=1e-4, atol=1e-6)
        assert torch.equal(largest, values.abs().amax(0))
