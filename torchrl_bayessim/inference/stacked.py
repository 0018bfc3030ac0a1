"""Networks of one shape as one: every product of their matrices is one batched product.

On a processor a step of a small network takes as long as its hundred small operations take to be
called. Several networks in one graph call them once.
"""

from __future__ import annotations

__all__ = ["OneNetwork", "StackedNetworks", "alike", "as_one"]

import copy
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from .features import NeuralFeatures, ResidualFeatures
from .mixtures import Mixture
from .network import MixtureDensityNetwork

_OF_LINEAR_LAYERS = ResidualFeatures, NeuralFeatures


def as_one(networks: Sequence[MixtureDensityNetwork]) -> OneNetwork | StackedNetworks:
    """Return what is trained in the place of networks that are :func:`alike`, or of one."""
    return OneNetwork(networks[0]) if len(networks) == 1 else StackedNetworks(networks)


class OneNetwork:
    """One network, of any features, behind what :class:`StackedNetworks` has.

    Args:
        network: Trained in place.
    """

    def __init__(self, network: MixtureDensityNetwork) -> None:
        self._network = network
        self.parameters = list(network.parameters())
        self._kept = copy.deepcopy(network.state_dict())

    def mixture(self, scaled: Tensor) -> Mixture:
        """Return the mixtures for standardised inputs, of shape ``(1, B, L)``."""
        return Mixture(*(part.unsqueeze(0) for part in self._network.mixture(scaled[0])))

    def clip_gradients(self, largest: float) -> None:
        """Scale the gradient down to a norm of at most ``largest``."""
        nn.utils.clip_grad_norm_(self.parameters, largest)

    def zero_gradients(self) -> None:
        """Forget the gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    def keep(self, which: Tensor) -> None:
        """Remember the present state, if ``which``, of shape ``(1,)``, says so."""
        if which:
            self._kept = copy.deepcopy(self._network.state_dict())

    def restore(self) -> None:
        """Go back to the state that was kept last."""
        self._network.load_state_dict(self._kept)


class StackedNetworks:
    """M networks that are :func:`alike`.

    Args:
        networks: Stay as they are until :meth:`restore`.

    Attributes:
        parameters: One tensor, of all parameters that are not frozen, and their gradient, which
            adds up.

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
        self._networks = networks
        self._module = copy.deepcopy(networks[0])
        for name, layer in list(self._module.named_modules()):
            if isinstance(layer, nn.Linear):
                layers = [cast("nn.Linear", n.get_submodule(name)) for n in networks]
                self._module.set_submodule(name, _StackedLinear(layers))
        # one tensor for whoever makes steps, and views of it for the layers
        self._layers = _learned(self._module)
        whole = nn.Parameter(parameters_to_vector(self._layers).detach())
        self.parameters, self._gradient = [whole], torch.zeros_like(whole)
        whole.grad, self._kept = self._gradient, whole.detach().clone()
        vector_to_parameters(whole.data, self._layers)
        for layer, part in zip(self._layers, self._parts(self._gradient), strict=True):
            layer.grad = part.view(layer.shape)

    def _parts(self, values: Tensor) -> list[Tensor]:
        """Return views of all parameters, or of as many values, by layer, ``(M, P_i)`` each."""
        sizes = [layer.numel() for layer in self._layers]
        return [part.view(len(self._networks), -1) for part in values.split(sizes)]

    def mixture(self, scaled: Tensor) -> Mixture:
        """Return the mixtures for standardised inputs, those of each network, ``(M, B, L)``."""
        return self._module.mixture(scaled)

    def clip_gradients(self, largest: float) -> None:
        """Scale the gradient of each network down to a norm of at most ``largest``."""
        if self._gradient.norm() <= largest:  # of all, so none is larger
            return
        parts = self._parts(self._gradient)
        norm = torch.stack([part.square().sum(1) for part in parts]).sum(0).sqrt()
        share = (largest / norm).clamp(max=1.0).unsqueeze(1)
        for part in parts:
            part.mul_(share)

    def zero_gradients(self) -> None:
        """Set the gradients to zero, in place: those of the layers are views."""
        self._gradient.zero_()

    @torch.no_grad()
    def keep(self, which: Tensor) -> None:
        """Remember the present parameters of some networks, ``(M,)`` booleans."""
        here = which.to(self._kept.device)
        parts = self._parts(self.parameters[0]), self._parts(self._kept)
        for now, kept in zip(*parts, strict=True):
            kept[here] = now[here]

    @torch.no_grad()
    def restore(self) -> None:
        """Give each network the parameters that were kept last."""
        for row, network in enumerate(self._networks):
            for layer, part in zip(_learned(network), self._parts(self._kept), strict=True):
                layer.copy_(part[row].view_as(layer))


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
    """Return whether networks differ in the weights of their linear layers only."""
    if any(type(network.features) not in _OF_LINEAR_LAYERS for network in networks):
        return False
    if any(not _of_linear_layers(network) for network in networks):
        return False
    parameters = {id(p) for network in networks for p in network.parameters()}
    if len(parameters) < sum(len(list(network.parameters())) for network in networks):
        return False  # some are shared
    first = _settings(networks[0])
    return all(_settings(network) == first for network in networks)


def _of_linear_layers(network: MixtureDensityNetwork) -> bool:
    """Return whether nothing but linear layers has parameters, buffers or hooks."""
    for module in network.modules():
        plain = type(module) is nn.Linear or module is network
        if not plain and next(module.parameters(recurse=False), None) is not None:
            return False
        if module is not network and next(module.buffers(recurse=False), None) is not None:
            return False
        if module._forward_hooks or module._forward_pre_hooks or module._backward_hooks:
            return False
    return True


def _settings(network: MixtureDensityNetwork) -> tuple[object, ...]:
    layers = [(name, type(module)) for name, module in network.named_modules()]
    parameters = [
        (name, p.shape, p.dtype, p.device, p.requires_grad)
        for name, p in network.named_parameters()
    ]
    inputs = network.shift.tolist(), network.scale.tolist(), network.compress
    mixtures = network.covariance, network.components, network.reach
    return type(network), mixtures, inputs, layers, parameters
