"""A learner's networks: normalised inputs, and the distribution that the action spec asks for."""

from __future__ import annotations

__all__ = ["MLP", "actor", "width"]

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import InteractionType, TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical, OneHot, Unbounded
from torchrl.data.tensor_specs import TensorSpec
from torchrl.envs import EnvBase
from torchrl.modules import IndependentNormal, OneHotCategorical, ProbabilisticActor, TanhNormal

from ..errors import message
from .normalizer import Normalizer


class MLP(nn.Module):
    """Normalised inputs, tanh layers, a linear head; orthogonal initial weights."""

    def __init__(self, inputs: int, hidden: Sequence[int], outputs: int, *, gain: float) -> None:
        super().__init__()
        self.normalizer = Normalizer(inputs)
        layers: list[nn.Module] = []
        for width in hidden:
            layers += [_linear(inputs, width, math.sqrt(2)), nn.Tanh()]
            inputs = width
        self.layers = nn.Sequential(*layers, _linear(inputs, outputs, gain))

    def forward(self, *inputs: Tensor) -> Tensor:
        """Concatenate ``inputs`` of shapes ``(*, D_i)`` and return ``(*, outputs)``."""
        return self.layers(self.normalizer(torch.cat(inputs, -1)))


class _Gaussian(nn.Module):
    """Location from a network, scale from a free parameter."""

    def __init__(self, network: nn.Module, size: int, initial_std: float) -> None:
        super().__init__()
        self.network = network
        self.log_scale = nn.Parameter(torch.full((size,), math.log(initial_std)))

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        loc = self.network(*inputs)
        return loc, self.log_scale.exp().expand_as(loc)


class _OneHotCategorical(OneHotCategorical):
    """TorchRL's, except that a tie has one winner: there, the mode has a one for each."""

    @property
    def mode(self) -> Tensor:
        return nn.functional.one_hot(self.logits.argmax(-1), self.logits.shape[-1])

    @property
    def deterministic_sample(self) -> Tensor:
        return self.mode


def _linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def width(env: EnvBase, keys: Sequence[str]) -> int:
    """Return how many numbers the observations ``keys`` hold together.

    Raises:
        ValueError: The environment does not observe one of them.
    """
    available = list(env.observation_spec.keys(include_nested=True, leaves_only=True))
    for key in keys:
        if key not in available:
            raise ValueError(message("an observation of the environment", key, available=available))
    return sum(env.observation_spec[key].shape[-1] for key in keys)


def actor(
    env: EnvBase, keys: list[Any], *, hidden: Sequence[int], initial_std: float
) -> ProbabilisticActor:
    """Return a stochastic policy that samples unless `set_exploration_type` says otherwise.

    Args:
        env: Its action spec decides on the distribution: one-hot or index categorical, a Gaussian
            squashed into the bounds, or a Gaussian.
        keys: The observations that it reads.
        hidden: Width of each hidden layer.
        initial_std: Standard deviation of the Gaussians at the start, before squashing.

    Raises:
        TypeError: An action spec of another kind.
    """
    spec: TensorSpec = env.action_spec_unbatched
    inputs = width(env, keys)
    options: dict[str, Any] = {}
    if type(spec) in (OneHot, Categorical):  # not their product spaces, which are subclasses
        distribution = (
            _OneHotCategorical if isinstance(spec, OneHot) else torch.distributions.Categorical
        )
        module = MLP(inputs, hidden, spec.n, gain=0.01)
        parameters: list[Any] = ["logits"]
    elif isinstance(spec, Bounded | Unbounded):
        size = spec.shape[-1]
        network = MLP(inputs, hidden, size, gain=0.01)
        module, parameters = _Gaussian(network, size, initial_std), ["loc", "scale"]
        distribution = IndependentNormal
        if isinstance(spec, Bounded):
            distribution = TanhNormal
            options = {"low": spec.low, "high": spec.high, "tanh_loc": False}
    else:
        raise TypeError(
            message("a discrete, bounded or unbounded action spec", type(spec).__name__)
        )
    return ProbabilisticActor(
        TensorDictModule(module, in_keys=keys, out_keys=parameters),
        in_keys=parameters,
        distribution_class=distribution,
        distribution_kwargs=options,
        return_log_prob=True,
        default_interaction_type=InteractionType.RANDOM,
    )
