"""A posterior of the ``sbi`` package as a source of parameters.

``sbi`` (Boelts et al. 2025, https://doi.org/10.21105/joss.07754) trains posteriors of many kinds;
given real data, any of them can randomise a simulator. The package is never imported here: whatever
has its posteriors' ``sample`` will do.
"""

from __future__ import annotations

__all__ = ["SbiSource", "Support"]

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from .errors import message
from .kinds import check_keys, check_kind, check_names, real_numbers


@runtime_checkable
class Support(Protocol):
    """What knows where parameters may lie, such as a prior of this package."""

    names: tuple[str, ...]

    def contains(self, theta: Tensor) -> Tensor:
        """Return which parameters lie in the support, boolean, shape ``(*)``."""
        ...


class SbiSource:
    """Draws of an ``sbi`` posterior given real data, for ``DomainRandomizer.source``.

    ``sbi`` draws from the global generators; `sources.draw` seeds and restores them around it, so
    the same key gives the same parameters here too.

    Args:
        posterior: What ``build_posterior`` returned.
        observed: The real summary, as ``sbi`` takes it; the posterior's default ``x`` if omitted.
        names: The parameters' names, in the order of the columns.
        prior: What says where parameters may lie, such as the `BoxPrior` of a `DomainRandomizer`
            (anything with ``names`` and ``contains``): draws outside its support are then refused.
            Without it nothing is known of the support, and draws are taken as they come.
        **options: For the posterior's ``sample``, such as ``max_sampling_time``.

    Raises:
        TypeError: ``posterior`` has no ``sample``, ``prior`` no ``contains``, a name is no string,
            or the draws are no numbers.
        ValueError: A name comes twice, the prior has other names, the draws are not as many as the
            names, or lie outside the prior's support.

    Example:
        >>> class Posterior:
        ...     def sample(self, shape, x=None, show_progress_bars=True):
        ...         return x + torch.zeros(*shape, 1)
        >>> from torchrl_bayessim.sources import draw
        >>> source = SbiSource(Posterior(), torch.tensor([0.7]), names=["mass"])
        >>> draw(source, 2, key=(0,)).flatten(), source.names
        (tensor([0.7000, 0.7000]), ('mass',))
    """

    def __init__(
        self,
        posterior: Any,
        observed: Tensor | None = None,
        *,
        names: Sequence[str],
        prior: Support | None = None,
        **options: Any,
    ) -> None:
        if not callable(getattr(posterior, "sample", None)):
            raise TypeError(message("an sbi posterior with `sample`", type(posterior).__name__))
        check_keys("names", names)
        check_names("names of parameters", names)
        self.posterior, self.observed = posterior, observed
        self.names, self.options = tuple(names), options
        if prior is not None:
            check_kind("a prior with names and contains", prior, Support)
            if tuple(prior.names) != self.names:
                raise ValueError(message(f"a prior over {self.names}", tuple(prior.names)))
        self.prior = prior

    def sample(self, shape: torch.Size) -> Tensor:
        """Return independent draws, shape ``(*shape, D)``."""
        drawn = self.posterior.sample(
            tuple(shape), x=self.observed, show_progress_bars=False, **self.options
        )
        expected = f"draws of the {len(self.names)} parameters {', '.join(self.names)}"
        theta = real_numbers(f"{expected}, numbers", drawn)  # NumPy's too
        if theta.shape[-1:] != (len(self.names),):
            raise ValueError(message(expected, tuple(theta.shape)))
        self._check_support(theta)
        return theta

    def _check_support(self, theta: Tensor) -> None:
        """Refuse draws outside the prior's support: to draw again would change the density."""
        if self.prior is None:
            return
        outside = theta[~self.prior.contains(theta)]
        if len(outside):
            count = theta.shape[:-1].numel()
            first = dict(zip(self.names, outside[0].tolist(), strict=True))
            raise ValueError(
                message(
                    f"draws inside the support of {self.prior}",
                    f"{len(outside)} of {count} outside, the first {first}",
                    hint="sbi with the same bounds, as sbi.utils.BoxUniform(prior.low, prior.high)",
                )
            )

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the posterior's log-density, shape ``(*)``, for importance weights."""
        flat = value.reshape(-1, value.shape[-1])
        found = self.posterior.log_prob(flat, x=self.observed)
        return real_numbers("log-densities, numbers", found).reshape(value.shape[:-1])
