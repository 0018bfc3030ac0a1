"""Sources, proposals, rounds and what is kept of them are on a GPU as on the CPU."""

import copy
import io

import pytest
import torch
from on_gpu import GPU, NEEDS_GPU
from torch.distributions import Independent, Uniform

from torchrl_bayessim import (
    BoxPrior,
    GaussianPrior,
    MixtureDensityPosterior,
    PosteriorRefinement,
    fit,
    sequential,
)
from torchrl_bayessim.checkpoint import load, save
from torchrl_bayessim.inference.ensemble import pairs_of
from torchrl_bayessim.inference.proposals import (
    HighestDensityPrior,
    analytic_correction,
    focus,
    gaussian_proposal,
    importance_weights,
)
from torchrl_bayessim.randomness import generator, isolated
from torchrl_bayessim.sources import Defensive, Empirical, draw

pytestmark = NEEDS_GPU
BOX = BoxPrior({"length": (0.1, 2.0), "masspole": (0.1, 2.0)})
NORMAL = GaussianPrior({"length": (1.0, 0.2), "masspole": (1.0, 0.2)})
PRIORS = pytest.mark.parametrize("prior", [BOX, NORMAL], ids=["box", "normal"])
FIT = {"epochs": 4, "progress": False}


def simulator(theta):
    """Return noisy parameters, on the GPU."""
    noise = torch.randn(theta.shape, generator=generator("noise")).to(GPU)
    return theta.to(GPU) + 0.2 * noise


def on_the_gpu(prior, size):
    return MixtureDensityPosterior(prior, size).to(GPU)


def posteriors(prior):
    theta = draw(prior, 600, key=("pairs",))
    cpu = MixtureDensityPosterior(prior, 2)
    fit(cpu, pairs_of(theta, simulator(theta)), **FIT)
    gpu = copy.deepcopy(cpu).to(GPU)
    return [posterior.condition(torch.tensor([[0.8, 0.9]])) for posterior in (cpu, gpu)]


# draws and proposals


def test_what_is_isolated_draws_the_same_and_leaves_the_generator():
    before = torch.cuda.get_rng_state()
    drawn = []
    for _ in range(2):
        with isolated("key"):
            drawn.append(torch.rand(3, device=GPU))
    assert torch.equal(*drawn)
    assert torch.equal(torch.cuda.get_rng_state(), before)
    there = Independent(Uniform(torch.zeros(2, device=GPU), torch.ones(2, device=GPU)), 1)
    assert torch.equal(draw(there, 3, key=(0,)), draw(there, 3, key=(0,)))


@PRIORS
def test_priors(prior):
    theta = prior.sample((100,), generator=torch.Generator(GPU).manual_seed(0))
    again = prior.sample((100,), generator=torch.Generator(GPU).manual_seed(0))
    assert theta.device.type == "cpu"
    assert torch.equal(theta, again)
    assert torch.allclose(prior.log_prob(theta.to(GPU)).cpu(), prior.log_prob(theta))
    z = prior.standardize(theta.to(GPU))
    assert z.device == GPU
    assert torch.allclose(prior.unstandardize(z).cpu(), theta, atol=1e-5)
    assert prior.contains(theta.to(GPU)).all()


def test_sources_with_a_generator_of_the_gpu():
    table = Empirical(torch.rand(10, 2, device=GPU))
    g = torch.Generator(GPU)
    for source in (table, Defensive(table, BOX, 0.5)):
        one, two = (source.sample(torch.Size((50,)), generator=g.manual_seed(0)) for _ in range(2))
        assert one.shape == (50, 2)
        assert torch.equal(one, two)


