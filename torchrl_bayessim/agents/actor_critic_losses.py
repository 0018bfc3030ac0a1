"""TorchRL's DDPG and TD3 losses with what goal-reaching needs: bounded targets, small actions.

Where every reward lies in ``[low, high]``, returns lie in ``[low, high] / (1 - γ)``. A target
outside can only be an error of the critic, which would then learn from it (Andrychowicz et al.
2017, app. A). The actor minimises ``-Q(s, π(s)) + c · mean(π(s)²)``: where all actions look alike,
the penalty keeps ``tanh`` out of its flat ends (ibid.).

`critic_loss` gives the numbers of TorchRL's ``loss_value`` and ``value_loss``, `policy_loss` those
of ``loss_actor`` and ``actor_loss`` and the penalty. TorchRL's put the parameters into the networks
and take them out again at every call; here they stay in networks of their own.
"""

from __future__ import annotations

__all__ = ["BoundedDDPGLoss", "BoundedTD0", "BoundedTD3Loss", "SoftUpdateAtOnce"]

import copy
from typing import Any, NamedTuple, TypedDict, Unpack

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.nn.functional import mse_loss
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torchrl.objectives import DDPGLoss, LossModule, SoftUpdate, TD3Loss
from torchrl.objectives.value import TD0Estimator
from torchrl.objectives.value.functional import td0_return_estimate


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

    def bounded(self, after: TensorDictBase, value: Tensor) -> Tensor:
        """Return the same from a batch's ``next`` and ``V(s')``, shape ``(*, 1)``."""
        reward, terminated = after.get("reward"), after.get("terminated")
        return td0_return_estimate(self.gamma, value, reward, terminated).clamp(*self.bounds)


class Limits(TypedDict):
    """What both losses know of the task.

    Attributes:
        gamma: Discount per step.
        rewards: Least and greatest reward.
        action_l2: Weight c of the actor's mean squared action.
    """

    gamma: float
    rewards: tuple[float, float]
    action_l2: float


class _Networks(NamedTuple):
    """Networks that hold a loss's parameters; critics of TD3 hold both and give ``(2, N, 1)``."""

    actor: nn.Module
    critic: nn.Module
    judge: nn.Module  # the critic, or the first of two, as the actor sees it: without gradients
    target_actor: nn.Module
    target_critic: nn.Module


class _Bounded(LossModule):
    """What both losses share."""

    def _limit(self, critic: str, limits: Limits) -> None:
        """Bound targets and actions, and make the networks; ``critic`` is its attribute's name."""
        self.action_l2 = limits["action_l2"]
        self._value_estimator = BoundedTD0(
            gamma=limits["gamma"],
            rewards=limits["rewards"],
            value_network=getattr(self, "actor_critic", None),
        )
        self._forward_value_estimator_keys()
        # asked for by attribute, target parameters warn until someone updates them
        parameters: Any = {
            name: self._modules[f"{name}_params"]
            for name in ("actor_network", "target_actor_network", critic, f"target_{critic}")
        }
        frozen = parameters[critic].detach()
        judge = frozen[0] if frozen.batch_dims else frozen
        # a tuple, so that they are no submodules and no parameter counts twice
        self._networks = _Networks(
            actor=_holding(self.actor_network, parameters["actor_network"]),
            critic=_holding(getattr(self, critic), parameters[critic]),
            judge=_frozen(getattr(self, critic), judge),
            target_actor=_holding(self.actor_network, parameters["target_actor_network"]),
            target_critic=_holding(getattr(self, critic), parameters[f"target_{critic}"]),
        )

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the greatest target."""
        return self._value_estimator.bounds

    def policy_loss(self, batch: TensorDictBase) -> Tensor:
        """Return the actor's loss, by the (first) critic."""
        state = batch.get("state")
        action = self._networks.actor(state)
        value = self._networks.judge(state, action)
        return -value.mean() + self.action_l2 * action.square().mean()


class BoundedDDPGLoss(_Bounded, DDPGLoss):
    """DDPG (Lillicrap et al. 2016): one critic, its target under the target actor.

    Args:
        actor: Reads ``state``, writes ``action`` in [-1, 1].
        critic: Reads both, writes ``state_action_value``.
        limits: See `Limits`.
    """

    def __init__(
        self, actor: TensorDictModule, critic: TensorDictModule, **limits: Unpack[Limits]
    ) -> None:
        super().__init__(actor, critic, loss_function="l2", delay_actor=True, delay_value=True)
        self._limit("value_network", limits)

    def critic_loss(self, batch: TensorDictBase) -> Tensor:
        """Return the mean squared error of the critic."""
        networks, after = self._networks, batch.get("next")
        with torch.no_grad():
            state = after.get("state")
            value = networks.target_critic(state, networks.target_actor(state))
            target = self._value_estimator.bounded(after, value)
        return mse_loss(networks.critic(batch.get("state"), batch.get("action")), target)


class BoundedTD3Loss(_Bounded, TD3Loss):
    """TD3 (Fujimoto et al. 2018): the lower of two critics, under noisy target actions.

    Its delayed actor is the caller's part: ask for `policy_loss` less often than `critic_loss`. So
    is the noise, whose entry holds standard normal numbers of the actions' shape.
    Arguments are those of `BoundedDDPGLoss`.
    """

    def __init__(
        self, actor: TensorDictModule, critic: TensorDictModule, **limits: Unpack[Limits]
    ) -> None:
        bounds: Any = (-1.0, 1.0)
        super().__init__(actor, critic, bounds=bounds, loss_function="l2")
        self._limit("qvalue_network", limits)

    def critic_loss(self, batch: TensorDictBase) -> Tensor:
        """Return the mean squared errors of both critics, added."""
        networks, after, action = self._networks, batch.get("next"), batch.get("action")
        noise = batch.get("noise") * self.policy_noise
        noise = noise.clamp(-self.noise_clip, self.noise_clip)
        with torch.no_grad():
            state = after.get("state")
            following = (networks.target_actor(state) + noise).clamp(-1.0, 1.0)
            value = networks.target_critic(state, following).amin(0)
            target = self._value_estimator.bounded(after, value)
        found = networks.critic(batch.get("state"), action)
        return mse_loss(found, target.expand_as(found), reduction="none").sum(0).mean()


class SoftUpdateAtOnce(SoftUpdate):
    """TorchRL's ``θ' ← (1 - τ) θ' + τ θ``, for all parameters in one call."""

    def __init__(self, loss: LossModule, *, tau: float) -> None:
        super().__init__(loss, tau=tau)
        self._average = get_ema_multi_avg_fn(self.eps)
        sources, targets = self._sources.flatten_keys("."), self._targets.flatten_keys(".")
        pairs = [(targets[f"target_{name}"], source) for name, source in sources.items()]
        self._to, self._from = zip(*((t.data, s.data) for t, s in pairs), strict=True)

    def step(self) -> None:
        """Let the target networks follow."""
        self._average(self._to, self._from, None)


def _holding(network: Any, parameters: TensorDictBase) -> nn.Module:
    """Return a copy of a `TensorDictModule`'s network in which these very parameters are."""
    held = copy.deepcopy(network.module)
    parameters["module"].to_module(held)
    return held


def _frozen(network: Any, parameters: TensorDictBase) -> nn.Module:
    """Return the same without gradients of the parameters, which detached ones still collect."""
    return _holding(network, parameters).requires_grad_(requires_grad=False)
