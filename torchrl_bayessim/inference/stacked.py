"""Networks of one shape as one: every product of their matrices is one batched product.

On a processor a step of a small network takes as long as its hundred small operations take to be
called. Several networks at once call them once, and their gradient is worked out by hand, because
to record and replay a graph takes as long again.
"""

from __future__ import annotations

__all__ = ["OneNetwork", "StackedNetworks", "alike", "as_one"]

import copy
from collections.abc import Iterator, Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from ..errors import message
from .features import NeuralFeatures, ResidualFeatures
from .network import MixtureDensityNetwork


def as_one(networks: Sequence[MixtureDensityNetwork]) -> OneNetwork | StackedNetworks:
    """Return what is trained in the place of networks: several are :func:`alike`."""
    if alike(networks):
        return StackedNetworks(networks)
    (network,) = networks
    return OneNetwork(network)


class OneNetwork:
    """One network, of any features, behind what :class:`StackedNetworks` has.

    Args:
        network: Trained in place.

    Raises:
        ValueError: All of it is frozen.
    """

    def __init__(self, network: MixtureDensityNetwork) -> None:
        if not any(parameter.requires_grad for parameter in network.parameters()):
            expected = "a network with parameters that are to be learned"
            raise ValueError(message(expected, "all frozen", hint="requires_grad_() on some"))
        self._network = network
        self.parameters = list(network.parameters())
        self._raw = torch.zeros(())
        self._kept = copy.deepcopy(network.state_dict())

    def raw(self, scaled: Tensor) -> Tensor:
        """Return the last layer's values for standardised inputs ``(1, B, L)``, ``(1, B, P)``."""
        self._raw = self._network.raw(scaled[0])
        return self._raw.detach().unsqueeze(0)

    def backpropagate(self, gradient: Tensor) -> None:
        """Set the parameters' gradients from the one by what :meth:`raw` returned last."""
        self._network.zero_grad()
        self._raw.backward(gradient[0].to(self._raw))

    def clip_gradients(self, largest: float) -> None:
        """Scale the gradient down to a norm of at most ``largest``."""
        nn.utils.clip_grad_norm_(self.parameters, largest)

    def keep(self, which: Tensor) -> None:
        """Remember the present state, if ``which``, of shape ``(1,)``, says so."""
        if which:
            self._kept = copy.deepcopy(self._network.state_dict())

    def restore(self) -> None:
        """Go back to the state that was kept last, without gradients."""
        self._network.load_state_dict(self._kept)
        self._network.zero_grad()


class StackedNetworks:
    """M networks that are :func:`alike`.

    Args:
        networks: Stay as they are until :meth:`restore`.

    Attributes:
        parameters: One tensor ``(M, P)``, of all parameters that are not frozen.
        gradient: By it, of the same shape.

    Example:
        >>> one, other = (
        ...     MixtureDensityNetwork(ResidualFeatures(3, seed=seed), 2, components=4,
        ...                           covariance="full", reach=1.7, seed=seed)
        ...     for seed in (0, 1)
        ... )
        >>> x = torch.ones(2, 5, 3)
        >>> together = StackedNetworks([one, other]).raw(x)
        >>> torch.allclose(together[1], other.raw(x[1]), atol=1e-6)
        True
    """

    def __init__(self, networks: Sequence[MixtureDensityNetwork]) -> None:
        self._networks = networks
        self._residual = isinstance(networks[0].features, ResidualFeatures)
        # one tensor for whoever makes steps, and views of it for the layers
        flat = [torch.cat([p.reshape(-1) for p in _learned(network)]) for network in networks]
        self.parameters = torch.stack(flat).detach()
        self.gradient = torch.zeros_like(self.parameters)
        self._kept = self.parameters.clone()
        self._sizes = [parameter.numel() for parameter in _learned(networks[0])]
        parts = (values.split(self._sizes, 1) for values in (self.parameters, self.gradient))
        views = zip(*parts, strict=True)
        *self._hidden, self._head = (
            _StackedLinear(
                *(_Stacked([getattr(l, name) for l in layers], views) for name in _OF_LAYER)
            )
            for layers in zip(*map(_layers, networks), strict=True)
        )

    def raw(self, scaled: Tensor) -> Tensor:
        """Return the last layers' values for standardised inputs ``(M, B, L)``, ``(M, B, P)``."""
        hidden = scaled
        for i, layer in enumerate(self._hidden):
            before, hidden = hidden, silu(layer(hidden))
            if i and self._residual:
                hidden = before + hidden
        return self._head(hidden)

    def backpropagate(self, gradient: Tensor) -> None:
        """Set the parameters' gradient from the one by what :meth:`raw` returned last."""
        hidden = self._head.backward(gradient.to(self.gradient))
        for i in reversed(range(len(self._hidden))):
            layer = self._hidden[i]
            after, hidden = hidden, layer.backward(_silu_backward(hidden, layer.values), last=not i)
            if i and self._residual:
                hidden += after

    def clip_gradients(self, largest: float) -> None:
        """Scale the gradient of each network down to a norm of at most ``largest``."""
        norm = torch.linalg.vector_norm(self.gradient, dim=1, keepdim=True)
        if not (norm <= largest).all():  # rare, and cheaper asked than done
            self.gradient.mul_((largest / norm).clamp(max=1.0))

    @torch.no_grad()
    def keep(self, which: Tensor) -> None:
        """Remember the present parameters of some networks, ``(M,)`` booleans."""
        here = which.to(self._kept.device)
        self._kept[here] = self.parameters[here]

    @torch.no_grad()
    def restore(self) -> None:
        """Give each network the parameters that were kept last."""
        for kept, network in zip(self._kept, self._networks, strict=True):
            parts = kept.split(self._sizes)
            for parameter, part in zip(_learned(network), parts, strict=True):
                parameter.copy_(part.view_as(parameter))


