"""A posterior of the ``sbi`` package as a source of parameters.

``sbi`` (Boelts et al. 2025, https://doi.org/10.21105/joss.07754) trains posteriors of many kinds;
given real data, any of them can randomise a simulator. The package is never imported here: whatever
has its posteriors' ``sample`` will do.
"""

from __future__ import annotations

__all__ = ["SbiSource"]

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .errors import message
from .kinds import check_keys, check_names


class SbiSource:
    """Draws of an ``sbi`` posterior given real data, for ``DomainRandomizer.source``.

    ``sbi`` draws from the global generators; `sources.draw` seeds and restores them around it, so
    the same key gives the same parameters here too.

    Args:
        posterior: What ``build_posterior`` returned.
        observed: The real summary, as ``sbi`` takes it; the posterior's default ``x`` if omitted.
        names: The parameters' names, in the order of the columns.
        **options: For the posterior's ``sample``, such as ``max_sampling_time``.

    Raises:
        TypeError: ``posterior`` has no ``sample``, or a name is no string.
        ValueError: A name comes twice, or the draws are not as many as the names.

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
        **options: Any,
    ) -> None:
        if not callable(getattr(posterior, "sample", None)):
            raise TypeError(message("an sbi posterior with `sample`", type(posterior).__name__))
        check_keys("names", names)
        check_names("names of parameters", names)
        self.posterior, self.observed = posterior, observed
        self.names, self.options = tuple(names), options

    def sample(self, shape: torch.Size) -> Tensor:
        """Return independent draws, shape ``(*shape, D)``."""
        theta = self.posterior.sample(
            tuple(shape), x=self.observed, show_progress_bars=False, **self.options
        )
        if theta.shape[-1] != len(self.names):
            expected = f"draws of the {len(self.names)} parameters {', '.join(self.names)}"
            raise ValueError(message(expected, tuple(theta.shape)))
        return theta

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the posterior's log-density, shape ``(*)``, for importance weights."""
        flat = value.reshape(-1, value.shape[-1])
        return self.posterior.log_prob(flat, x=self.observed).reshape(value.shape[:-1])
