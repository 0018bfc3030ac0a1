"""On a GPU everything is as on the CPU, but for rounding."""

import copy

import pytest
import torch
from on_gpu import GPU, NEEDS_GPU
from tensordict import TensorDict

from torchrl_bayessim import BoxPrior, GaussianPrior, MixtureDensityPosterior, fit
from torchrl_bayessim.inference.averaged_posterior import AveragedPosterior
from torchrl_bayessim.inference.calibration import calibrate, calibrate_pooled
from torchrl_bayessim.inference.ensemble import fit_together, pairs_of
from torchrl_bayessim.inference.fit import select_lengthscale
from torchrl_bayessim.inference.identifiability import identifiability
from torchrl_bayessim.inference.losses import PosteriorLoss
from torchrl_bayessim.inference.marginals import marginal_log_prob
from torchrl_bayessim.inference.misspecification import doubts, strangeness
from torchrl_bayessim.inference.mixture_gradients import log_density_and_pullback
from torchrl_bayessim.inference.trust import trust
from torchrl_bayessim.inference.widening import learn_shared, widen
from torchrl_bayessim.randomness import generator
from torchrl_bayessim.sources import draw

pytestmark = NEEDS_GPU
BOX = BoxPrior({"mass": (2.0, 6.0), "damping": (0.01, 1.0)}, log=["damping"])
NORMAL = GaussianPrior(
    {"mass": (4.0, 0.5), "offset": (0.0, 0.1)}, correlation=torch.tensor([[1.0, 0.6], [0.6, 1.0]])
)
PRIORS = pytest.mark.parametrize("prior", [BOX, NORMAL], ids=["box", "normal"])


def summaries(prior, theta, *, seed=1):
    """Return noisy parameters and their product, where the parameters are."""
    z = prior.standardize(theta)
    noise = torch.randn(len(z), 3, generator=generator(seed)).to(z)
    return (torch.cat([z, z.prod(-1, keepdim=True)], -1) + 0.4 * noise).to(torch.float32)


def pairs_under(prior, count=600, device="cpu"):
    theta = draw(prior, count, key=("pairs",))
    return pairs_of(theta, summaries(prior, theta)).to(device)


def fitted_to(pairs, prior, *, device="cpu", **options):
    posterior = MixtureDensityPosterior(prior, 3, **options).to(device)
    return posterior, fit(posterior, pairs, epochs=4, progress=False)


@pytest.fixture(scope="module", params=[BOX, NORMAL], ids=["box", "normal"])
def both(request):
    """The same fitted posterior on the CPU and on the GPU."""
    posterior, _ = fitted_to(pairs_under(request.param), request.param)
    return posterior, copy.deepcopy(posterior).to(GPU)


def close(found, expected, *, rtol=1e-3, atol=1e-3, but=0.0):
    """Assert that what is on the GPU is what is on the CPU, ``but`` for a share of the rows."""
    assert found.device == GPU
    near = torch.isclose(found.cpu().double(), expected.double(), rtol=rtol, atol=atol)
    assert near.flatten(1).all(-1).double().mean() >= 1 - but if near.ndim > 1 else near.all()


# fits


@PRIORS
def test_a_fit_takes_pairs_to_the_posterior(prior):
    pairs = pairs_under(prior)
    cpu, expected = fitted_to(pairs, prior)
    gpu, report = fitted_to(pairs, prior, device=GPU)
    there, same = fitted_to(pairs.to(GPU), prior, device=GPU)
    assert report.validation == pytest.approx(expected.validation, rel=0.02, abs=0.02)
    assert report.validation == same.validation
    assert gpu.seen.device == there.seen.device == gpu.held_out["theta"].device == GPU
    back, again = fitted_to(pairs.to(GPU), prior)
    assert again.validation == expected.validation
    assert back.seen.device.type == "cpu"
    assert torch.equal(back.network.head.weight, cpu.network.head.weight)


def test_pairs_on_disk_are_taken_there_in_parts(tmp_path):
    pairs = pairs_under(BOX)
    _, expected = fitted_to(pairs, BOX, device=GPU)
    gpu, report = fitted_to(pairs.memmap(tmp_path / "pairs"), BOX, device=GPU)
    assert report.validation == pytest.approx(expected.validation, rel=1e-3, abs=1e-3)
    assert gpu.held_out["theta"].device == GPU


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_fits_with_weights_of_either_covariance(covariance):
    pairs = pairs_under(BOX).set("weight", torch.rand(600, generator=generator("weight")))
    _, expected = fitted_to(pairs, BOX, covariance=covariance)
    _, report = fitted_to(pairs, BOX, covariance=covariance, device=GPU)
    assert report.validation == pytest.approx(expected.validation, rel=0.02, abs=0.02)


