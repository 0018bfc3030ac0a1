import copy

import pytest
import torch
from torchrl.data import Unbounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_bayessim.agents.ddpg import DDPG
from torchrl_bayessim.agents.goal_networks import _multiplies
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.tasks.fetch import goal_reward
from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.evaluation import successes
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.randomness import isolated
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

SMALL = {"hidden": (32, 32), "batch_size": 64, "updates_per_frame": 0.05, "capacity": 1000}
FRICTION = ("geom_friction[body:table0,0]", "geom_friction[object0,0]")


def push(n=4, seed=0):
    physics = ApplyPhysics(MujocoPhysics(friction=FRICTION))
    prior = DomainRandomizer(BoxPrior({"friction": (0.1, 1.0)}))
    env = BatchedMujocoEnv("FetchPush-v4", n, seed=seed, threads=1)
    return TransformedEnv(env, Compose(physics, prior))


@pytest.fixture(scope="module")
def episodes():
    return push().rollout(50, break_when_any_done=False)


def changed(before, after):
    return {name for name in after if not torch.equal(before[name], after[name])}


def test_learns_to_reach():
    env = BatchedMujocoEnv("FetchReach-v4", 16, threads=1)
    learner = DDPG(
        env,
        goal_reward,
        hidden=(64, 64),
        batch_size=64,
        tau=0.02,
        updates_per_frame=0.15,
        learning_rate=3e-3,
    )
    scoring = BatchedMujocoEnv("FetchReach-v4", 32, seed=1, threads=1)
    before = successes(scoring, learner.policy, max_steps=50)
    for i in range(6):
        with isolated(i), torch.no_grad():
            batch = env.rollout(50, learner.policy, break_when_any_done=False)
        learner.update(batch, key=(i,), progress=i / 6)
    after = successes(scoring, learner.policy, max_steps=50)
    assert before.double().mean() < 0.3
    assert after.double().mean() > 0.6


def test_target_networks_follow_by_tau(episodes):
    learner = DDPG(push(), goal_reward, **SMALL | {"updates_per_frame": 1 / 200, "tau": 0.1})
    before = {name: value.clone() for name, value in learner._tensors().items()}
    learner.update(episodes, key=(0,))
    after = learner._tensors()
    name = "value_network_params.module.layers.0.weight"
    assert not torch.equal(before[name], after[name])
    expected = 0.9 * before[f"target_{name}"] + 0.1 * after[name]
    torch.testing.assert_close(after[f"target_{name}"], expected)


def test_td3_has_two_critics_and_delays_its_actor(episodes):
    learner = DDPG(push(), goal_reward, algorithm="td3", **SMALL | {"updates_per_frame": 1 / 200})
    assert learner.name == "TD3+HER"
    assert DDPG(push(), goal_reward, **SMALL).name == "DDPG+HER"
    names = {n for n in learner._tensors() if "target" not in n}
    assert all(len(v) == 2 for n, v in learner._tensors().items() if "value" in n)
    before = {name: value.clone() for name, value in learner._tensors().items()}
    learner.update(episodes, key=(0,))  # one update
    moved = changed(before, learner._tensors())
    assert {n for n in names if "qvalue" in n} <= moved
    assert not {n for n in moved if "actor" in n}
    learner.updates_per_frame = 2 / 200
    learner.update(episodes, key=(1,))
    assert {n for n in names if "actor" in n} <= changed(before, learner._tensors())


def test_a_delayed_actor_of_ddpg_learns_as_often_as_is_said_and_in_tables_too(episodes):
    options = SMALL | {"updates_per_frame": 5 / 200}
    names = {every: DDPG(push(), goal_reward, actor_every=every, **SMALL).name for every in (1, 3)}
    assert names == {1: "DDPG+HER", 3: "DDPG+HER, actor once in 3 updates"}
    td3 = {"algorithm": "td3", **SMALL}
    assert DDPG(push(), goal_reward, actor_every=2, **td3).name == "TD3+HER"
    assert DDPG(push(), goal_reward, actor_every=1, **td3).name == "TD3+HER, actor at every update"
    learner = DDPG(push(), goal_reward, actor_every=2, **options)
    learner.update(episodes, key=(0,))
    steps = {part: adam.state_dict()["state"] for part, adam in learner._optimizers.items()}
    counts = {part: {int(s["step"]) for s in state.values()} for part, state in steps.items()}
    assert counts == {"actor": {2}, "critic": {5}}


