import math

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import StepCounter, TransformedEnv

from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.excitation import Experiment, between_knots, excite, replayed
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.information import expected_information, information_bound
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
    variance = theta.var().item()
    expected = [0.5 * math.log(1 + 10 * u**2 * variance / 0.25) for u in (0.2, 1.0)]
    found = expected_information(linear, theta, actions, noise=NOISE)
    assert found.tolist() == pytest.approx(expected, rel=1e-3)
    bound = information_bound(linear(theta, actions), NOISE)
    assert bound.tolist() == pytest.approx(expected, rel=1e-6)


def test_correlated_parameters_have_their_known_information():
    """y = theta + noise, theta of covariance C: log det(1 + C / n^2) / 2."""
    prior = GaussianPrior(
        {"a": (1.0, 0.5), "b": (-3.0, 2.0)}, correlation=torch.tensor([[1.0, 0.8], [0.8, 1.0]])
    )
    theta = prior.sample((500,), generator=generator(7))
    noise = torch.tensor([0.1, 0.3])
    found = expected_information(
        lambda theta, actions: theta[:, None, None] + actions, theta, torch.zeros(1, 1, 2),
        noise=noise,
    )  # fmt: skip
    covariance = theta.double().mT.cov() / (noise[:, None] * noise)
    expected = 0.5 * torch.linalg.slogdet(torch.eye(2) + covariance).logabsdet
    assert found.item() == pytest.approx(expected.item(), rel=1e-3)


def test_of_a_bent_output_the_information_is_the_divergence_and_the_bound_is_more():
    """y_t = sin(theta t) + noise, theta uniform: the mean divergence, by quadrature."""
    times = torch.arange(1, 41).reshape(1, 1, 40, 1) / 4
    bent = lambda theta, actions: (theta[:, None, None] * times).sin() + 0 * actions
    prior = BoxPrior({"rate": (0.5, 2.5)})
    theta = prior.sample((64,), generator=generator(3))
    actions = torch.zeros(1, 40, 1)
    told = expected_information(bent, theta, actions, noise=NOISE).item()

    grid = torch.linspace(0.5, 2.5, 4001)[:, None]
    y, known = bent(grid, actions).flatten(1), bent(theta, actions).flatten(1)
    measured = known + NOISE * torch.randn(known.shape, generator=generator(4))
    log_likelihood = -0.5 * (torch.cdist(measured, y) / NOISE).square()
    posterior = log_likelihood.log_softmax(1)
    gained = (posterior.exp() * (posterior + math.log(4001))).sum(1).mean().item()
    assert told == pytest.approx(gained, rel=0.15)
    assert told > gained  # by the entropy that a Gaussian has more than a box
    assert information_bound(bent(theta, actions), NOISE) > 2 * gained


def test_what_does_not_vary_or_does_not_show_is_no_information():
    theta = torch.tensor([[1.0, 5.0], [2.0, 5.0], [3.0, 5.0]])
    actions = torch.ones(1, 1, 1)
    first = lambda theta, actions: theta[:, None, None, :1] * actions
    second = lambda theta, actions: theta[:, None, None, 1:] * actions
    found = expected_information(first, theta, actions, noise=NOISE)
    assert found.item() == pytest.approx(0.5 * math.log(1 + 1 / 0.25), rel=1e-3)
    assert expected_information(second, theta, actions, noise=NOISE).item() == 0


def test_differences_stay_where_the_draws_are():
    prior, asked = BoxPrior({"a": (0.0, 1.0), "b": (-2.0, -1.0)}), []

    def simulate(theta, actions):
        asked.append(theta)
        return theta[:, None, None] + actions

    theta = torch.tensor([[0.0, -2.0], [1.0, -1.0], [0.0, -1.0]])
    expected_information(simulate, theta, torch.zeros(1, 1, 2), noise=torch.ones(2))
    assert prior.contains(torch.cat(asked)).all()


def test_two_parameters_seen_apart_tell_the_sum_of_both():
    theta = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    outputs = theta[:, None, None, :]
    both = information_bound(outputs, torch.tensor([0.1, 0.3]))
    one, other = (
        information_bound(outputs[..., d : d + 1], torch.tensor([n]))
        for d, n in [(0, 0.1), (1, 0.3)]
    )
    assert both.item() == pytest.approx((one + other).item())


