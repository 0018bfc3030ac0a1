"""What a policy earns: one episode per environment, without exploration."""

from __future__ import annotations

__all__ = ["evaluate"]

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

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
        ValueError: ``max_steps`` is not positive.
        SimulationError: A reward is not finite.

    Example:
        >>> from torchrl_bayessim.agents.ppo import PPO
        >>> from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv
        >>> env = PendulumEnv(3, max_steps=200)
        >>> evaluate(env, PPO(env).policy, max_steps=200).shape
        torch.Size([3])
    """
    if max_steps < 1:
        raise ValueError(message("max_steps of at least 1", max_steps))
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
