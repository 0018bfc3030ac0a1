"""Actor and critic for goals: what they see, normalised once, and the actor as a policy."""

from __future__ import annotations

__all__ = ["GOAL_KEYS", "Actor", "Critic", "GoalState", "action_bounds", "goal_policy"]

from collections.abc import Sequence
from contextlib import nullcontext
from functools import lru_cache
from itertools import pairwise
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs import EnvBase
from torchrl.modules import AdditiveGaussianModule, EGreedyModule

from ..errors import message
from .networks import width
from .normalizer import Normalizer

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
"""What a goal environment observes."""


class GoalState(nn.Module):
    """The networks' input: observation and desired goal, then what only the critic sees.

    Statistics and bounds are those of Plappert et al. (2018): standard deviations of at least
    0.01, normalised values within ±5.

    Args:
        env: Its observation spec gives the widths.
        critic_keys: What only the critic sees.

    Raises:
        ValueError: The environment has no goals, or does not observe one of ``critic_keys``.
    """

    def __init__(self, env: EnvBase, critic_keys: Sequence[str]) -> None:
        super().__init__()
        known = list(env.observation_spec.keys(include_nested=True, leaves_only=True))
        missing = [key for key in GOAL_KEYS if key not in known]
        if missing:
            raise ValueError(
                message(
                    f"a goal environment, which observes {', '.join(GOAL_KEYS)}",
                    f"none of {missing}",
                    available=known,
                )
            )
        self.keys = ("observation", "desired_goal")
        self.critic_keys = tuple(critic_keys)
        self.seen = width(env, self.keys)
        self.normalizer = Normalizer(self.seen, clip=5.0, least_std=0.01)
        self.hidden_width = width(env, critic_keys)
        self.critic_normalizer = Normalizer(self.hidden_width, clip=5.0)

    def forward(self, observation: Tensor, desired_goal: Tensor) -> Tensor:
        """Return what the actor sees, shape ``(*, S)``."""
        return self.normalizer(torch.cat([observation, desired_goal], -1))

    def full(self, steps: TensorDictBase) -> Tensor:
        """Return what the critic sees, shape ``(*, S + C)``; the actor's part comes first."""
        seen = self(*(steps.get(key) for key in self.keys))
        if not self.critic_keys:
            return seen
        hidden = torch.cat([steps.get(key) for key in self.critic_keys], -1)
        return torch.cat([seen, self.critic_normalizer(hidden)], -1)

    def observe(self, episodes: TensorDictBase) -> None:
        """Take episodes into the statistics, with the goals that they had and that they reached."""
        for goal in (episodes["desired_goal"], episodes["next", "achieved_goal"]):
            self.normalizer.observe(torch.cat([episodes["observation"], goal], -1))
        if self.critic_keys:
            hidden = torch.cat([episodes.get(key) for key in self.critic_keys], -1)
            self.critic_normalizer.observe(hidden)


class Actor(nn.Module):
    """``tanh`` of a ReLU network of the first ``inputs`` entries of the state: in [-1, 1]."""

    def __init__(self, inputs: int, hidden: Sequence[int], outputs: int) -> None:
        super().__init__()
        self.inputs = inputs
        self.layers = _relu_network(inputs, hidden, outputs)

    def forward(self, state: Tensor) -> Tensor:
        """Return actions in [-1, 1], shape ``(*, A)``."""
        return self.layers(state[..., : self.inputs]).tanh()


class Critic(nn.Module):
    """A ReLU network of the whole state and the action in [-1, 1].

    With the parameters of K critics stacked, as TorchRL's TD3 has them, it gives ``(K, N, 1)``.
    """

    def __init__(self, inputs: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.layers = _relu_network(inputs, hidden, 1)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the value, shape ``(*, 1)``."""
        return self.layers(torch.cat([state, action], -1))


class _Scaled(nn.Module):
    """The actor behind its normalised inputs and before the action's bounds."""

    low: Tensor
    high: Tensor

    def __init__(self, state: GoalState, actor: Actor, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.state, self.actor = state, actor
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def forward(self, observation: Tensor, desired_goal: Tensor) -> Tensor:
        unit = self.actor(self.state(observation, desired_goal))
        return self.low + (unit + 1) / 2 * (self.high - self.low)


class _Acting(TensorDictModuleBase):
    """Writes what a network makes of the actor's input.

    `TensorDictModule` asks at every call what kind of thing it is given, for as long as the actor
    takes.
    """

    def __init__(self, module: _Scaled) -> None:
        super().__init__()
        self.module = module
        self.in_keys, self.out_keys = list(module.state.keys), ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen: list[Tensor] = [tensordict[key] for key in self.in_keys]
        return tensordict.set("action", self.module(*seen))


def goal_policy(
    env: EnvBase, state: GoalState, actor: Actor, *, noise: float, random_share: float
) -> TensorDictSequential:
    """Return the actor as a policy in the action's own units, with exploration.

    Args:
        env: Its action spec gives the bounds.
        state: The actor's input.
        actor: In [-1, 1].
        noise: Standard deviation of Gaussian noise, in units of half the action range.
        random_share: Share of uniform actions.
    """
    spec, (low, high) = env.action_spec_unbatched, action_bounds(env)
    network = _Scaled(state, actor, low, high)
    half: Any = ((high - low) / 2).tolist()  # of one environment
    gaussian = AdditiveGaussianModule(spec, sigma_init=noise, sigma_end=noise, std=half)
    uniform = EGreedyModule(spec, eps_init=random_share, eps_end=random_share)
    parts: list[Any] = [_Acting(network), gaussian, uniform]
    return TensorDictSequential(*parts)


def action_bounds(env: EnvBase) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest action of one environment, shape ``(A,)`` each.

    Raises:
        TypeError: The actions are not bounded.
    """
    spec = env.action_spec_unbatched
    if not isinstance(spec, Bounded):
        raise TypeError(message("a bounded action spec", type(spec).__name__))
    return spec.low, spec.high


class _Linear(nn.Linear):
    """A linear layer, or several of them where weights have the shape ``(K, D', D)``."""

    def forward(self, x: Tensor) -> Tensor:
        if self.weight.ndim == 2:
            return super().forward(x)
        rows = x.expand(len(self.weight), *x.shape[-2:])
        return torch.baddbmm(self.bias.unsqueeze(-2), rows, self.weight.mT)


class _ReLUNetwork(nn.Sequential):
    """Linear layers with ReLU between.

    Under ``torch.set_float32_matmul_precision("medium")`` hidden layers are in bfloat16, where the
    processor multiplies such numbers: half the time of products that only round what they read.
    Values come from a last layer in single precision.
    """

    def forward(self, x: Tensor) -> Tensor:
        *hidden, last = self
        dtype = x.dtype
        medium = torch.get_float32_matmul_precision() == "medium"
        short = medium and dtype == torch.float32 and x.device.type == "cpu"
        with torch.autocast("cpu", torch.bfloat16) if short and _multiplies() else nullcontext():
            for layer in hidden:
                x = layer(x)
        return last(x.to(dtype))


@lru_cache
def _multiplies() -> bool:
    """Return whether this processor multiplies numbers in bfloat16."""
    known = getattr(torch.cpu, "get_capabilities", dict)()  # torch 2.11 has none
    return any(known.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def _relu_network(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Return a network with Glorot's initial weights, and biases of zero."""
    widths = [inputs, *hidden, outputs]
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layer = _Linear(before, after)
        nn.init.xavier_uniform_(layer.weight)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.ReLU()]
    return _ReLUNetwork(*layers[:-1])
