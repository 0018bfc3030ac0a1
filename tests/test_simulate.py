import random

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import Compose, GymEnv, SerialEnv, StepCounter, Transform, TransformedEnv

from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.errors import PhysicsError, SimulationError
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.replay_actions import ReplayActions
from torchrl_bayessim.simulate import (
    collect_summaries,
    make_collector,
    next_batch,
    simulate,
)
from torchrl_bayessim.sources import draw
from torchrl_bayessim.summaries import SummaryStatistics, duration, linear_dynamics, moments
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

PRIOR = BoxPrior({"length": (0.2, 1.5)})
STATISTICS = SummaryStatistics(moments, duration)
KINDS = ["batched", "serial", "single", "one"]


def single():
    return TransformedEnv(GymEnv("CartPole-v1"), ApplyPhysics(AttributePhysics("length")))


def randomized(kind="batched", *more):
    """Return an environment of this kind and its randomizer."""
    randomizer = DomainRandomizer(PRIOR)
    if kind == "serial":
        return TransformedEnv(SerialEnv(2, single), Compose(randomizer, *more)), randomizer
    simulator = (
        GymEnv("CartPole-v1") if kind == "single" else CartPoleEnv(1 if kind == "one" else 6)
    )
    physics = ApplyPhysics(AttributePhysics("length"))
    return TransformedEnv(simulator, Compose(physics, randomizer, *more)), randomizer


def always(action):
    """Return the policy that pushes one way."""

    def push(observation):
        one_hot = torch.nn.functional.one_hot(torch.tensor(action), 2)
        return one_hot.expand(*observation.shape[:-1], 2)

    return TensorDictModule(push, in_keys=["observation"], out_keys=["action"])


def recorded(kind, theta, *, trajectories=1, policy=None, steps=12, key=(0,)):
    """Return summaries, and all batches that they came from, flattened to ``[rows, T]``."""
    env, randomizer = randomized(kind)
    collector = make_collector(env, policy, steps=steps)
    summaries, batches = collect_summaries(
        collector,
        STATISTICS,
        randomizer,
        theta,
        trajectories=trajectories,
        key=key,
        keep=1000,
        progress=False,
    )
    collector.shutdown()
    return summaries, torch.cat(batches)[: len(theta) * trajectories]


@pytest.mark.parametrize("kind", KINDS)
def test_a_pair_holds_the_parameters_that_its_simulator_held(kind):
    """The half length of the pole, recovered from the motion that was recorded."""
    theta = draw(PRIOR, 7, key=(0,))
    summaries, batch = recorded(kind, theta)
    assert summaries.shape == (7, 9)
    first = batch[:, 0]
    _, x_dot, angle, omega = first["observation"].double().unbind(-1)
    x_acc = (first["next", "observation"][:, 1].double() - x_dot) / 0.02
    turn = (first["next", "observation"][:, 3].double() - omega) / 0.02
    # l (4/3 θ'' + x'' cos θ) = g sin θ l: the equation of the pole has l on one side only
    length = (9.8 * angle.sin() - x_acc * angle.cos()) / (4 / 3 * turn)
    torch.testing.assert_close(length.float(), theta[:, 0], rtol=2e-3, atol=0)
    torch.testing.assert_close(first["theta"], theta)


def test_the_parameters_of_batched_mujoco_are_in_its_model():
    prior = BoxPrior({"torso": (2.0, 6.0)})
    randomizer = DomainRandomizer(prior)
    physics = MujocoPhysics(torso="body_mass[torso]")
    base = BatchedMujocoEnv("Hopper-v5", 3)
    env = TransformedEnv(base, Compose(ApplyPhysics(physics), randomizer))
    collector = make_collector(env, None, steps=6)
    theta = draw(prior, 3, key=(1,))
    summaries, _ = collect_summaries(
        collector, STATISTICS, randomizer, theta, key=(0,), progress=False
    )
    held = physics.read(base, tensordict=TensorDict(batch_size=[3]))
    collector.shutdown()
    torch.testing.assert_close(held.float(), theta)
    assert summaries.shape == (3, 2 * 11 + 1)
    assert summaries.isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("trajectories", [1, 2, 4])
