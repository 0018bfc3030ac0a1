r"""The loss of a posterior, as a TorchRL loss.

.. math::
    \ell(\phi) = -\sum_i w_i \log q_\phi(\theta_i \mid x_i) \Big/ \sum_i w_i,

minimised by the true posterior under a flexible enough q (BayesSim, arXiv:1906.01728, eq. 8). The
weights :math:`w = p(\theta) / \tilde p(\theta)` are 1 unless the simulations were drawn from a
proposal :math:`\tilde p`: see :mod:`torchrl_bayessim.inference.proposals`.
"""

from __future__ import annotations

__all__ = ["PosteriorLoss", "one_each"]

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, dispatch
from torch import Tensor
from torchrl.objectives.common import LossModule

from ..errors import message
from ..kinds import check_choice
from .priors import Prior


class PosteriorLoss(LossModule):
    """Negative log-density of the parameters under the posterior, weighted and masked.

    Args:
        posterior_network: A posterior with ``get_dist`` such as ``MixtureDensityPosterior``.
        reduction: ``"mean"`` (weighted), ``"sum"`` (weighted), or ``"none"``: one value per pair,
            without weights and masks; infinite outside the prior, NaN where a summary is.

    Keys (change with ``set_keys``): ``theta`` the parameters ``(*, D)``; ``weight`` importance
    weights ``(*)``, used where present; ``mask`` booleans ``(*)``, used where present, as is
    ``("collector", "mask")``, the one of TorchRL's collectors. A pair that is masked or of weight 0
    may hold anything. If all are, the loss and its gradient are 0.

    Raises:
        KeyError: In a call, for pairs without parameters or summaries.
        TypeError: For a network that is no posterior; in a call, for masks that are not booleans.
        ValueError: For weights or masks of another number than the pairs, weights that are negative
            or not finite; for a mean or sum over pairs that
            are not finite or outside the prior.

    Example:
        >>> from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> loss = PosteriorLoss(MixtureDensityPosterior(BoxPrior({"mass": (2.0, 6.0)}), 4))
        >>> data = TensorDict({"summary": torch.randn(8, 4), "theta": torch.full((8, 1), 4.0)}, [8])
        >>> loss(data)["loss_posterior"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        theta: NestedKey = "theta"
        weight: NestedKey = "weight"
        mask: NestedKey = "mask"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_posterior"]  # noqa: RUF012  # pyright: ignore[reportAssignmentType]
    posterior_network: ProbabilisticTensorDictSequential
    posterior_network_params: TensorDictParams
    target_posterior_network_params: TensorDictParams

    def __init__(
        self,
        posterior_network: ProbabilisticTensorDictSequential,
        *,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__()
        check_choice("a reduction", reduction, ["mean", "sum", "none"])
        if not callable(getattr(posterior_network, "get_dist", None)):
            expected = "a posterior network with get_dist, such as a MixtureDensityPosterior"
            raise TypeError(message(expected, type(posterior_network).__name__))
        self.reduction = reduction
        self.convert_to_functional(posterior_network, "posterior_network")

    @property
    def in_keys(self) -> list[NestedKey]:
        """The summaries and the parameters."""
        return [*self.posterior_network.in_keys, self.tensor_keys.theta]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        del kwargs  # no value estimator

    @dispatch  # pyright: ignore[reportArgumentType]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``{"loss_posterior": ...}`` for pairs of summaries and parameters."""
        for key in self.in_keys:
            if tensordict.get(key, None) is None:
                found = sorted(map(str, tensordict.keys(include_nested=True)))
                raise KeyError(message("pairs with an entry", str(key), available=found))
        theta = tensordict.get(self.tensor_keys.theta)
        inputs = tensordict.select(*self.posterior_network.in_keys)
        weight = self._weight(tensordict, theta)
        used = weight > 0
        if self.reduction != "none" and not used.all():
            # a row of weight 0 may hold anything; NaN there would reach the gradient as 0 * NaN
            inputs = inputs.apply(lambda x: torch.where(used.unsqueeze(-1), x, 0.0))
        with self.posterior_network_params.to_module(self.posterior_network):
            q = self.posterior_network.get_dist(inputs)
            loss = -q.log_prob(theta)
        if self.reduction == "none":
            return TensorDict({"loss_posterior": loss})
        if not loss[used].isfinite().all():
            summaries = [tensordict.get(key) for key in self.posterior_network.in_keys]
            bad = used & ~loss.isfinite()
            _explain(summaries, theta, bad, prior=getattr(q, "prior", None))
        total = torch.where(used, weight * loss, 0.0).sum()
        if self.reduction == "mean":
            total = total / weight.sum().clamp_min(1e-12)
        return TensorDict({"loss_posterior": total})

    def _weight(self, tensordict: TensorDictBase, theta: Tensor) -> Tensor:
        """Return the weight of every pair, 0 where masked."""
        shape = theta.shape[:-1]
        weight = tensordict.get(self.tensor_keys.weight, None)
        weight = theta.new_ones(shape) if weight is None else one_each("weight", weight, shape)
        for key in dict.fromkeys([self.tensor_keys.mask, ("collector", "mask")]):
            mask = tensordict.get(key, None)
            if mask is None:
                continue
            if mask.dtype != torch.bool:
                raise TypeError(message(f"booleans in {key!r}", str(mask.dtype)))
            weight = torch.where(one_each("mask", mask, shape), weight, 0.0)
        if not (weight >= 0).all() or weight.isinf().any():
            bad = weight[~(weight >= 0) | weight.isinf()]
            expected = "finite weights of 0 or more"
            raise ValueError(message(expected, f"{len(bad)} others, the first {bad[0].item():.3g}"))
        return weight


def one_each(kind: str, values: Tensor, shape: torch.Size) -> Tensor:
    """Return one value per pair, in the pairs' shape.

    Raises:
        ValueError: There is another number of values.
    """
    if values.numel() != shape.numel():
        expected = f"one {kind} per pair, shape {tuple(shape)}"
        raise ValueError(message(expected, tuple(values.shape)))
    return values.reshape(shape)


def _explain(summaries: list[Tensor], theta: Tensor, bad: Tensor, *, prior: Prior | None) -> None:
    """Refuse pairs at fault for a loss that is not finite; a network that diverged is another."""
    finite = torch.stack([value.isfinite().all(-1) for value in (theta, *summaries)]).all(0)
    outside = finite & ~prior.contains(theta) if prior is not None else torch.zeros_like(finite)
    if not (bad & (~finite | outside)).any():
        return
    got = f"{int((bad & ~finite).sum())} with NaN or infinity, {int((bad & outside).sum())} outside"
    expected = f"pairs that are finite and inside {'the prior' if prior is None else repr(prior)}"
    raise ValueError(message(expected, got, hint="mask them, or give them weight 0"))
