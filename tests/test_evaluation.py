import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import GymEnv

from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.classic_control.mountain_car import MountainCarEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.evaluation import evaluate, successes


def always(index, n):
    action = torch.nn.functional.one_hot(torch.tensor(index), n)
    return TensorDictModule(
        lambda obs: action.expand(*obs.shape[:-1], n), in_keys=["observation"], out_keys=["action"]
    )


def test_an_idle_car_loses_one_per_step_until_truncated():
    returns = evaluate(MountainCarEnv(3, max_steps=200), always(1, 3), max_steps=1_000)
    assert returns.tolist() == [-200.0] * 3


def test_episodes_end_each_in_its_own_time_and_count_once():
    env, n = CartPoleEnv(6, max_steps=500), 6
    returns = evaluate(env, always(1, 2), max_steps=500)
    rollout = CartPoleEnv(n, max_steps=500).rollout(30, always(1, 2), break_when_any_done=False)
    first_end = rollout["next", "done"][..., 0].int().argmax(-1) + 1
    assert returns.tolist() == first_end.tolist()


def test_max_steps_cuts_off():
    assert evaluate(CartPoleEnv(2), always(1, 2), max_steps=3).tolist() == [3.0, 3.0]


def test_a_single_environment_of_gymnasium():
    assert evaluate(GymEnv("CartPole-v1"), always(0, 2), max_steps=4).tolist() == 4.0


@pytest.mark.parametrize("categorical", [False, True])
def test_no_exploration(categorical):
    options = {"max_steps": 50, "categorical_action_encoding": categorical}
    env, twin = CartPoleEnv(5, **options), CartPoleEnv(5, **options)
    policy = PPO(env).policy
    first = evaluate(env, policy, max_steps=50)
    torch.rand(3)
    assert torch.equal(first, evaluate(twin, policy, max_steps=50))


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="max_steps to be positive, got 0"):
        evaluate(CartPoleEnv(1), always(0, 2), max_steps=0)


def test_rewards_that_are_not_finite_are_not_averaged_away():
    class Broken(CartPoleEnv):
        def _advance(self, state, action):
            state, reward, terminated = super()._advance(state, action)
            return state, reward * torch.nan, terminated

    with pytest.raises(SimulationError, match="finite rewards"):
        evaluate(Broken(2), always(0, 2), max_steps=5)


def towards_the_goal(gain):
    """Move the gripper to the goal, 5 cm per unit of action."""

    def act(observation, goal):
        step = gain * (goal - observation[..., :3]) / 0.05
        return torch.cat([step.clamp(-1, 1), step[..., :1] * 0], -1)

    return TensorDictModule(act, in_keys=["observation", "desired_goal"], out_keys=["action"])


@pytest.mark.parametrize(("gain", "reached"), [(1.0, True), (-1.0, False)])
def test_success_is_being_at_the_goal_in_the_end(gain, reached):
    env = BatchedMujocoEnv("FetchReach-v4", 6, threads=1)
    found = successes(env, towards_the_goal(gain), max_steps=60)  # ten steps of the next episode
    assert found.tolist() == [reached] * 6
    steps = env.rollout(50, towards_the_goal(gain))
    assert (steps["next", "reward"][:, 0] == -1).any()  # not all are there from the start


def test_success_needs_sparse_goal_rewards():
    with pytest.raises(ValueError, match=r"sparse goal rewards, -1 or 0, got \[1.0\]"):
        successes(CartPoleEnv(2, max_steps=5), always(1, 2), max_steps=5)
