"""What a policy earns and reaches: one episode per environment, without exploration."""

from __future__ import annotations

__all__ = ["evaluate", "successes"]

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from .counts import check_count
from .errors import SimulationError, message


@torch.no_grad()
def evaluate(env: EnvBase, policy: TensorDictModuleBase, *, max_steps: int) -> Tensor:
    """Return the undiscounted return of one episode per environment, shape ``env.batch_size``.

    Actions are the policy's deterministic ones. An episode that has not ended after ``max_steps``
    counts with what it earned until then. Environments that end early start again, unseen, until
    the last one ends.

    Args:
        env: An environment of any batch size; it is reset first.
        policy: The policy, such as `PPO.policy`.
        max_steps: Longest episode.

    Raises:
        TypeError: ``max_steps`` is no whole number.
        ValueError: ``max_steps`` is not positive.
        SimulationError: A reward is not finite.

    Example:
        >>> from torchrl_bayessim.agents.ppo import PPO
        >>> from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv
        >>> env = PendulumEnv(3, max_steps=200)
        >>> evaluate(env, PPO(env).policy, max_steps=200).shape
        torch.Size([3])
    """
    check_count("max_steps", max_steps)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = env.reset()
        total = torch.zeros(env.batch_size, device=env.device)
        running = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
        for _ in range(max_steps):
            tensordict, following = env.step_and_maybe_reset(policy(tensordict))
            reward = tensordict["next", "reward"].view(env.batch_size)
            if not reward[running].isfinite().all():
                raise SimulationError(message("finite rewards", reward[running].tolist()))
            total = torch.where(running, total + reward, total)
            running = running & ~tensordict["next", "done"].view(env.batch_size)
            if not running.any():
                break
            tensordict = following
    return total


@torch.no_grad()
def successes(env: EnvBase, policy: TensorDictModuleBase, *, max_steps: int) -> Tensor:
    """Return whether each environment's goal is reached at the end of its episode.

    That is a reward of zero for the last step, as sparse goal rewards have it: -1 until the goal
    is reached, then 0 for as long as it is (Plappert et al. 2018). Shape ``env.batch_size``.

    Args:
        env: An environment of sparse goal rewards; it is reset first.
        policy: Such as `DDPG.policy`; its deterministic actions are taken.
        max_steps: Longest episode.

    Raises:
        TypeError: ``max_steps`` is no whole number.
        ValueError: ``max_steps`` is not positive, or a reward is neither -1 nor 0.

    Example:
        >>> from torchrl_bayessim.agents.ddpg import DDPG
        >>> from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
        >>> from torchrl_bayessim.envs.tasks.fetch import goal_reward
        >>> env = BatchedMujocoEnv("FetchReach-v4", 3, threads=1)
        >>> successes(env, DDPG(env, goal_reward).policy, max_steps=50)
        tensor([False, False, False])
    """
    check_count("max_steps", max_steps)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        steps = env.rollout(max_steps, policy, break_when_any_done=False)
    first = steps["next", "done"].squeeze(-1).long().argmax(-1)  # 0 if none ended
    first = torch.where(steps["next", "done"].any(-2).squeeze(-1), first, steps.shape[-1] - 1)
    reward = steps["next", "reward"].squeeze(-1)
    if not ((reward == 0) | (reward == -1)).all():
        raise ValueError(message("sparse goal rewards, -1 or 0", reward.unique().tolist()[:5]))
    return reward.gather(-1, first.unsqueeze(-1)).squeeze(-1) == 0