def test_all_trajectories_of_a_pair_have_its_parameters_and_differ(kind, trajectories):
    theta = draw(PRIOR, 5, key=(0,))
    summaries, batch = recorded(kind, theta, trajectories=trajectories)
    groups = batch.unflatten(0, (5, trajectories))
    held = groups["theta"][:, :, 0]
    assert torch.equal(held, theta[:, None].expand(5, trajectories, 1))
    starts = groups["observation"][:, :, 0].flatten(0, 1)
    assert len(starts.unique(dim=0)) == 5 * trajectories
    assert len(summaries.unique(dim=0)) == 5
    if trajectories == 1:
        assert torch.allclose(summaries, STATISTICS(batch)["summary"])


@pytest.mark.parametrize("kind", KINDS)
def test_one_environment_or_many_give_pairs_of_one_shape(kind):
    env, randomizer = randomized(kind)
    pairs = simulate(
        env, None, STATISTICS, randomizer, pairs=5, max_steps=9, trajectories=3, progress=False
    )
    assert pairs.batch_size == (5,)
    assert pairs["theta"].shape == (5, 1)
    assert pairs["summary"].shape == (5, 9)
    assert PRIOR.contains(pairs["theta"]).all()


def test_another_policy_gives_other_summaries():
    theta = draw(PRIOR, 6, key=(0,))
    left, _ = recorded("batched", theta, policy=always(0))
    again, _ = recorded("batched", theta, policy=always(0))
    right, _ = recorded("batched", theta, policy=always(1))
    assert torch.equal(left, again)
    assert (left[:, 1] * right[:, 1] < 0).all()  # the mean change of the cart's velocity


def test_a_key_gives_the_same_simulations_and_another_key_others():
    theta = draw(PRIOR, 6, key=(0,))
    same = [recorded("batched", theta, key=(0, "a"))[0] for _ in range(2)]
    assert torch.equal(*same)
    assert not torch.equal(same[0], recorded("batched", theta, key=(0, "b"))[0])


def test_the_first_episode_counts_and_not_the_next_one_in_its_row():
    theta = draw(PRIOR, 6, key=(0,))
    summaries, batch = recorded("batched", theta, policy=always(1), steps=40)
    done = batch["next", "done"].squeeze(-1)
    assert (done.sum(-1) > 1).all()
    length = done.int().argmax(-1) + 1
    torch.testing.assert_close(summaries[:, -1], length.float().log())


def test_the_randomizer_has_its_source_back_also_after_an_error():
    env, randomizer = randomized()
    collector, theta = make_collector(env, None, steps=12), draw(PRIOR, 3, key=(0,))
    collect_summaries(collector, STATISTICS, randomizer, theta, key=(0,), progress=False)
    assert randomizer.source is PRIOR

    def broken(batch):
        raise RuntimeError("the statistics broke")

    with pytest.raises(RuntimeError, match="the statistics broke"):
        collect_summaries(
            collector, STATISTICS, randomizer, theta, key=(0,), prepare=broken, progress=False
        )
    assert randomizer.source is PRIOR


def test_a_pinned_or_foreign_randomizer_is_noticed():
    """Otherwise every summary would stand beside parameters that it was not simulated at."""
    env, randomizer = randomized()
    collector, theta = make_collector(env, None, steps=12), draw(PRIOR, 3, key=(0,))
    randomizer.pin([0.5])
    with pytest.raises(PhysicsError, match=r"got '\[0.5\] first'.*own randomizer.*not pinned"):
        collect_summaries(collector, STATISTICS, randomizer, theta, key=(0,), progress=False)
    _, foreign = randomized()
    randomizer.unpin()
    with pytest.raises(PhysicsError, match="simulations at the parameters asked for"):
        collect_summaries(collector, STATISTICS, foreign, theta, key=(0,), progress=False)
    assert foreign.source is randomizer.source is PRIOR


def generators():
    """Return the state of every global generator."""
    _, keys, *rest = np.random.get_state()  # noqa: NPY002
    return torch.random.get_rng_state().tolist(), keys.tolist(), rest, random.getstate()


@pytest.mark.parametrize("kind", KINDS)
def test_the_global_generators_stay_as_they_were(kind):
    env, randomizer = randomized(kind)
    before = generators()
    simulate(env, None, STATISTICS, randomizer, pairs=4, max_steps=5, progress=False)
    assert generators() == before


