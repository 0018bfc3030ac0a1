"""TorchRL's DDPG and TD3 losses with what goal-reaching needs: bounded targets, small actions.

Where every reward lies in ``[low, high]``, returns lie in ``[low, high] / (1 - γ)``. A target
outside can only be an error of the critic, which would then learn from it (Andrychowicz et al.
2017, app. A). The actor minimises ``-Q(s, π(s)) + c · mean(π(s)²)``: where all actions look alike,
the penalty keeps ``tanh`` out of its flat ends (ibid.).
"""

from __future__ import annotations

__all__ = ["BoundedDDPGLoss", "BoundedTD0", "BoundedTD3Loss"]

from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import DDPGLoss, TD3Loss
from torchrl.objectives.value import TD0Estimator


class BoundedTD0(TD0Estimator):
    """``r + γ V(s')`` without bootstrap where terminated, clamped to what a return can be.

    Args:
        gamma: Discount per step, below 1.
        rewards: Least and greatest reward.
        value_network: As for `TD0Estimator`.
    """

    def __init__(
        self, *, gamma: float, rewards: tuple[float, float], value_network: Any = None
    ) -> None:
        super().__init__(gamma=gamma, value_network=value_network)
        low, high = (reward / (1 - gamma) for reward in rewards)
        # a return of one step only may exceed the bound that holds for ever
        self.bounds = min(low, rewards[0]), max(high, rewards[1])

    def value_estimate(self, *args: Any, **options: Any) -> Tensor:
        """Return the bounded targets, shape ``(*, 1)``."""
        return super().value_estimate(*args, **options).clamp(*self.bounds)


class BoundedDDPGLoss(DDPGLoss):
    """DDPG (Lillicrap et al. 2016): one critic, its target under the target actor.

    Args:
        actor: Reads states, writes ``action`` in [-1, 1].
        critic: Reads the same and ``action``, writes ``state_action_value``.
        gamma: Discount per step.
        rewards: Least and greatest reward.
        action_l2: Weight c of the actor's mean squared action.
    """

    def __init__(
        self,
        actor: TensorDictModule,
        critic: TensorDictModule,
        *,
        gamma: float,
        rewards: tuple[float, float],
        action_l2: float,
    ) -> None:
        super().__init__(actor, critic, loss_function="l2", delay_actor=True, delay_value=True)
        self.action_l2 = action_l2
        estimator = BoundedTD0(gamma=gamma, rewards=rewards, value_network=self.actor_critic)
        self._value_estimator = estimator
        self._forward_value_estimator_keys()

    def critic_loss(self, batch: TensorDictBase) -> Tensor:
        """Return the mean squared error of the critic."""
        return self.loss_value(batch)[0]

    def policy_loss(self, batch: TensorDictBase) -> Tensor:
        """Return the actor's loss."""
        critic = self._cached_detached_value_params
        with self.actor_network_params.to_module(self.actor_network):
            acted = self.actor_network(batch.select(*self.actor_in_keys))
        with critic.to_module(self.value_network):
            value = self.value_network(acted)["state_action_value"]
        return -value.mean() + self.action_l2 * acted["action"].square().mean()


class BoundedTD3Loss(TD3Loss):
    """TD3 (Fujimoto et al. 2018): the lower of two critics, under noisy target actions.

    Its delayed actor is the caller's part: ask for `policy_loss` less often than `critic_loss`.
    Arguments are those of `BoundedDDPGLoss`.
    """

    def __init__(
        self,
        actor: TensorDictModule,
        critic: TensorDictModule,
        *,
        gamma: float,
        rewards: tuple[float, float],
        action_l2: float,
    ) -> None:
        bounds: Any = (-1.0, 1.0)
        super().__init__(actor, critic, bounds=bounds, loss_function="l2")
        self.action_l2 = action_l2
        self._value_estimator = BoundedTD0(gamma=gamma, rewards=rewards)
        self._forward_value_estimator_keys()

    def critic_loss(self, batch: TensorDictBase) -> Tensor:
        """Return the mean squared errors of both critics, added."""
        return self.value_loss(batch)[0]

    def policy_loss(self, batch: TensorDictBase) -> Tensor:
        """Return the actor's loss, by the first critic."""
        critic = self._cached_detach_qvalue_network_params[0]
        with self.actor_network_params.to_module(self.actor_network):
            acted = self.actor_network(batch.select(*self.actor_network.in_keys))
        with critic.to_module(self.qvalue_network):
            value = self.qvalue_network(acted)["state_action_value"]
        return -value.mean() + self.action_l2 * acted["action"].square().mean()