def test_the_critic_sees_the_physics_and_the_actor_never(episodes):
    learner = DDPG(push(), goal_reward, critic_keys=["theta"], **SMALL)
    assert learner.name == "DDPG+HER, critic sees theta"
    learner.update(episodes, key=(0,))
    assert "theta" not in learner.policy.in_keys
    steps = episodes.reshape(-1)[:10]
    other = steps.clone().set("theta", steps["theta"] + 0.5)
    states = [learner.state.full(part) for part in (steps, other)]
    action = torch.zeros(10, 4)
    loss = learner._loss
    with loss.value_network_params.to_module(loss.value_network), torch.no_grad():
        critic = loss.value_network.module
        assert not torch.allclose(critic(states[0], action), critic(states[1], action))
    with loss.actor_network_params.to_module(loss.actor_network), torch.no_grad():
        actor = loss.actor_network.module
        assert torch.equal(actor(states[0]), actor(states[1]))


def test_the_policy_is_the_actor_that_learns(episodes):
    learner = DDPG(push(), goal_reward, **SMALL)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        before = learner.policy(episodes.clone())["action"]
        learner.update(episodes, key=(0,))
        after = learner.policy(episodes.clone())["action"]
        state = learner.state.full(episodes)
        loss = learner._loss
        with loss.actor_network_params.to_module(loss.actor_network):
            torch.testing.assert_close(after, loss.actor_network.module(state))
        keys = {key: episodes[key] for key in ("observation", "desired_goal")}
        torch.testing.assert_close(learner.policy(**keys), after)
    assert not torch.allclose(before, after)


def test_policies_are_kept_under_the_names_that_older_checkpoints_have(episodes):
    learner = DDPG(push(), goal_reward, **SMALL)
    names = learner.policy.state_dict()
    assert {"module.0.module.low", "module.0.module.high"} <= names.keys()
    assert "module.0.module.actor.layers.0.weight" in names
    assert "module.0.module.state.normalizer.shift" in names
    with pytest.raises(KeyError, match="desired_goal"):
        learner.policy(episodes.exclude("desired_goal"))


def test_exploration_is_part_uniform_and_part_noise():
    env = push(64)
    learner = DDPG(env, goal_reward, random_share=0.3, noise=0.05, **SMALL)
    start = env.reset()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        mean = learner.policy(start.clone())["action"]
    with torch.no_grad():
        actions = torch.stack([learner.policy(start.clone())["action"] for _ in range(50)])
    assert actions.abs().max() <= 1
    far = (actions - mean).abs().amax(-1) > 0.25  # five standard deviations
    assert 0.25 < far.double().mean() < 0.33
    noise = (actions - mean)[~far]
    assert 0.04 < noise.std() < 0.08  # some uniform actions lie near by chance


def test_statistics_are_those_of_observations_and_of_meant_and_reached_goals(episodes):
    learner = DDPG(push(), goal_reward, critic_keys=["theta"], **SMALL)
    learner.update(episodes, key=(0,))
    normalizer = learner.state.normalizer
    observed = episodes["observation"].flatten(0, 1).double()
    torch.testing.assert_close(normalizer.mean[:25], observed.mean(0))
    goals = torch.cat([episodes["desired_goal"], episodes["next", "achieved_goal"]])
    torch.testing.assert_close(normalizer.mean[25:], goals.double().flatten(0, 1).mean(0))
    assert normalizer.scale.max() <= 100  # of 1 / 0.01: standing fingers are not blown up
    assert learner.state.full(episodes).abs().max() <= 5


def test_statistics_go_on_with_every_batch(episodes):
    learner = DDPG(push(), goal_reward, critic_keys=["theta"], **SMALL)
    for key, shift in enumerate((0.0, 4.0)):
        batch = episodes.clone()
        batch["observation"] += shift
        batch["theta"] += shift
        learner.update(batch, key=(key,))
    observed = episodes["observation"].flatten(0, 1).double().mean(0)
    torch.testing.assert_close(learner.state.normalizer.mean[:25], observed + 2.0)
    theta = episodes["theta"].flatten(0, 1).double().mean(0)
    torch.testing.assert_close(learner.state.critic_normalizer.mean, theta + 2.0)


