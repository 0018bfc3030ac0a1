"""Environments, transforms, agents and the loop are on a GPU as on the CPU."""

import pytest
import torch
from on_gpu import GPU, NEEDS_GPU
from torchrl.envs import Compose, StepCounter, TransformedEnv

from torchrl_bayessim import (
    ApplyPhysics,
    AttributePhysics,
    BoxPrior,
    DomainRandomizer,
    MixtureDensityPosterior,
    PosteriorRefinement,
    RecordedLogs,
    SimToRealLoop,
    SummaryStatistics,
    SurrogateRobot,
    fit,
    simulate,
)
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.classic_control.acrobot import AcrobotEnv
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.classic_control.mountain_car import MountainCarEnv
from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv
from torchrl_bayessim.evaluation import evaluate
from torchrl_bayessim.inference.ensemble import pairs_of
from torchrl_bayessim.sources import draw
from torchrl_bayessim.summaries import (
    autocorrelation,
    cross_correlation,
    duration,
    linear_dynamics,
    waypoints,
)
from torchrl_bayessim.trajectories import pad

pytestmark = NEEDS_GPU
BOX = BoxPrior({"length": (0.1, 2.0), "masspole": (0.1, 2.0)})
FIT = {"epochs": 4, "progress": False}


def on_the_gpu(prior, size):
    return MixtureDensityPosterior(prior, size).to(GPU)


def cartpoles(count, device, *transforms):
    env = CartPoleEnv(count, device=device, max_steps=40)
    return TransformedEnv(env, Compose(ApplyPhysics(AttributePhysics(*BOX.names)), *transforms))


@pytest.mark.parametrize("device", ["cpu", GPU], ids=str)
def test_environments_draw_from_a_posterior_on_the_gpu(device):
    theta = draw(BOX, 600, key=("pairs",))
    network = MixtureDensityPosterior(BOX, 2)
    fit(network, pairs_of(theta, theta), **FIT)
    real = torch.tensor([0.8, 0.9])
    expected = network.condition(real)
    found = network.to(GPU).condition(real)
    randomizer = DomainRandomizer(expected)
    env = cartpoles(8, device, randomizer)
    first = env.rollout(3, break_when_any_done=False)["theta"]
    assert first.device.type == torch.device(device).type
    randomizer.set_extra_state({"seed": 0, "episodes": torch.zeros(8, dtype=torch.int64)})
    randomizer.source = found
    again = env.rollout(3, break_when_any_done=False)["theta"]
    assert torch.allclose(first, again, rtol=1e-4, atol=1e-4)
    randomizer.pin(torch.tensor([0.7, 0.8], device=GPU))
    assert torch.allclose(env.reset()["theta"].cpu(), torch.tensor([0.7, 0.8]))


@pytest.mark.parametrize("system", [AcrobotEnv, CartPoleEnv, MountainCarEnv, PendulumEnv])
def test_environments_step_alike(system):
    cpu, gpu = (system(16, seed=3, device=device) for device in ("cpu", GPU))
    steps = cpu.rollout(20, break_when_any_done=False)
    state = gpu.reset()
    assert torch.allclose(state["observation"].cpu(), steps["observation"][:, 0], atol=1e-6)
    for step in range(20):
        state = gpu.step_and_maybe_reset(state.set("action", steps["action"][:, step].to(GPU)))[1]
        following = steps["next", "observation"][:, step]
        good = ~steps["next", "done"][:, step, 0]
        assert torch.allclose(state["observation"].cpu()[good], following[good], 1e-3, 1e-3)


def test_summaries_of_trajectories():
    steps = cartpoles(8, "cpu").rollout(40, break_when_any_done=False)
    functions = cross_correlation, linear_dynamics, duration, autocorrelation(1, 4), waypoints(3)
    statistics = SummaryStatistics(*functions, angles=(2,))
    expected, found = statistics(steps)["summary"], statistics(steps.to(GPU))["summary"]
    assert torch.allclose(found.cpu(), expected, rtol=1e-2, atol=1e-3)
    rows = [row[: 20 + i].clone() for i, row in enumerate(steps.to(GPU))]
    for given in (rows, [row.clear_device_() for row in rows]):
        together = statistics.together(pad(given)[None])
        assert together.device == GPU


def test_pairs_from_environments_on_the_gpu():
    found = []
    for device in ("cpu", GPU, GPU):
        randomizer = DomainRandomizer(BOX)
        env = cartpoles(32, device, randomizer)
        found.append(
            simulate(env, None, SummaryStatistics(linear_dynamics), randomizer, pairs=48,
                     max_steps=20, progress=False)
        )  # fmt: skip
    assert torch.equal(found[0]["theta"], found[1]["theta"])
    assert found[1]["summary"].device.type == "cpu"
    assert torch.equal(found[1]["summary"], found[2]["summary"])


@pytest.mark.parametrize("system", [CartPoleEnv, PendulumEnv])
def test_ppo_learns_where_its_environment_is(system):
    policies = []
    env = system(8, device="cpu", max_steps=50)
    with torch.no_grad():
        batch = env.rollout(32, PPO(env).policy, break_when_any_done=False)
    for device in ("cpu", GPU):
        there = system(8, device=device, max_steps=50)
        agent = PPO(there, epochs=2, minibatch_size=64)
        assert next(agent.policy.parameters()).device == torch.device(device)
        report = agent.update(batch.to(device), key=(0,))
        agent.load_state_dict(agent.state_dict())
        policies.append(report)
        assert evaluate(there, agent.policy, max_steps=5).device.type == torch.device(device).type
    # the entropy of a squashed Gaussian is that of draws, which are others on a GPU
    assert policies[1] == pytest.approx(policies[0], rel=0.1, abs=0.05)


def loop_on(device, file, *, logs=False):
    randomizer = DomainRandomizer(BOX)
    env = cartpoles(64, device, StepCounter(), randomizer)
    robot = SurrogateRobot(cartpoles(2, device), torch.tensor([0.8, 0.5]), max_steps=16)
    if logs:
        robot = RecordedLogs(robot.rollouts(None, episodes=2, key=(0,)).cpu())
    make = None if device == "cpu" else on_the_gpu
    return SimToRealLoop(
        env, PPO(env, epochs=1, minibatch_size=256), robot,
        refinement=PosteriorRefinement(
            BOX, simulations=128, networks=2, make_posterior=make, fit_options=FIT
        ),
        statistics=SummaryStatistics(linear_dynamics), randomizer=randomizer, horizon=16,
        episodes=2, updates=1, rounds=2, checkpoint_file=file, progress=False,
    )  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*real summaries", "ignore:.*lie at the")
@pytest.mark.parametrize("logs", [False, True], ids=["robot", "logs"])
def test_rounds_of_the_loop(tmp_path, logs):
    file = tmp_path / "rounds.pt"
    turns = list(loop_on(GPU, None, logs=logs))
    assert turns[-1].posterior.mean.device == GPU
    first = next(iter(loop_on(GPU, file, logs=logs)))
    assert torch.equal(first.posterior.mean, turns[0].posterior.mean)
    resumed = loop_on(GPU, file, logs=logs)
    assert resumed.resume()
    *_, last = resumed
    assert last.index == 1
    assert torch.allclose(last.posterior.mean, turns[1].posterior.mean, atol=0.2)
