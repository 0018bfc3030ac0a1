"""Several real trajectories of unequal lengths: the posterior of all their steps together."""

import torch
from tensordict import TensorDict

from torchrl_bayessim.inference.averaged_posterior import AveragedPosterior
from torchrl_bayessim.inference.ensemble import fit_together
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.randomness import generator
from torchrl_bayessim.summaries import SummaryStatistics

PRIOR = BoxPrior({"drift": (-1.0, 1.0)})
LENGTHS = (5, 15, 40)
NOISE = 1.5


def drift(state, action, next_state, mask):
    """The mean difference of states, over the steps that count."""
    weight = mask.float().unsqueeze(-1)
    return ((next_state - state) * weight).sum(-2) / weight.sum(-2)


def simulated(theta, *, key):
    """Trajectories ``[N, 3, 40]`` of a random walk with a drift, as long as the real ones."""
    most = max(LENGTHS)
    noise = NOISE * torch.randn(len(theta), 3, most, 1, generator=generator("walk", key))
    change = theta[:, None, None] + noise
    state = change.cumsum(-2) - change
    mask = torch.arange(most) < torch.tensor(LENGTHS)[:, None]
    data = {
        "observation": state,
        "action": torch.zeros(len(theta), 3, most, 1),
        "next": {"observation": state + change},
        "mask": mask.expand(len(theta), 3, most),
    }
    return TensorDict(data, [len(theta), 3, most])


def test_the_posterior_of_unequal_trajectories_is_that_of_all_their_steps():
    theta = PRIOR.sample((3000,), generator=generator("theta"))
    together = SummaryStatistics(drift).together
    pairs = TensorDict({"theta": theta, "summary": together(simulated(theta, key=0))}, [3000])
    networks = [MixtureDensityPosterior(PRIOR, 1, seed=seed) for seed in range(3)]
    fit_together(networks, pairs, seeds=range(3), progress=False)
    truth = torch.linspace(-0.5, 0.5, 50)[:, None]
    observed = together(simulated(truth, key=1))
    posterior = AveragedPosterior(networks).distribution(observed)
    exact = torch.distributions.Normal(observed, NOISE / sum(LENGTHS) ** 0.5)
    drawn = exact.sample((400,)).clamp(-0.999, 0.999)
    nats = exact.log_prob(drawn)[..., 0] - posterior.log_prob(drawn)
    assert nats.mean() < 0.02
