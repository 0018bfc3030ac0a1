"""Networks of one shape as one: every product of their matrices is one batched product.

On a processor a step of a small network takes as long as its hundred small operations take to be
called. Several networks in one graph call them once.
"""

from __future__ import annotations

__all__ = ["StackedNetworks", "alike"]

import copy
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from .features import NeuralFeatures, ResidualFeatures
from .mixtures import Mixture
from .network import MixtureDensityNetwork

_OF_LINEAR_LAYERS = ResidualFeatures, NeuralFeatures  # and of nothing else with parameters


class StackedNetworks:
    """M networks that are :func:`alike`, or a single one of any kind.

    Args:
        networks: Stay as they are until :meth:`write`.

    Attributes:
        parameters: All parameters that are not frozen, in a row, and their gradient, which adds up
            until it is set to zero.

    Example:
        >>> one, other = (
        ...     MixtureDensityNetwork(ResidualFeatures(3, seed=seed), 2, components=4,
        ...                           covariance="full", reach=1.7, seed=seed)
        ...     for seed in (0, 1)
        ... )
        >>> x = torch.ones(2, 5, 3)
        >>> together = StackedNetworks([one, other]).mixture(x)
        >>> torch.allclose(together.loc[1], other.mixture(x[1]).loc, atol=1e-6)
        True
    """

    def __init__(self, networks: Sequence[MixtureDensityNetwork]) -> None:
        self._networks, self._size = networks, len(networks)
        self._module = copy.deepcopy(networks[0])
        if self._size > 1:
            for name, layer in list(self._module.named_modules()):
                if isinstance(layer, nn.Linear):
                    layers = [cast("nn.Linear", n.get_submodule(name)) for n in networks]
                    self._module.set_submodule(name, _StackedLinear(layers))
        # one tensor for whoever makes steps, and views of it for the layers
        self._layers = _learned(self._module)
        self.parameters = nn.Parameter(parameters_to_vector(self._layers).detach())
        self.parameters.grad = torch.zeros_like(self.parameters)
        vector_to_parameters(self.parameters.data, self._layers)
        for layer, part in zip(self._layers, self._parts(self.parameters.grad), strict=True):
            layer.grad = part.view(layer.shape)

    def _parts(self, values: Tensor) -> list[Tensor]:
        """Return views of all parameters, or of as many values, by layer, ``(M, P_i)`` each."""
        sizes = [layer.numel() for layer in self._layers]
        return [part.view(self._size, -1) for part in values.split(sizes)]

    def mixture(self, scaled: Tensor) -> Mixture:
        """Return the mixtures for standardised inputs, those of each network, ``(M, B, L)``."""
        if self._size == 1:
            return Mixture(*(part.unsqueeze(0) for part in self._module.mixture(scaled[0])))
        return self._module.mixture(scaled)

    def clip_gradients(self, largest: float) -> None:
        """Scale the gradient of each network down to a norm of at most ``largest``."""
        gradient = cast("Tensor", self.parameters.grad)
        if gradient.norm() <= largest:  # of all, so none is larger
            return
        parts = self._parts(gradient)
        norm = torch.stack([part.square().sum(1) for part in parts]).sum(0).sqrt()
        share = (largest / norm).clamp(max=1.0).unsqueeze(1)
        for part in parts:
            part.mul_(share)

    @torch.no_grad()
    def copy_into(self, kept: Tensor, which: Tensor) -> None:
        """Copy the parameters of some networks, ``(M,)`` booleans, into others like them."""
        for mine, other in zip(self._parts(self.parameters), self._parts(kept), strict=True):
            other[which] = mine[which]

    @torch.no_grad()
    def write(self, values: Tensor) -> None:
        """Give the networks these values of all parameters."""
        for row, network in enumerate(self._networks):
            for layer, part in zip(_learned(network), self._parts(values), strict=True):
                layer.copy_(part[row].view_as(layer))
        if self._size == 1:  # features of one's own may have learned some, as batch norms do
            for own, learned in zip(
                self._networks[0].buffers(), self._module.buffers(), strict=True
            ):
                own.copy_(learned)


def _learned(module: nn.Module) -> list[nn.Parameter]:
    return [parameter for parameter in module.parameters() if parameter.requires_grad]


class _StackedLinear(nn.Module):
    def __init__(self, layers: Sequence[nn.Linear]) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.stack([layer.weight.detach() for layer in layers]))
        self.bias = nn.Parameter(torch.stack([layer.bias.detach() for layer in layers]))
        for mine, its in ((self.weight, layers[0].weight), (self.bias, layers[0].bias)):
            mine.requires_grad_(its.requires_grad)

    def forward(self, x: Tensor) -> Tensor:
        return torch.baddbmm(self.bias.unsqueeze(1), x, self.weight.mT)


def alike(networks: Sequence[MixtureDensityNetwork]) -> bool:
    """Return whether networks differ in their parameters only, and can be stacked."""
    first = networks[0]
    if any(type(network.features) not in _OF_LINEAR_LAYERS for network in networks):
        return False
    return all(_settings(network) == _settings(first) for network in networks)


def _settings(network: MixtureDensityNetwork) -> tuple[object, ...]:
    shapes = [(name, tuple(p.shape), p.requires_grad) for name, p in network.named_parameters()]
    inputs = network.shift.tolist(), network.scale.tolist(), network.compress
    return type(network), network.covariance, network.components, network.reach, inputs, shapes