@PRIORS
def test_proposals(prior):
    expected, found = posteriors(prior)
    theta = draw(found, 200, key=(0,))
    proposals = [[(Defensive(q, prior, 0.2), 100), (prior, 50)] for q in (expected, found)]
    weights = [importance_weights(theta, prior, rounds) for rounds in proposals]
    assert torch.allclose(*weights, rtol=1e-3, atol=1e-3)
    there = importance_weights(theta.to(GPU), prior, proposals[1])
    assert torch.allclose(there.cpu(), weights[0], rtol=1e-3, atol=1e-3)
    regions = [HighestDensityPrior(prior, q, mass=0.9) for q in (expected, found)]
    assert regions[1].threshold == pytest.approx(regions[0].threshold, abs=0.05)
    assert draw(regions[1], 50, key=(0,)).shape == (50, 2)
    regions[1].tries = 0
    with pytest.warns(UserWarning, match="too small"):
        assert regions[1].sample((50,), generator=generator(0)).shape == (50, 2)
    corrected = [
        analytic_correction(q, gaussian_proposal(q, inflate=4.0)).posterior
        for q in (expected, found)
    ]
    assert torch.allclose(corrected[1].mean.cpu(), corrected[0].mean, rtol=0.01, atol=0.01)
    if prior is BOX:
        boxes = [focus(prior, q) for q in (expected, found)]
        assert torch.allclose(boxes[0].low, boxes[1].low, atol=0.01)
        assert prior.within(boxes[0].low.to(GPU), boxes[0].high.to(GPU)).names == prior.names


# rounds, and what is kept of them


@pytest.mark.filterwarnings("ignore:the answer for", "ignore:.* lie at the")
@PRIORS
def test_refinements_with_simulator_and_networks_on_the_gpu(prior, tmp_path):
    found = []
    for make in (None, on_the_gpu):
        own = PosteriorRefinement(
            prior, simulations=400, networks=2, make_posterior=make, predictive=99, truths=50,
            fit_options=FIT,
        )  # fmt: skip
        for turn in range(2):
            own.refine(simulator, torch.tensor([[0.8, 0.9]] * 2, device=GPU), key=(turn,))
        found.append(own)
    cpu, gpu = found
    assert cpu.posterior.mean.device.type == "cpu"
    assert gpu.posterior.mean.device == GPU
    assert torch.allclose(gpu.posterior.mean.cpu(), cpu.posterior.mean, atol=0.15)
    assert gpu.trust.pooled is not None
    theta = draw(cpu.proposal(), 400, key=(2,)).to(GPU)
    cpu.learn(theta, simulator(theta), torch.tensor([0.8, 0.9]), key=(2,))
    assert torch.allclose(gpu.posterior.mean.cpu(), cpu.posterior.mean, atol=0.2)
    save(tmp_path / "round.pt", gpu.state_dict())
    cpu.load_state_dict(load(tmp_path / "round.pt"))
    assert torch.allclose(cpu.posterior.mean, gpu.posterior.mean.cpu(), atol=1e-4)
    gpu.load_state_dict(gpu.state_dict())
    assert gpu.posterior.mean.device == GPU


@pytest.mark.filterwarnings("ignore:.* components with a quotient", "ignore:.* lie at the")
@pytest.mark.parametrize("correction", ["focused", "importance", "truncated", "analytic"])
def test_sequential_rounds_with_a_simulator_on_the_gpu(correction):
    real = torch.tensor([0.8, 0.9], device=GPU)
    options = {"rounds": 2, "simulations": 300, "correction": correction, **FIT}
    *_, last = sequential(simulator, BOX, real, networks=1, **options)
    assert ((last.posterior.mean - real.cpu()).abs() < 0.3).all()
    if correction != "focused":
        make = lambda size: on_the_gpu(BOX, size)
        *_, last = sequential(simulator, BOX, real, networks=1, make_posterior=make, **options)
        assert ((last.posterior.mean - real).abs() < 0.3).all()


def test_weights_go_from_one_to_the_other():
    real = torch.tensor([[0.8, 0.9]] * 2)
    theta = draw(BOX, 600, key=("pairs",))
    pairs = pairs_of(theta, simulator(theta)).to(GPU)
    gpu = on_the_gpu(BOX, 2)
    fit(gpu, pairs, **FIT)
    for value in (gpu.state_dict(), gpu):
        file = io.BytesIO()
        torch.save(value, file)
        file.seek(0)
        held = torch.load(file, map_location="cpu", weights_only=False)
        cpu = held if value is gpu else MixtureDensityPosterior(BOX, 2)
        if value is not gpu:
            cpu.load_state_dict(held)
        assert torch.allclose(cpu.condition(real).mean, gpu.condition(real).mean.cpu(), atol=1e-3)
        assert cpu.seen.device.type == "cpu"
        fit(cpu, pairs.cpu(), **FIT)
        there = on_the_gpu(BOX, 2)
        there.load_state_dict(cpu.state_dict())
        assert torch.allclose(there.condition(real).mean.cpu(), cpu.condition(real).mean, atol=1e-3)
