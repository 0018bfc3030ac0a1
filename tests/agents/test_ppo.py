import copy

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torchrl.collectors import Collector
from torchrl.data import Composite, MultiOneHot, Unbounded

from torchrl_bayessim.agents.normalizer import Normalizer
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv
from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.evaluation import evaluate
from torchrl_bayessim.randomness import isolated


class InformedCartPole(CartPoleEnv):
    """Publishes its pole's length under "theta"."""

    def _make_specs(self):
        super()._make_specs()
        n = self.batch_size[0]
        self.observation_spec = Composite(
            dict(self.observation_spec.items()) | {"theta": Unbounded((n, 1))}, shape=(n,)
        )

    def _output(self, terminated, truncated):
        output = super()._output(terminated, truncated)
        return output.set("theta", self.parameters["length"][:, None])


class FreePendulum(PendulumEnv):
    def _action_spec(self):
        return Unbounded((self.batch_size[0], 1))


def collect(env, ppo, *, steps=32):
    with torch.no_grad(), isolated(0, "collect"):
        return env.rollout(steps, ppo.policy, break_when_any_done=False)


@pytest.fixture
def learner():
    env = CartPoleEnv(8, max_steps=20)
    ppo = PPO(env, minibatch_size=64, epochs=2)
    return ppo, collect(env, ppo)


def weights(ppo):
    return {name: value.clone() for name, value in ppo.state_dict()["networks"].items()}


def equal(left, right):
    return all(torch.equal(left[name], right[name]) for name in left | right)


@pytest.mark.parametrize(
    ("env", "size"),
    [
        (CartPoleEnv(4, max_steps=9), (4, 5, 2)),
        (CartPoleEnv(4, max_steps=9, categorical_action_encoding=True), (4, 5)),
        (PendulumEnv(4), (4, 5, 1)),
        (FreePendulum(4), (4, 5, 1)),
    ],
    ids=["one-hot", "categorical", "bounded", "unbounded"],
)
def test_policy_follows_the_action_spec_and_learns(env, size):
    ppo = PPO(env, minibatch_size=8)
    batch = collect(env, ppo, steps=5)
    assert batch["action"].shape == size
    assert env.action_spec.is_in(batch["action"][:, 0])
    before = weights(ppo)
    diagnostics = ppo.update(batch, key=(0,))
    assert all(isinstance(value, float) for value in diagnostics.values())
    assert not equal(before, weights(ppo))


def test_bounded_policy_explores_by_its_initial_std_within_the_bounds():
    env = PendulumEnv(2_000)
    actions = collect(env, PPO(env, initial_std=0.1), steps=1)["action"]
    assert actions.std().item() == pytest.approx(2 * 0.1, rel=0.1)
    wide = collect(env, PPO(env, initial_std=3.0), steps=1)["action"]
    assert wide.abs().max() <= 2


def test_a_tie_between_actions_has_one_winner():
    env = CartPoleEnv(3)
    ppo = PPO(env)
    for parameter in ppo.policy.parameters():
        parameter.data.zero_()
    assert evaluate(env, ppo.policy, max_steps=3).tolist() == [3.0] * 3


def test_same_inputs_same_outputs_and_the_users_generators_do_not_notice(learner):
    ppo, batch = learner
    twin = copy.deepcopy(ppo)
    other = copy.deepcopy(ppo)
    before = torch.random.get_rng_state()
    first = ppo.update(batch, key=(3, "a"))
    torch.rand(7)
    assert twin.update(batch, key=(3, "a")) == first
    assert equal(weights(ppo), weights(twin))
    other.update(batch, key=(4, "a"))
    assert not equal(weights(ppo), weights(other))
    torch.random.set_rng_state(before)
    PPO(CartPoleEnv(2), seed=5).update(batch, key=(0,))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_seed_decides_the_initial_parameters():
    env = CartPoleEnv(2)
    assert equal(weights(PPO(env, seed=1)), weights(PPO(env, seed=1)))
    assert not equal(weights(PPO(env, seed=1)), weights(PPO(env, seed=2)))


def test_the_batch_is_left_as_it_was(learner):
    ppo, batch = learner
    before = batch.clone()
    ppo.update(batch, key=(0,))
    assert set(batch.keys(include_nested=True)) == set(before.keys(include_nested=True))
    assert (batch == before).all()


def test_value_is_bootstrapped_at_truncation_and_not_at_termination():
    env = CartPoleEnv(2, max_steps=4)
    ppo = PPO(env, gamma=0.9, gae_lambda=1.0)
    batch = collect(env, ppo, steps=6)  # the episode ends at step 4, another one begins
    batch["next", "terminated"][:] = False
    batch["next", "terminated"][0, 3] = True
    batch["next", "truncated"][0, 3] = False
    ppo._advantage(batch)
    with torch.no_grad():
        value = ppo.critic(batch["next"].select("observation").clone())["state_value"]
    discounted = 1 + 0.9 + 0.9**2 + 0.9**3
    target = batch["value_target"][:, 0, 0]
    assert target[0].item() == pytest.approx(discounted, abs=1e-4)
    assert target[1].item() == pytest.approx(discounted + 0.9**4 * value[1, 3, 0].item(), abs=1e-4)
    # The last row of the batch is cut off too, and nothing leaks over the end of an episode.
    after = 1 + 0.9 * (1 + 0.9 * value[0, 5, 0].item())
    assert batch["value_target"][0, 4, 0].item() == pytest.approx(after, abs=1e-4)


