"""The mixture density network: summary statistics to the parameters of a Gaussian mixture."""

from __future__ import annotations

__all__ = [
    "Components",
    "Covariance",
    "MixtureDensityNetwork",
    "factor",
    "heavy_tailed",
    "melu",
    "widened",
]

import math
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from ..counts import check_count
from ..errors import message
from ..kinds import check_choice
from .features import Features
from .input_scaling import InputScaling, input_scaling
from .mixtures import Mixture

Covariance = Literal["diagonal", "full"]
WIDEST = 4.0  # of a component, in prior deviations: nearly flat over a box, which spans 3.5
STEEPEST = 100.0  # ratio of a marginal to a conditional deviation
LINEAR = 3.0  # deviations within which compression changes little
_FARTHEST = 1e6  # deviations of an input: one far out says no more than that
# what saved networks without do
_OF_BEFORE = {"contrast": 1.0, "apart": 1.0, "shared": 0.0, "shared_at_edges": 0.0}
_WIDER = 0.2  # weight of the wider of two components that stand for one
FLOOR = 1e-8  # of a variance, in standardised coordinates: a deviation of 1e-4 prior deviations


def melu(z: Tensor) -> Tensor:
    r"""The paper's modified ELU, :math:`e^z` for :math:`z < 0` and :math:`z + 1` above: a variance.

    The paper's constant alpha must be 1: smaller leaves a floor of 1 - alpha, larger allows
    negative variances. Computed without the cancellation of ``elu(z) + 1``, which is exactly 0 in
    float32 below z = -16.

    Example:
        >>> melu(torch.tensor([-40.0, 0.0, 2.0])) > 0
        tensor([True, True, True])
    """
    return z.clamp(max=0.0).exp() + z.relu() + FLOOR


class Components(NamedTuple):
    """What a network says of a mixture, before :func:`widened` makes the mixture of it.

    Attributes:
        logits: Log-weights, shape ``(*, K)``.
        loc: Means, shape ``(*, K, D)``.
        deviation: Marginal deviations, not yet bounded, shape ``(*, K, D)``.
        slope: Of :func:`factor`, shape ``(*, K, D (D - 1) / 2)``, or ``(*, K, 0)`` without
            correlations.
    """

    logits: Tensor
    loc: Tensor
    deviation: Tensor
    slope: Tensor


