"""A distribution over physics parameters, in their own units and inside the prior's support."""

from __future__ import annotations

__all__ = ["PhysicsPosterior"]

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution

from .priors import Prior
from .truncation import TruncatedGaussianMixture


class PhysicsPosterior(Distribution):
    """A distribution over physics parameters: a truncated mixture seen through the prior's scaling.

    Draws and moments lie where the mixture does; densities where the parameters do.

    Args:
        mixture: In standardised coordinates, batch shape ``(*)``.
        prior: Whose coordinates, names, units and support are used.

    Example:
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> prior = BoxPrior({"mass": (2.0, 6.0)})
        >>> q = PhysicsPosterior(TruncatedGaussianMixture(torch.zeros(1), torch.zeros(1, 1),
        ...     0.1 * torch.eye(1)[None], prior.box, diagonal=True), prior)
        >>> q.names, round(q.mean.item(), 3), round(q.stddev.item(), 3)
        (('mass',), 4.0, 0.115)
    """

    arg_constraints: ClassVar[dict] = {}
    has_rsample = False

    def __init__(self, mixture: TruncatedGaussianMixture, prior: Prior) -> None:
        self.mixture, self.prior = mixture, prior
        self.names, self.units = prior.names, prior.units
        super().__init__(mixture.batch_shape, mixture.event_shape, validate_args=False)

    @property
    def support(self) -> torch.distributions.constraints.Constraint:  # noqa: D102
        return self.prior.support  # pyright: ignore[reportReturnType]

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density in the parameters' own units, shape ``(*)``."""
        theta = value.to(self.mixture.loc.device).double()
        z = self.prior.standardize(theta)
        volume = self.prior.standardization.log_abs_det_jacobian(z, theta)
        return (self.mixture.log_prob(z) - volume).to(value.device, torch.get_default_dtype())

    def sample(
        self, sample_shape: Sequence[int] = (), *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return draws of shape ``(*sample_shape, *, D)``, from ``generator`` if one is given."""
        z = self.mixture.sample(sample_shape, generator=generator)
        return self.prior.unstandardize(z).to(torch.get_default_dtype())

    def _expectation(self, power: int) -> Tensor:
        points, weight = self.mixture.quadrature()
        theta = self.prior.unstandardize(points)
        return (weight.unsqueeze(-1) * theta**power).sum(0)

    @property
    def mean(self) -> Tensor:
        """The posterior means, shape ``(*, D)``, by a fixed quadrature."""
        return self._expectation(1).to(torch.get_default_dtype())

    @property
    def variance(self) -> Tensor:
        """The posterior variances, shape ``(*, D)``, by a fixed quadrature."""
        spread = self._expectation(2) - self._expectation(1) ** 2
        return spread.clamp_min(0).to(torch.get_default_dtype())

    @property
    def deterministic_sample(self) -> Tensor:
        """The mean, which TensorDict modules return under ``ExplorationType.DETERMINISTIC``."""
        return self.mean