def test_an_experiment_that_diverges_tells_nothing():
    outputs = torch.randn(4, 3, 5, 1, generator=generator(1))
    outputs[2, 1, 3:] = torch.nan
    diverging = lambda theta, actions: (
        outputs.repeat(len(theta) // 4, 1, 1, 1) * theta[:, None, None]
    )
    theta = torch.linspace(1, 2, 4)[:, None]
    bound = information_bound(outputs, NOISE)
    nats = expected_information(diverging, theta, torch.zeros(3, 5, 1), noise=NOISE)
    for found in (bound, nats):
        assert found[1] == 0
        assert (found[[0, 2]] > 0).all()


def test_the_search_finds_the_hardest_push():
    found = excite(linear, torch.linspace(1, 2, 8)[:, None], noise=NOISE, bounds=UNIT, steps=30)
    assert found.actions.shape == (30, 1)
    assert found.actions.abs().max() <= 1
    assert found.actions.abs().mean() > 0.8
    variance = torch.linspace(1, 2, 8).var()
    given = 0.5 * (1 + variance * found.actions.square().sum() / 0.25).log()
    assert found.nats == pytest.approx(given.item(), rel=1e-3)


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
    nats = expected_information(simulate, theta, others, noise=noise)
    assert nats[0] < 0.1
    assert found.nats > nats.max()
    again = expected_information(simulate, theta, found.actions[None], noise=noise)
    assert found.nats == pytest.approx(again.item(), rel=1e-3)


def test_a_search_of_two_candidates_learns_something():
    theta = torch.linspace(1, 2, 8)[:, None]
    found = excite(linear, theta, noise=NOISE, bounds=UNIT, steps=5, candidates=2, rounds=1)
    assert found.nats > 0
    assert found.actions.isfinite().all()


def counted(envs):
    return TransformedEnv(BatchedMujocoEnv("InvertedPendulum-v5", envs, threads=1), StepCounter(4))


def test_a_policy_plays_the_experiment_from_every_reset_on():
    env = counted(3)
    experiment = Experiment(torch.tensor([[0.3], [-1.0], [2.0], [-3.0]]), nats=0.0)
    policy = experiment.policy(env)
    twice = [env.rollout(4, policy)["action"] for _ in range(2)]  # each begins with a reset
    for played in twice:
        assert torch.equal(played, experiment.actions.expand(3, 4, 1))
    past = env.rollout(9, policy, break_when_any_done=False)["action"]  # resets every four steps
    rows = torch.tensor([0, 1, 2, 3, 0, 1, 2, 3, 0])
    assert torch.equal(past, experiment.actions[rows].expand(3, 9, 1))
    env.close()


def test_a_collector_plays_the_experiment():
    env = counted(2)
    experiment = Experiment(torch.tensor([[0.3], [-1.0], [2.0], [-3.0]]), nats=0.0)
    options = {"total_frames": 24, "auto_register_policy_transforms": False}
    collector = Collector(env, experiment.policy(env), frames_per_batch=12, **options)
    rows = torch.arange(12) % 4
    played = torch.cat([batch["action"] for batch in collector], 1)
    assert torch.equal(played, experiment.actions[rows].expand(2, 12, 1))
    collector.shutdown()


def test_a_policy_needs_an_environment_with_such_actions_that_counts_its_steps():
    env, experiment = PendulumEnv(2), Experiment(torch.zeros(3, 1), nats=0.0)
    with pytest.raises(ValueError, match=r"counts the episode's steps, got 'step_count'.*StepC"):
        experiment.policy(env)
    with pytest.raises(ValueError, match=r"environment with actions of shape \(2,\), got \(1,\)"):
        Experiment(torch.zeros(3, 2), nats=0.0).policy(TransformedEnv(env, StepCounter()))
    with pytest.raises(TypeError, match="an environment, got 'str'"):
        experiment.policy("Pendulum-v1")


def test_actions_between_knots_are_linear_and_within_bounds():
    points = torch.tensor([[-1.0, 1.0], [0.0, -1.0]])[None]
    found = between_knots(points, torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0]), 3)
    assert found.tolist() == [[[-1.0, 4.0], [-0.5, 2.0], [0.0, 0.0]]]


@pytest.mark.parametrize("name", ["steps", "rounds"])
def test_counts_must_be_positive(name):
    options = {"steps": 5, "candidates": 4, "rounds": 1} | {name: 0}
    with pytest.raises(ValueError, match=f"{name} to be positive, got 0"):
        excite(linear, torch.ones(2, 1), noise=NOISE, bounds=UNIT, **options)


def test_odd_arguments_are_refused():
    with pytest.raises(ValueError, match="at least 2 knots, got 1"):
        excite(linear, torch.ones(2, 1), noise=NOISE, bounds=UNIT, steps=5, knots=1)
    with pytest.raises(ValueError, match="at least 2 candidates, got 1"):
        excite(linear, torch.ones(2, 1), noise=NOISE, bounds=UNIT, steps=5, candidates=1)
    for bounds in [
        (-torch.ones(1), torch.full((1,), torch.inf)),
        (-torch.inf * torch.ones(1), UNIT[1]),
    ]:
        with pytest.raises(ValueError, match=r"of shape \(A,\), finite, got .*inf.*may use"):
            excite(linear, torch.ones(2, 1), noise=NOISE, bounds=bounds, steps=5)
    with pytest.raises(ValueError, match=r"outputs of shape \(P >= 2, S, T, Y\)"):
        information_bound(torch.zeros(1, 1, 1, 1), NOISE)
    with pytest.raises(ValueError, match="positive deviations of the noise"):
        information_bound(torch.zeros(2, 1, 1, 1), torch.zeros(1))
    with pytest.raises(ValueError, match="finite draws of parameters"):
        expected_information(linear, torch.ones(1, 1), torch.zeros(1, 1, 1), noise=NOISE)
    with pytest.raises(TypeError, match="simulate, a function"):
        expected_information(3, torch.ones(2, 1), torch.zeros(1, 1, 1), noise=NOISE)