def test_a_critic_that_knows_the_physics_and_a_policy_that_does_not():
    env = InformedCartPole(8, max_steps=20)
    ppo = PPO(env, critic_keys=["theta"], minibatch_size=64, epochs=1)
    assert "theta" not in ppo.policy.in_keys
    assert "theta" in ppo.critic.in_keys
    batch = collect(env, ppo)
    ppo.update(batch, key=(0,))
    with pytest.raises(ValueError, match="no entry 'theta'"):
        ppo.update(batch.exclude("theta"), key=(0,))


def test_state_dict_continues_where_it_was(learner):
    ppo, batch = learner
    ppo.update(batch, key=(0,))
    resumed = PPO(CartPoleEnv(2), seed=0, minibatch_size=64, epochs=2)
    resumed.load_state_dict(copy.deepcopy(ppo.state_dict()))
    assert ppo.update(batch, key=(1,)) == resumed.update(batch, key=(1,))
    assert equal(weights(ppo), weights(resumed))


def test_statistics_move_with_updates_only(learner):
    ppo, batch = learner
    before = weights(ppo)
    evaluate(CartPoleEnv(4, max_steps=10), ppo.policy, max_steps=10)
    assert equal(before, weights(ppo))
    ppo.update(batch, key=(0,))
    mean = ppo.state_dict()["networks"]["critic.module.normalizer.shift"]
    torch.testing.assert_close(mean, batch["observation"].flatten(0, 1).mean(0))


def test_learning_rate_follows_the_progress(learner):
    ppo, batch = learner
    rates = [ppo.update(batch, key=(0,), progress=p)["learning_rate"] for p in (0, 0.5, 1, 2)]
    assert rates == pytest.approx([1e-3, 5.5e-4, 1e-4, 1e-4])


@pytest.mark.parametrize(
    ("key", "value", "match"),
    [
        (("next", "reward"), torch.nan, r"finite \('next', 'reward'\).*2 frames that are not"),
        ("observation", torch.inf, "finite 'observation'"),
        (("next", "reward"), 3e38, "finite PPO loss and gradient"),
    ],
)
def test_a_broken_batch_leaves_everything_as_it_was(learner, key, value, match):
    ppo, batch = learner
    ppo.update(batch, key=(0,))
    before = copy.deepcopy(ppo.state_dict())
    broken = batch.clone()
    broken[key][3, 5:7] = value
    with pytest.raises(SimulationError, match=match):
        ppo.update(broken, key=(1,))
    twin = copy.deepcopy(ppo)
    twin.load_state_dict(before)
    assert ppo.update(batch, key=(2,)) == twin.update(batch, key=(2,))
    assert equal(weights(ppo), weights(twin))


def test_a_batch_without_time_or_log_probabilities_is_refused(learner):
    ppo, batch = learner
    with pytest.raises(ValueError, match=r"batch of size \[N, T\]"):
        ppo.update(batch.reshape(-1), key=(0,))
    with pytest.raises(ValueError, match="no entry 'action_log_prob'"):
        ppo.update(batch.exclude("action_log_prob"), key=(0,))


def test_unknown_observation_and_action_specs_are_refused():
    with pytest.raises(ValueError, match=r"observation \(did you mean"):
        PPO(CartPoleEnv(2), observation_keys=["observations"])

    class TwoChoices(CartPoleEnv):
        def _action_spec(self):
            return MultiOneHot([2, 2], shape=(self.batch_size[0], 4))

    with pytest.raises(TypeError, match=r"action spec, got 'MultiOneHot'"):
        PPO(TwoChoices(2))


@given(st.lists(st.integers(1, 20), min_size=1, max_size=5), st.integers(0, 2**31))
def test_running_statistics_are_those_of_all_rows(sizes, seed):
    rows = torch.randn(sum(sizes), 3, generator=torch.Generator().manual_seed(seed)) * 5 + 2
    normalizer = Normalizer(3)
    for part in rows.split(sizes):
        normalizer.observe(part)
    variance, mean = torch.var_mean(rows.double(), 0, correction=0)
    torch.testing.assert_close(normalizer.mean, mean)
    torch.testing.assert_close(normalizer.variance, variance)


def test_a_constant_feature_is_only_centred():
    normalizer = Normalizer(2)
    normalizer.observe(torch.tensor([[3.0, 1.0], [3.0, 2.0]]))
    assert normalizer(torch.tensor([4.0, 1.5])).tolist() == pytest.approx([1.0, 0.0])


def test_learns_to_balance_a_pole():
    env = CartPoleEnv(32, max_steps=500)
    ppo = PPO(env, minibatch_size=256)
    before = evaluate(CartPoleEnv(32, max_steps=500, seed=1), ppo.policy, max_steps=500)
    frames, total = 32 * 64, 57_344
    with isolated(0, "collect"):
        collector = Collector(
            env,
            ppo.policy,
            frames_per_batch=frames,
            total_frames=total,
            auto_register_policy_transforms=True,
        )
        for i, batch in enumerate(collector):
            ppo.update(batch, key=(i,), progress=i * frames / total)
    after = evaluate(CartPoleEnv(32, max_steps=500, seed=1), ppo.policy, max_steps=500)
    assert before.mean() < 100
    assert after.mean() > 200