def test_batches_mix_relabelled_transitions_with_others(episodes):
    learner = DDPG(push(), goal_reward, relabelled=0.5, **SMALL)
    marked = episodes.clone()
    for goal in (marked["desired_goal"], marked["next", "desired_goal"]):
        goal[:] = 9.0
    marked["next", "reward"][:] = -1.0
    learner.buffer.extend(marked.select(*learner.kept_keys))
    learner.state.observe(marked)
    own = learner.state.full(marked)[0, 0, 25:28]  # of the goal, as the networks see it
    batches = list(learner._replayed(20, key=(0,)))
    shares = [(batch["state"][:, 25:28] == own).all(-1).double().mean() for batch in batches]
    assert 0.2 < min(shares) <= max(shares) < 0.8  # five standard errors


def test_a_critic_that_has_blown_up_stops_the_training(episodes):
    learner = DDPG(push(), goal_reward, **SMALL)
    wild = learner._tensors()["value_network_params.module.layers.0.weight"]
    wild *= 1e6
    with pytest.raises(SimulationError, match=r"a loss below 2\.5e\+05 of the critic, got .*Try"):
        learner.update(episodes, key=(0,))


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"algorithm": "td3"}, "a state of DDPG with algorithm='td3', got 'ddpg'"),
        ({"hidden": (16,)}, r"with hidden=\[16\], got \[32, 32\]"),
        ({"capacity": 2000}, "with capacity=2000, got 1000"),
        ({"critic_keys": ["theta"]}, r"with critic_keys=\['theta'\], got \[\]"),
    ],
)
def test_a_state_of_another_learner_is_refused(episodes, options, match):
    learner = DDPG(push(), goal_reward, **SMALL)
    learner.update(episodes, key=(0,))
    other = DDPG(push(), goal_reward, **SMALL | options)
    before = copy.deepcopy(other._tensors())
    with pytest.raises(ValueError, match=match):
        other.load_state_dict(learner.state_dict())
    assert not changed(before, other._tensors())


def test_resumed_it_learns_the_same(episodes):
    learner = DDPG(push(), goal_reward, algorithm="td3", **SMALL)
    learner.update(episodes, key=(0,))
    twin = DDPG(push(), goal_reward, algorithm="td3", **SMALL | {"seed": 0})
    twin.load_state_dict(copy.deepcopy(learner.state_dict()))
    reports = [one.update(episodes, key=(1,), progress=0.9) for one in (learner, twin)]
    assert reports[0] == reports[1]
    assert not changed(learner._tensors(), twin._tensors())


@pytest.mark.parametrize("algorithm", ["ddpg", "td3"])
def test_updates_that_are_owed_are_those_of_an_update(episodes, algorithm):
    learner, twin = (DDPG(push(), goal_reward, algorithm=algorithm, **SMALL) for _ in range(2))
    reported = learner.update(episodes, key=(0,))
    twin.begin(episodes, key=(0,))
    assert changed(learner._tensors(), twin._tensors())
    for share in (0.1, 0.11, 0.7):
        torch.rand(3)  # of somebody else
        with torch.no_grad():
            twin.work(share)
    assert changed(learner._tensors(), twin._tensors())
    assert twin.finish() == reported
    assert not changed(learner._tensors(), twin._tensors())
    assert twin.finish() == {}


def test_owed_updates_draw_nothing_from_the_global_generators(episodes):
    learner = DDPG(push(), goal_reward, algorithm="td3", **SMALL)
    torch.manual_seed(5)
    expected = torch.rand(4)
    torch.manual_seed(5)
    learner.begin(episodes, key=(0,))
    learner.work(0.5)
    learner.finish()
    assert torch.equal(torch.rand(4), expected)


def test_a_failure_in_the_midst_is_told_at_the_end_and_undone(episodes):
    learner = DDPG(push(), goal_reward, **SMALL)
    before = {name: value.clone() for name, value in learner._tensors().items()}
    learner.begin(episodes, key=(0,))
    learner.work(0.5)
    name = "value_network_params.module.layers.0.weight"
    learner._tensors()[name][0, 0] = torch.nan
    learner.work(1.0)
    with pytest.raises(SimulationError, match="finite loss of the critic, got nan"):
        learner.finish()
    assert not changed(before, learner._tensors())