@pytest.mark.parametrize("kind", ["batched", "single"])
def test_recorded_actions_are_played_step_by_step(kind):
    """Environment i plays log i mod n, from the start again in every episode."""
    actions = torch.nn.functional.one_hot(torch.randint(2, (3, 8)), 2)
    env, _ = randomized(kind, StepCounter())
    batch = env.rollout(20, ReplayActions(actions), break_when_any_done=False)
    batch = batch.reshape(-1, 20)
    step = batch["step_count"].squeeze(-1)
    assert (step[:, 1:] == 0).any()  # an episode has ended
    for row, played in enumerate(batch["action"]):
        expected = actions[row % 3][step[row].clamp_max(7)]
        assert torch.equal(played, expected)


def test_actions_that_cannot_be_replayed_are_refused():
    with pytest.raises(ValueError, match=r"shape \(n, T, A\), got \(4, 2\)"):
        ReplayActions(torch.zeros(4, 2))
    with pytest.raises(ValueError, match=r"shape \(n, T, A\), got \(0, 4, 2\)"):
        ReplayActions(torch.zeros(0, 4, 2))
    with pytest.raises(ValueError, match="finite recorded actions"):
        ReplayActions(torch.full((1, 4, 2), torch.nan))


class Diverging(Transform):
    def _step(self, tensordict, next_tensordict):
        far = next_tensordict["observation"].abs().sum(-1, keepdim=True) > 0.5
        observation = next_tensordict["observation"].masked_fill(far, torch.nan)
        return next_tensordict.set("observation", observation)


def diverging():
    randomizer = DomainRandomizer(BoxPrior({"length": (0.1, 2.0)}))
    physics = ApplyPhysics(AttributePhysics("length"))
    env = TransformedEnv(CartPoleEnv(8), Compose(physics, randomizer, Diverging()))
    return env, randomizer, PPO(env).policy


def test_a_simulation_that_gives_nan_has_no_summary_and_stops_no_other():
    env, randomizer, policy = diverging()
    statistics = SummaryStatistics(linear_dynamics)
    pairs = simulate(env, policy, statistics, randomizer, pairs=16, max_steps=4, progress=False)
    good = pairs["summary"].isfinite().all(-1)
    assert 0 < good.sum() < 16
    assert pairs["summary"][~good].isnan().all()


def test_nan_that_ends_a_collector_is_named():
    env, _, policy = diverging()
    options = {"total_frames": -1, "auto_register_policy_transforms": False}
    collector = Collector(env, policy, frames_per_batch=8 * 60, **options)
    with pytest.raises(SimulationError, match="does a simulation diverge"):
        next_batch(collector)
    collector.shutdown()


@pytest.mark.parametrize("name", ["pairs", "max_steps", "trajectories"])
def test_counts_are_positive(name):
    counts = {"pairs": 4, "max_steps": 4, "trajectories": 1} | {name: 0}
    randomizer = DomainRandomizer(BoxPrior({"length": (0.1, 2.0)}))
    env = TransformedEnv(
        CartPoleEnv(4), Compose(ApplyPhysics(AttributePhysics("length")), randomizer)
    )
    with pytest.raises(ValueError, match=f"{name} to be positive"):
        simulate(env, None, SummaryStatistics(linear_dynamics), randomizer, **counts)


@pytest.mark.parametrize("make", [lambda: PendulumEnv(8), lambda: GymEnv("Pendulum-v1")])
def test_without_a_policy_actions_cover_their_range_evenly(make):
    def torques(state, action, next_state, mask):
        return action[..., 0]

    prior = BoxPrior({"m": (0.5, 2.0)})
    randomizer = DomainRandomizer(prior)
    env = TransformedEnv(make(), Compose(ApplyPhysics(AttributePhysics("m")), randomizer))
    pairs = simulate(
        env, None, SummaryStatistics(torques), randomizer, pairs=40, max_steps=50, progress=False
    )
    torque = pairs["summary"].flatten()
    levels = torch.linspace(0, 1, 9)
    quantiles = torch.quantile(torque, levels)
    torch.testing.assert_close(quantiles, 4 * levels - 2, rtol=0, atol=0.2)  # ± 2 N m
    assert quantiles[0] < -1.95
    assert quantiles[-1] > 1.95