class MixtureDensityNetwork(nn.Module):
    """Summary statistics to mixture parameters in standardised coordinates.

    Args:
        features: Of the summaries.
        parameters: Number D of physics parameters.
        components: Number K of mixture components.
        covariance: ``"diagonal"`` as in the paper, or ``"full"``.
        reach: Means stay within so many prior deviations: inside the box if there is one, because
            the mass of a correlated component far outside cannot be integrated faithfully.
        compress: Whether heavy tails of the standardised summaries are compressed, by asinh.
    """

    shift: Tensor
    scale: Tensor
    widening: Tensor  # factor on each parameter's deviations that a fit ends with, shape (D,)
    contrast: Tensor  # power to which they are raised before that, shape (D,)
    tails: Tensor  # logarithm of the ratio of :func:`heavy_tailed`, shape (1,), or (0,) for none
    apart: Tensor  # share of its distance from the mean of an average that is left there, (D,)
    shared: Tensor  # of what answers leave open, the share that trajectories leave together, (D,)
    shared_at_edges: Tensor  # the same near the edges of a box

    def __init__(
        self,
        features: Features,
        parameters: int,
        *,
        components: int,
        covariance: Covariance,
        reach: float,
        compress: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_choice("a covariance structure", covariance, ["diagonal", "full"])
        check_count("components", components)
        self.features = features
        self.parameters_, self.components, self.covariance = parameters, components, covariance
        self.reach, self.compress = reach, compress
        lower = parameters * (parameters - 1) // 2 if covariance == "full" else 0
        self.sizes = [components, components * parameters, components * parameters]
        self.sizes.append(components * lower)
        with torch.random.fork_rng(devices=[]):
            torch.random.default_generator.manual_seed(seed)
            self.head = nn.Linear(features.out_features, sum(self.sizes))
        start = torch.quasirandom.SobolEngine(parameters, scramble=True, seed=seed)
        with torch.no_grad():
            self.head.weight.mul_(0.1)
            self.head.bias.zero_()
            loc = self.head.bias.split(self.sizes)[1]
            loc.copy_((1.2 * (2 * start.draw(components) - 1)).flatten())
        self.register_buffer("shift", torch.zeros(features.dim))
        self.register_buffer("scale", torch.ones(features.dim))
        self.register_buffer("widening", torch.ones(parameters))
        self.register_buffer("contrast", torch.ones(parameters))
        self.register_buffer("tails", torch.zeros(0))
        self.register_buffer("apart", torch.ones(parameters))
        self.register_buffer("shared", torch.zeros(parameters))
        self.register_buffer("shared_at_edges", torch.zeros(parameters))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        widening = state_dict.get(f"{prefix}widening")
        if widening is not None:
            if not widening.ndim:  # of before: one factor for all parameters
                widening = state_dict[f"{prefix}widening"] = widening.expand_as(self.widening)
            for name, value in _OF_BEFORE.items():
                state_dict.setdefault(f"{prefix}{name}", torch.full_like(widening, value))
            tails = state_dict.setdefault(f"{prefix}tails", widening.new_zeros(0))
            self.tails = self.tails.new_zeros(len(tails))
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take a pickled network; those of before lack some of its scales and shares."""
        super().__setstate__(state)
        for name, value in _OF_BEFORE.items():
            if name not in self._buffers:
                self.register_buffer(name, torch.full_like(self.widening, value))
        if "tails" not in self._buffers:
            self.register_buffer("tails", self.widening.new_zeros(0))

    def standardize_inputs(self, summaries: Tensor | Iterable[Tensor]) -> InputScaling:
        """Set the input scaling from training summaries ``(N, L)``, or from parts of them.

        Constant ones are ignored; see :mod:`.input_scaling` for those of absurd rows.
        """
        found = input_scaling([summaries] if isinstance(summaries, Tensor) else summaries)
        self.set_inputs(found)
        return found

    def set_inputs(self, scaling: InputScaling) -> None:
        """Set the input scaling to one that was found."""
        self.shift.copy_(scaling.shift)
        self.scale.copy_(scaling.scale)

    def scaled(self, summary: Tensor) -> Tensor:
        """Return the standardised inputs of the features."""
        if summary.shape[-1:] != self.shift.shape:
            raise ValueError(
                message(f"summaries of shape (*, {len(self.shift)})", tuple(summary.shape))
            )
        scaled = ((summary - self.shift) / self.scale).clamp(-_FARTHEST, _FARTHEST)
        if self.compress:
            scaled = LINEAR * (scaled / LINEAR).asinh()
        return scaled.to(self.shift.dtype)

    def forward(self, summary: Tensor) -> Mixture:
        """Return the mixture for summaries ``(*, L)``."""
        raw = self.raw(self.scaled(summary))
        return widened(self.components_of(raw), self.widening, self.contrast, self.tails)

    def raw(self, scaled: Tensor) -> Tensor:
        """Return the last layer's values for what :meth:`scaled` made of summaries, ``(*, L)``.

        :meth:`components_of` says what they mean.
        """
        return self.head(self.features(scaled))

    def components_of(self, raw: Tensor) -> Components:
        """Return what :meth:`raw` values ``(*, P)`` mean."""
        logits, loc, diagonal, slope = raw.split(self.sizes, -1)
        each = (*raw.shape[:-1], self.components)
        loc = self.reach * torch.tanh(loc.reshape(*each, self.parameters_) / self.reach)
        deviation = melu(diagonal.reshape(*each, self.parameters_)).sqrt()
        slope = slope.reshape(*each, self.sizes[-1] // self.components)
        return Components(logits, loc, deviation, STEEPEST * torch.tanh(slope / STEEPEST))


def widened(components: Components, widening: Tensor, contrast: Tensor, tails: Tensor) -> Mixture:
    """Return a mixture, wider or narrower than the network said, or of heavier tails.

    Args:
        components: As the network said.
        widening: Factor on each parameter's deviations, shape ``(D,)``.
        contrast: Power to which they are raised before, in prior deviations, shape ``(D,)``.
        tails: Logarithm of the ratio of :func:`heavy_tailed`, shape ``(1,)``; ``(0,)`` leaves
            Gaussian components.

    Example:
        >>> one, none = torch.ones(1), torch.zeros(0)
        >>> said = Components(one, one[None], one[None], none[None])
        >>> widened(said, 0.5 * one, one, none).scale_tril.flatten()
        tensor([0.4974])
    """
    logits, loc, deviation, slope = components
    deviation = widening * deviation**contrast
    if len(tails):
        logits, deviation = heavy_tailed(logits, deviation, tails.exp())
        loc, slope = torch.cat([loc, loc], -2), torch.cat([slope, slope], -2)
    deviation = deviation.clamp(min=FLOOR**0.5)
    deviation = WIDEST * torch.tanh(deviation / WIDEST)
    return Mixture(logits, loc, factor(deviation, slope))


def heavy_tailed(logits: Tensor, deviation: Tensor, ratio: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return two components for each, of the same means and the same variance together.

    .. math::
        N(\mu, \sigma^2) \to (1 - w)\, N(\mu, a^2 \sigma^2) + w\, N(\mu, a^2 r^2 \sigma^2),
        \quad a^2 (1 - w + w r^2) = 1,

    with w = 0.2: a narrower middle and heavier tails the larger the ratio r is than 1.

    Args:
        logits: Shape ``(*, K)``.
        deviation: Shape ``(*, K, D)``.
        ratio: r, shape ``()`` or ``(1,)``.

    Returns:
        Logits ``(*, 2 K)`` and deviations ``(*, 2 K, D)``, the narrow ones first.

    Example:
        >>> logits, deviation = heavy_tailed(torch.zeros(1), torch.ones(1, 1), torch.tensor(2.0))
        >>> deviation.flatten()
        tensor([0.7906, 1.5811])
        >>> logits.exp()
        tensor([0.8000, 0.2000])
    """
    narrow = (1 - _WIDER + _WIDER * ratio.square()).rsqrt()
    logits = torch.cat([logits + math.log1p(-_WIDER), logits + math.log(_WIDER)], -1)
    return logits, torch.cat([narrow * deviation, narrow * ratio * deviation], -2)


def factor(deviation: Tensor, slope: Tensor) -> Tensor:
    """Return Cholesky factors ``(*, D, D)`` of marginal deviations ``(*, D)``.

    The network sets them and the correlations separately: row d of the factor is that of
    ``slope``, ``(*, D (D - 1) / 2)`` by rows, and 1 on the diagonal, scaled to norm 1 and then to
    the deviation. Without slopes it is diagonal.

    Example:
        >>> factor(torch.tensor([1.0, 2.0]), torch.tensor([0.75]))
        tensor([[1.0000, 0.0000],
                [1.2000, 1.6000]])
    """
    if deviation.shape[-1] == 1:
        return deviation.unsqueeze(-1)
    rows = torch.diag_embed(torch.ones_like(deviation))
    if slope.shape[-1]:
        below = torch.tril_indices(rows.shape[-1], rows.shape[-1], -1)
        rows[..., below[0], below[1]] = slope
        rows = rows / rows.norm(dim=-1, keepdim=True)
    return deviation.unsqueeze(-1) * rows