def test_after_an_interrupt_the_rest_is_forgone(episodes, monkeypatch):
    learner = DDPG(push(), goal_reward, **SMALL)
    learner.begin(episodes, key=(0,))

    def interrupt():
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(learner._targets, "step", interrupt)
        with pytest.raises(KeyboardInterrupt):
            learner.work(0.5)
    with torch.no_grad():
        learner.state_dict()
    assert learner.update(episodes, key=(1,))["updates"] == 10


def test_a_checkpoint_owes_nothing(episodes):
    learner, twin = (DDPG(push(), goal_reward, **SMALL) for _ in range(2))
    learner.begin(episodes, key=(0,))
    twin.load_state_dict(copy.deepcopy(learner.state_dict()))
    twin.begin(episodes, key=(1,))
    learner.update(episodes, key=(1,))
    twin.finish()
    assert not changed(learner._tensors(), twin._tensors())


def test_hidden_layers_in_bfloat16_change_little(episodes):
    learner = DDPG(push(), goal_reward)
    seen, action = learner.state.full(episodes), episodes["action"]
    critic = learner._loss._networks.critic
    exact = critic(seen, action)
    precision = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision("medium")
        rounded = critic(seen, action)
    finally:
        torch.set_float32_matmul_precision(precision)
    assert rounded.dtype == torch.float32
    assert (rounded - exact).norm() < 0.02 * exact.norm()
    assert torch.equal(rounded, exact) != _multiplies()


def test_the_learning_rate_is_constant_and_then_falls(episodes):
    learner = DDPG(push(), goal_reward, **SMALL | {"updates_per_frame": 1 / 200})
    rates = [
        learner.update(episodes, key=(0,), progress=p)["learning_rate"] for p in (0, 0.6, 0.8, 1)
    ]
    assert rates == pytest.approx([1e-3, 1e-3, 5.5e-4, 1e-4])


def test_a_critic_that_is_nan_stops_the_training(episodes):
    learner = DDPG(push(), goal_reward, **SMALL)
    name = "value_network_params.module.layers.0.weight"
    learner._tensors()[name][0, 0] = torch.nan
    before = {name: value.clone() for name, value in learner._tensors().items()}
    with pytest.raises(
        SimulationError, match=r"finite loss of the critic, got nan.*Try: a smaller"
    ):
        learner.update(episodes, key=(0,))
    del before[name]
    assert not changed(before, {n: learner._tensors()[n] for n in before})


@pytest.mark.parametrize(
    ("part", "gradient"), [("actor", torch.nan), ("critic", torch.nan), ("critic", 1e30)]
)
def test_a_gradient_that_is_not_finite_at_last_is_told_and_undone(episodes, part, gradient):
    every = 10 if part == "actor" else 9  # once in ten updates, and no loss after the last one
    learner = DDPG(push(), goal_reward, actor_every=every, **SMALL)
    learner.update(episodes, key=(0,))
    before = {name: value.clone() for name, value in learner._tensors().items()}
    adam, made = learner._optimizers[part], []

    def spoil(*_):
        made.append(part)
        if len(made) == (1 if part == "actor" else 10):
            learner._parameters(part)[0].grad[0, 0] = gradient

    hook = adam.register_step_pre_hook(spoil)
    with pytest.raises(SimulationError, match=r"finite parameters after the.*Try: a smaller"):
        learner.update(episodes, key=(1,))
    hook.remove()
    assert not changed(before, learner._tensors())
    assert learner.update(episodes, key=(1,))["updates"] == 10


def test_a_batch_may_come_with_the_policys_graph():
    env = push()
    learner = DDPG(env, goal_reward, **SMALL)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        batch = env.rollout(50, learner.policy, break_when_any_done=False)
    assert batch["action"].requires_grad
    assert learner.update(batch, key=(0,))["updates"] == 10
    assert not any(value.requires_grad for value in learner.buffer.contents()["entries"].values())


def test_a_reward_that_is_not_the_environments_is_refused(episodes):
    def dense(achieved, desired):
        return goal_reward(achieved, desired, dense=True)

    learner = DDPG(push(), dense, **SMALL)
    before = {name: value.clone() for name, value in learner._tensors().items()}
    with pytest.raises(ValueError, match="the environment's own reward, -1 for a transition, got"):
        learner.update(episodes, key=(0,))
    assert len(learner.buffer) == 0
    assert not changed(before, learner._tensors())
    assert learner.finish() == {}