def test_more_pairs_than_are_held_in_a_part():
    theta = draw(BOX, 70_000, key=("many",))
    pairs = pairs_of(theta, summaries(BOX, theta))
    options = {"epochs": 1, "batch_size": 4096, "progress": False}
    cpu = MixtureDensityPosterior(BOX, 3)
    gpu = copy.deepcopy(cpu).to(GPU)
    expected, report = fit(cpu, pairs, **options), fit(gpu, pairs, **options)
    close(gpu.network.scale, cpu.network.scale)
    assert report.best == pytest.approx(expected.best, rel=0.01, abs=0.01)


def test_fourier_features():
    pairs = pairs_under(BOX)
    cpu = MixtureDensityPosterior.paper_mode(BOX, 3)
    gpu = copy.deepcopy(cpu).to(GPU)
    options = {"factors": (1.0,), "epochs": 1, "progress": False}
    expected = select_lengthscale(cpu, pairs, **options)
    assert select_lengthscale(gpu, pairs, **options) == pytest.approx(expected, rel=1e-4)
    expected, report = (fit(p, pairs, epochs=2, progress=False) for p in (cpu, gpu))
    assert report.validation == pytest.approx(expected.validation, rel=0.02, abs=0.02)


@PRIORS
def test_networks_fitted_together(prior):
    pairs = pairs_under(prior)
    averages = []
    for device in ("cpu", GPU):
        networks = [MixtureDensityPosterior(prior, 3, seed=seed).to(device) for seed in (0, 1)]
        fit_together(networks, pairs, seeds=(0, 1), epochs=4, progress=False)
        averages.append(AveragedPosterior(networks))
    cpu, gpu = averages
    assert gpu.held_out["theta"].device == GPU
    for rows in (1, 5):
        real = pairs["summary"][:rows]
        close(gpu.condition(real).mean, cpu.condition(real).mean, rtol=0.1, atol=0.1)
    assert trust(gpu, pairs["summary"][:2]).posterior.mean.device == GPU


def test_networks_on_several_devices_are_refused():
    networks = [MixtureDensityPosterior(BOX, 3), MixtureDensityPosterior(BOX, 3, seed=1).to(GPU)]
    with pytest.raises(ValueError, match=r"networks on one device.*got 'cpu and cuda:0'"):
        AveragedPosterior(networks)
    with pytest.raises(ValueError, match=r"networks on one device.*Try: network.to\('cpu'\)"):
        fit_together(networks, pairs_under(BOX), seeds=(0, 1))


def test_gradients(both):
    cpu, gpu = both
    pairs = pairs_under(cpu.prior)
    z = cpu.prior.standardize(pairs["theta"].double())
    found = []
    for posterior, device in ((cpu, "cpu"), (gpu, GPU)):
        network = posterior.network
        raw = network.raw(network.scaled(pairs["summary"].to(device)))
        log_q, pull = log_density_and_pullback(network, raw, z.to(device), box=cpu.prior.box)
        loss = PosteriorLoss(copy.deepcopy(posterior))(pairs.to(device))["loss_posterior"]
        loss.backward()
        found.append((log_q, pull(torch.ones_like(log_q)), loss.detach()))
    for expected, value in zip(*found, strict=True):
        close(value, expected)


def test_what_held_out_pairs_say(both):
    cpu, gpu = map(copy.deepcopy, both)
    close(widen([gpu], gpu.held_out.to(GPU)), widen([cpu], cpu.held_out), rtol=0.01, atol=0.01)
    gpu = copy.deepcopy(cpu).to(GPU)
    near = pairs_under(cpu.prior)
    for posterior in (cpu, gpu):
        learn_shared(posterior, near)
    close(gpu.network.shared, cpu.network.shared, atol=0.01)
    close(gpu.network.shared_at_edges, cpu.network.shared_at_edges, atol=0.01)


# answers


def test_densities_and_moments(both):
    cpu, gpu = both
    pairs = pairs_under(cpu.prior, 50)
    theta, summary = pairs["theta"], pairs["summary"]
    expected = cpu.distribution(summary)
    for found in (gpu.distribution(summary), gpu.distribution(summary.to(GPU))):
        close(found.log_prob(theta.to(GPU)), expected.log_prob(theta))
        close(found.mean, expected.mean)
        close(found.stddev, expected.stddev)
        assert found.log_prob(theta).device.type == "cpu"
        assert torch.allclose(found.log_prob(theta), expected.log_prob(theta), 1e-3, 1e-3)
    real = summary[:1]
    expected, found = cpu.condition(real), gpu.condition(real)
    close(marginal_log_prob(found, theta.to(GPU)), marginal_log_prob(expected, theta), atol=0.01)
    assert expected.log_prob(theta.to(GPU)).device == GPU
    td = gpu(TensorDict({"summary": summary.to(GPU)}, [50]))
    assert td["theta"].device == td["theta_log_prob"].device == GPU