class _Stacked:
    """One parameter of M layers: the next views of all, or a copy without gradient if frozen."""

    def __init__(
        self, parameters: Sequence[nn.Parameter], views: Iterator[tuple[Tensor, Tensor]]
    ) -> None:
        shape = (len(parameters), *parameters[0].shape)
        self.gradient: Tensor | None = None
        if parameters[0].requires_grad:
            value, gradient = next(views)
            self.value, self.gradient = value.view(shape), gradient.view(shape)
        else:
            self.value = torch.stack([parameter.detach() for parameter in parameters])


class _StackedLinear:
    """M linear layers; ``values`` are what they returned last."""

    def __init__(self, weight: _Stacked, bias: _Stacked) -> None:
        self._weight, self._by_weight, self._by_bias = weight.value, weight.gradient, bias.gradient
        self._turned, self._bias = weight.value.mT, bias.value.unsqueeze(1)
        self._inputs = self.values = weight.value

    def __call__(self, inputs: Tensor) -> Tensor:
        self._inputs = inputs
        self.values = torch.baddbmm(self._bias, inputs, self._turned)
        return self.values

    def backward(self, gradient: Tensor, *, last: bool = False) -> Tensor:
        """Set the gradients from the one by the values, and return that by the inputs."""
        if self._by_weight is not None:
            torch.bmm(gradient.mT, self._inputs, out=self._by_weight)
        if self._by_bias is not None:
            torch.sum(gradient, 1, out=self._by_bias)
        return gradient if last else torch.bmm(gradient, self._weight)


_OF_LAYER = "weight", "bias"
_silu_backward = torch.ops.aten.silu_backward  # what autograd calls


def _layers(network: MixtureDensityNetwork) -> list[nn.Linear]:
    """Return the linear layers, the head last, of a network that has no others.

    Empty if it is anything else than a chain of them, each with SiLU behind it but the last.
    """
    features = network.features
    if type(features) is ResidualFeatures:
        hidden = [features.first, *cast("nn.ModuleList", features.blocks)]
    elif type(features) is NeuralFeatures:
        chain = list(cast("nn.Sequential", features.layers))
        hidden, between = chain[::2], chain[1::2]
        if len(between) < len(hidden) or any(type(layer) is not nn.SiLU for layer in between):
            return []
    else:
        return []
    layers = [layer for layer in [*hidden, network.head] if type(layer) is nn.Linear]
    whole = len(layers) == len(hidden) + 1 and all(layer.bias is not None for layer in layers)
    return layers if whole else []


def _learned(network: MixtureDensityNetwork) -> list[nn.Parameter]:
    named = (getattr(layer, name) for layer in _layers(network) for name in _OF_LAYER)
    return [parameter for parameter in named if parameter.requires_grad]


def alike(networks: Sequence[MixtureDensityNetwork]) -> bool:
    """Return whether networks differ in the weights of their linear layers only.

    They are chains of linear layers with SiLU between them, as the default ones, and nothing in
    them has code of its own.
    """
    chains = [_layers(network) for network in networks]
    parameters = [p for chain in chains for layer in chain for p in (layer.weight, layer.bias)]
    if not all(chains) or not any(parameter.requires_grad for parameter in parameters):
        return False
    if any(type(network) is not MixtureDensityNetwork or _hooked(network) for network in networks):
        return False
    if len({parameter.data_ptr() for parameter in parameters}) < len(parameters):
        return False  # some are shared
    first = _settings(networks[0])
    return all(_settings(network) == first for network in networks)


def _hooked(network: MixtureDensityNetwork) -> bool:
    """Return whether something wants to know of a pass, or changes it: none by hand would tell."""
    if any("forward" in vars(module) for module in network.modules()):
        return True
    on_modules = (
        hooks
        for module in network.modules()
        for hooks in (
            module._forward_hooks,
            module._forward_pre_hooks,
            module._backward_hooks,
            module._backward_pre_hooks,
        )
    )
    on_parameters = (
        hooks
        for parameter in network.parameters()
        for hooks in (parameter._backward_hooks, parameter._post_accumulate_grad_hooks)
    )
    return any(on_modules) or any(on_parameters)


def _settings(network: MixtureDensityNetwork) -> tuple[object, ...]:
    layers = [(name, type(module)) for name, module in network.named_modules()]
    parameters = [
        (name, p.shape, p.dtype, p.device, p.requires_grad)
        for name, p in network.named_parameters()
    ]
    inputs = network.shift.tolist(), network.scale.tolist(), network.compress
    mixtures = network.covariance, network.components, network.reach
    return mixtures, inputs, layers, parameters