def test_rewards_beyond_what_targets_are_bounded_by_are_refused(episodes):
    ddpg = DDPG(push(), goal_reward, hidden=(16,), batch_size=64, rewards=(0.0, 1.0))
    match = r"rewards within the given \(0\.0, 1\.0\).*got \(-1\.0, .*least, greatest\) of all"
    with pytest.raises(ValueError, match=match):
        ddpg.update(episodes, key=(0,))


def test_so_few_transitions_that_no_update_is_due_are_refused(episodes):
    ddpg = DDPG(push(), goal_reward, hidden=(16,), batch_size=64, updates_per_frame=0.001)
    with pytest.raises(ValueError, match=r"one update per batch of 200 transitions.*got 0\.2"):
        ddpg.update(episodes, key=(0,))
    assert len(ddpg.buffer) == 0
    none = DDPG(push(), goal_reward, hidden=(16,), batch_size=64, updates_per_frame=0.0)
    assert none.update(episodes, key=(0,))["updates"] == 0  # as was asked


def test_bad_batches_are_refused(episodes):
    learner = DDPG(push(), goal_reward, **SMALL)
    broken = episodes.clone()
    broken["next", "observation"][1, 3] = torch.nan
    with pytest.raises(SimulationError, match=r"finite \('next', 'observation'\) in the batch"):
        learner.update(broken, key=(0,))
    with pytest.raises(ValueError, match="no 'achieved_goal'"):
        learner.update(episodes.exclude("achieved_goal"), key=(0,))
    with pytest.raises(ValueError, match=r"episodes .* that end with their row"):
        learner.update(episodes[:, :30], key=(0,))
    assert len(learner.buffer) == 0


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"algorithm": "td4"}, ValueError, r"got 'td4'. Available: td3 \(did you mean this\?\)"),
        ({"capacity": 63}, ValueError, "replay buffer of at least one batch of 64, got 63"),
        ({"actor_every": 0}, ValueError, "updates per update of the actor.*got 0"),
        ({"critic_keys": ["thetaa"]}, ValueError, r"theta \(did you mean this\?\)"),
        ({"gamma": 1.0}, ValueError, r"gamma of at least 0 and below 1, got 1\.0"),
        ({"rewards": (0.0, -1.0)}, ValueError, r"greatest.*Try: rewards=\(-1\.0, 0\.0\)"),
        ({"rewards": (-1.0, -1.0)}, ValueError, r"one is greater, got \(-1\.0, -1\.0\)"),
        ({"rewards": (float("nan"), 0.0)}, ValueError, "a finite least reward, got nan"),
        ({"rewards": (-1.0, float("nan"))}, ValueError, "a finite greatest reward, got nan"),
        ({"rewards": (-1.0,)}, ValueError, r"two numbers, got \(-1\.0,\)"),
        ({"rewards": -1.0}, TypeError, r"two numbers, got 'float'"),
    ],
)
def test_impossible_settings_are_refused(options, error, match):
    with pytest.raises(error, match=match):
        DDPG(push(), goal_reward, **SMALL | options)


def test_environments_on_a_gpu_are_refused(monkeypatch):
    monkeypatch.setattr(CartPoleEnv, "device", torch.device("cuda:0"), raising=False)
    env = object.__new__(CartPoleEnv)  # none can be made without a GPU
    with pytest.raises(ValueError, match=r"environment on the CPU, where.*'one on cuda:0'\. Try"):
        DDPG(env, goal_reward)


def test_environments_without_goals_or_bounds_are_refused(episodes):
    with pytest.raises(ValueError, match=r"observes observation, achieved_goal, desired_goal, got"):
        DDPG(CartPoleEnv(2, max_steps=10), goal_reward)
    env = BatchedMujocoEnv("FetchReach-v4", 2, threads=1)
    env.action_spec = Unbounded((2, 4))
    with pytest.raises(TypeError, match="a bounded action spec, got 'Unbounded"):
        DDPG(env, goal_reward)
    learner = DDPG(push(), goal_reward, **SMALL | {"batch_size": 201, "capacity": 300})
    with pytest.raises(ValueError, match="holds at least one batch of 201, got 200"):
        learner.update(episodes, key=(0,))
