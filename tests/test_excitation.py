import math

import pytest
import torch

from torchrl_bayessim.excitation import excite, expected_information, replayed
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.randomness import generator

NOISE = torch.tensor([0.5])
UNIT = (-torch.ones(1), torch.ones(1))


def linear(theta, actions):
    """y = theta u: to push hard is to learn much."""
    return theta[:, None, None] * actions


def test_a_linear_gaussian_experiment_has_its_known_information():
    """T readings theta u + N(0, n^2) of theta of variance s^2: log(1 + T u^2 s^2 / n^2) / 2."""
    theta = torch.randn(2000, 1, generator=generator(0))
    actions = torch.tensor([0.2, 1.0]).reshape(2, 1, 1).expand(2, 10, 1)
    found = expected_information(linear(theta, actions), NOISE)
    variance = theta.var().item()
    expected = [0.5 * math.log(1 + 10 * u**2 * variance / 0.25) for u in (0.2, 1.0)]
    assert found.tolist() == pytest.approx(expected, rel=1e-6)


def test_two_parameters_seen_apart_tell_the_sum_of_both():
    theta = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    outputs = theta[:, None, None, :]
    both = expected_information(outputs, torch.tensor([0.1, 0.3]))
    one, other = (
        expected_information(outputs[..., d : d + 1], torch.tensor([n]))
        for d, n in [(0, 0.1), (1, 0.3)]
    )
    assert both.item() == pytest.approx((one + other).item())


def test_an_experiment_that_diverges_tells_nothing():
    outputs = torch.randn(4, 3, 5, 1, generator=generator(1))
    outputs[2, 1, 3:] = torch.nan
    found = expected_information(outputs, NOISE)
    assert found[1] == 0
    assert (found[[0, 2]] > 0).all()


def test_the_search_finds_the_hardest_push():
    found = excite(linear, torch.linspace(1, 2, 8)[:, None], noise=NOISE, bounds=UNIT, steps=30)
    assert found.actions.shape == (30, 1)
    assert found.actions.abs().max() <= 1
    assert found.actions.abs().mean() > 0.8
    given = expected_information(
        linear(torch.linspace(1, 2, 8)[:, None], found.actions[None]), NOISE
    )
    assert found.nats == pytest.approx(given.item(), rel=1e-4)


def test_the_same_seed_gives_the_same_experiment():
    options = {"noise": NOISE, "bounds": UNIT, "steps": 5, "rounds": 2}
    theta = torch.linspace(1, 2, 4)[:, None]
    before = torch.random.get_rng_state()
    first, again, other = (excite(linear, theta, seed=seed, **options) for seed in (3, 3, 4))
    assert torch.equal(first.actions, again.actions)
    assert not torch.equal(first.actions, other.actions)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_an_experiment_on_mujoco_beats_idleness_and_noise():
    """A pendulum at rest tells nothing about its mass: one must shake it."""
    start = {"qpos": torch.zeros(2), "qvel": torch.zeros(2)}
    simulate = replayed("InvertedPendulum-v5", start, MujocoPhysics("body_mass[pole]"))
    theta = torch.linspace(3.0, 7.0, 8)[:, None]
    noise = torch.tensor([0.05, 0.05, 0.5, 0.5])
    bounds = (torch.tensor([-3.0]), torch.tensor([3.0]))
    found = excite(simulate, theta, noise=noise, bounds=bounds, steps=20, candidates=32, rounds=3)
    random = 6 * torch.rand(4, 20, 1, generator=generator(2)) - 3
    others = torch.cat([torch.zeros(1, 20, 1), random])
    nats = expected_information(simulate(theta, others), noise)
    assert nats[0] < 0.1
    assert found.nats > nats.max()
    again = expected_information(simulate(theta, found.actions[None]), noise)
    assert found.nats == pytest.approx(again.item(), rel=1e-3)


@pytest.mark.parametrize("name", ["steps", "candidates", "rounds"])
def test_counts_must_be_positive(name):
    options = {"steps": 5, "candidates": 4, "rounds": 1} | {name: 0}
    with pytest.raises(ValueError, match=f"{name} to be positive, got 0"):
        excite(linear, torch.ones(2, 1), noise=NOISE, bounds=UNIT, **options)


def test_odd_arguments_are_refused():
    with pytest.raises(ValueError, match="at least 2 knots, got 1"):
        excite(linear, torch.ones(2, 1), noise=NOISE, bounds=UNIT, steps=5, knots=1)
    with pytest.raises(ValueError, match=r"outputs of shape \(P >= 2, S, T, Y\)"):
        expected_information(torch.zeros(1, 1, 1, 1), NOISE)
    with pytest.raises(ValueError, match="positive deviations of the noise"):
        expected_information(torch.zeros(2, 1, 1, 1), torch.zeros(1))