def test_draws(both):
    cpu, gpu = both
    real = pairs_under(cpu.prior, 2)["summary"]
    expected, found = cpu.condition(real), gpu.condition(real)
    draws = expected.sample((4000,), generator=generator("draws"))
    # rounding may take another component, or accept another proposal
    close(found.sample((4000,), generator=generator("draws")), draws, but=0.02)
    one, two = (
        found.sample((4000,), generator=torch.Generator(GPU).manual_seed(0)) for _ in range(2)
    )
    assert torch.equal(one, two)
    close(one.mean(0), draws.mean(0), atol=0.1 * draws.std(0).max().item())
    close(one.std(0), draws.std(0), rtol=0.1)
    other = expected.sample((4000,), generator=torch.Generator(GPU).manual_seed(0))
    assert other.device.type == "cpu"
    assert torch.allclose(other.mean(0), draws.mean(0), 0.1, 0.1)
    assert found.sample((3,)).device == GPU
    assert torch.allclose(*(draw(q, 64, key=(0,)) for q in (expected, found)), 1e-3, 1e-3)


@pytest.mark.parametrize("pooling", ["product", "mean"])
def test_several_trajectories(both, pooling):
    cpu, gpu = both
    theta = draw(cpu.prior, 1, key=("true",)).expand(6, -1)
    real = summaries(cpu.prior, theta)
    expected, found = (q.condition(real, pooling=pooling) for q in (cpu, gpu))
    close(found.mean, expected.mean)
    close(found.stddev, expected.stddev, atol=1e-4)
    close(found.log_prob(theta.to(GPU)), expected.log_prob(theta), atol=0.01)


def test_what_the_data_say(both):
    real = pairs_under(both[0].prior, 3)["summary"]
    expected, found = (identifiability(q.condition(real)) for q in both)
    close(found.nats, expected.nats, atol=0.02)
    close(found.narrowing, expected.narrowing, atol=0.01)
    close(found.correlation, expected.correlation, atol=0.05)
    assert len(found.sentences()) >= 2
    assert len(found.pairs) == len(expected.pairs)


def test_calibration(both):
    cpu, gpu = both
    pairs = pairs_under(cpu.prior, 100)
    expected, found = calibrate(cpu, pairs), calibrate(gpu, pairs)
    there = calibrate(gpu, pairs.to(GPU))
    for one in (found, there):
        close(one.rank, expected.rank, atol=0.05, but=0.05)
        assert one.p_values() == pytest.approx(expected.p_values(), abs=0.1)
        assert one.coverage(0.5) == pytest.approx(expected.coverage(0.5), abs=0.05)
    theta = pairs["theta"][:20]
    groups = torch.stack([summaries(cpu.prior, theta, seed=seed) for seed in range(3)], 1)
    expected, found = (calibrate_pooled(q, theta, groups) for q in both)
    close(found.rank, expected.rank, atol=0.05, but=0.05)
    assert calibrate_pooled(gpu, theta.to(GPU), groups.to(GPU)).passed == found.passed


def test_the_whole_report(both):
    cpu, gpu = both
    theta = draw(cpu.prior, 1, key=("true",)).expand(3, -1)
    real = summaries(cpu.prior, theta)

    def on_the_gpu(theta):
        return summaries(cpu.prior, theta.to(GPU), seed=2)

    expected = trust(cpu, real, simulate=lambda theta: on_the_gpu(theta).cpu(), truths=50)
    for rows in (real, real.to(GPU)):
        found = trust(gpu, rows, simulate=on_the_gpu, truths=50)
        assert found.predictive == pytest.approx(expected.predictive, abs=0.1)
        assert found.pooled.coverage(0.5) == pytest.approx(expected.pooled.coverage(0.5), abs=0.1)
        assert found.unchecked == expected.unchecked
        assert len(str(found).splitlines()) >= 3


@pytest.mark.filterwarnings("ignore:.* lie at the")
def test_doubts(both):
    cpu, gpu = both
    seen, real = pairs_under(cpu.prior)["summary"], torch.full((2, 3), 30.0)
    assert strangeness(seen.to(GPU), real[0])[0] == strangeness(seen, real[0])[0]
    found = doubts(seen.to(GPU), real, gpu.condition(real, check=False))
    assert "2 of 2 real summaries" in found[0]
    assert [text[:60] for text in found] == [
        text[:60] for text in doubts(seen, real, cpu.condition(real, check=False))
    ]
    with pytest.warns(UserWarning, match="2 of 2 real summaries"):
        gpu.condition(real)
