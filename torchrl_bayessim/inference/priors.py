r"""What is believed about the physics before any data: named, bounded, in units.

Two coordinates appear throughout the package. *Parameters* :math:`\theta` are in the units of the
simulator. *Standardised coordinates* :math:`z` have prior mean 0 and prior variance 1 in every
direction, and are where networks and mixtures work:

.. math::
    z = (u - \operatorname{E}[u]) / \operatorname{sd}[u], \qquad
    u_d = \theta_d \text{ or } \log \theta_d .

A prior is a torch :class:`~torch.distributions.Distribution` with event shape ``(D,)``. Its own
tensors and its draws lie on the CPU; densities and coordinates lie where the parameters do.
"""

from __future__ import annotations

__all__ = ["BoxPrior", "GaussianPrior", "Prior", "check_prior"]

import math
from collections.abc import Mapping, Sequence, Set
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Size, Tensor
from torch.distributions import Distribution, constraints
from torch.distributions.transforms import (
    AffineTransform,
    ComposeTransform,
    SigmoidTransform,
    Transform,
)

from ..counts import check_count
from ..errors import message
from ..kinds import check_kind, real_numbers
from .standardization import Standardization

Pairs = Mapping[str, tuple[float, float]] | Sequence[tuple[str, tuple[float, float]]]


def _as_list(pairs: Pairs, what: str) -> list[tuple[str, tuple[float, float]]]:
    """Return ``(name, (a, b))`` of numbers, where ``what`` says what a and b are."""
    if not isinstance(pairs, Mapping | Sequence):
        raise TypeError(message(f"names with {what} each, as a dictionary", type(pairs).__name__))
    found = []
    for item in pairs.items() if isinstance(pairs, Mapping) else pairs:
        try:
            name, (a, b) = item
            found.append((name, (float(a), float(b))))
        except (TypeError, ValueError):
            raise ValueError(message(f"a name with {what}, two numbers", item)) from None
        if not isinstance(name, str):
            raise TypeError(message("a name that is a string", name))
    if not found:
        raise ValueError(message("at least one named parameter", "an empty prior"))
    names = [name for name, _ in found]
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates:
        raise ValueError(message("every parameter once", f"{duplicates[0]} twice"))
    return found


class Prior(Distribution):
    r"""A distribution over named parameters, with a standardisation and a bijection to R^D.

    Attributes:
        names: The parameters' names, in the order of the columns of ``theta``.
        units: One unit per parameter, ``""`` where none was given.
        standardization: The transform :math:`z \mapsto \theta`.
        bijection: A transform from all of R^D onto the support.
        settings: Plain values that tell it from any other prior, exactly.
        box: The support in standardised coordinates, ``(low, high)``; ``None`` if all of R^D.
    """

    arg_constraints: ClassVar[dict] = {}
    names: tuple[str, ...]
    units: tuple[str, ...]
    standardization: Standardization
    bijection: Transform
    box: tuple[Tensor, Tensor] | None
    settings: dict[str, list[Any]]

    def _name(self, names: Sequence[str], units: Mapping[str, str] | None) -> None:
        units = {} if units is None else units
        if not isinstance(units, Mapping):
            raise TypeError(message("units= to be {name: unit}", units))
        units = dict(units)
        unknown = [name for name in units if name not in names]
        if unknown:
            raise ValueError(message("units of declared parameters", unknown[0], available=names))
        self.names = tuple(names)
        self.units = tuple(units.get(name, "") for name in names)
        super().__init__(Size(), Size((len(names),)), validate_args=False)

    def standardize(self, theta: Tensor) -> Tensor:
        """Return the standardised coordinates of parameters, shape ``(*, D)``."""
        self._check_event(theta)
        return self.standardization._inverse(_floats(theta))

    def unstandardize(self, z: Tensor) -> Tensor:
        """Return the parameters at standardised coordinates, shape ``(*, D)``."""
        self._check_event(z)
        return self.standardization._call(_floats(z))

    def _check_event(self, theta: Tensor) -> None:
        check_kind("parameters, a tensor of shape (*, D)", theta, Tensor)
        if theta.is_complex() or theta.dtype == torch.bool:
            raise TypeError(message("parameters that are real numbers", str(theta.dtype)))
        if theta.shape[-1:] != self.event_shape:
            raise ValueError(
                message(
                    f"parameters of shape (*, {len(self.names)}), one column for each of "
                    f"{', '.join(self.names)}",
                    tuple(theta.shape),
                )
            )


def _floats(values: Tensor) -> Tensor:
    return values if values.is_floating_point() else values.to(torch.get_default_dtype())


def _shape(sample_shape: Sequence[int]) -> Sequence[int]:
    """Return the shape of a sample, if it is one."""
    check_kind("a shape of the sample, a tuple", sample_shape, tuple, list)
    for size in sample_shape:
        check_count("draws", size, least=0)
    return sample_shape


def check_prior(prior: object) -> None:
    """Refuse what is no prior with named parameters, such as a torch distribution.

    Raises:
        TypeError: It is none.
    """
    if not isinstance(prior, Prior):
        hint = "BoxPrior or GaussianPrior"
        raise TypeError(message("a prior with named parameters", type(prior).__name__, hint=hint))


_LARGEST = 1e18  # of bounds, means and deviations


class BoxPrior(Prior):
    r"""Independent uniform (or log-uniform) parameters on a box.

    .. math::
        \log p(\theta) = -\sum_d \log(h_d - l_d)
        \quad\text{or}\quad -\sum_d (\log\theta_d + \log\log(h_d / l_d)) \text{ if logarithmic,}

    and :math:`-\infty` outside.

    Args:
        bounds: ``{name: (low, high)}`` in the parameters' units.
        log: Names of the parameters that are uniform in their logarithm.
        units: ``{name: unit}``, for reports and pictures.

    Raises:
        ValueError: For no parameters, duplicate names, reversed, equal, infinite or NaN bounds,
            bounds that float32 cannot tell apart, and a logarithmic parameter whose lower bound is
            not positive in float32, down to its smallest normal number of 1.2e-38.
        TypeError: ``log`` is a string and not a list of names, or a name is no string.

    Example:
        >>> prior = BoxPrior({"mass": (2.0, 6.0), "damping": (0.01, 1.0)}, log=["damping"],
        ...                  units={"mass": "kg", "damping": "N m s"})
        >>> theta = prior.sample((512,))
        >>> theta.shape, bool(prior.contains(theta).all())
        (torch.Size([512, 2]), True)
        >>> prior.log_prob(torch.tensor([[4.0, 0.1], [9.0, 0.1]]))
        tensor([-0.6109,    -inf])
    """

    def __init__(
        self,
        bounds: Pairs,
        *,
        log: Sequence[str] = (),
        units: Mapping[str, str] | None = None,
    ) -> None:
        pairs = _as_list(bounds, "(low, high)")
        names = [name for name, _ in pairs]
        _check_bounds(pairs, names, log)
        self.low = torch.tensor([low for _, (low, _) in pairs], dtype=torch.float32)
        self.high = torch.tensor([high for _, (_, high) in pairs], dtype=torch.float32)
        self.log = torch.tensor([name in log for name in names])
        low, high = self._u(self.low.double()), self._u(self.high.double())
        half = (high - low) / 2
        self.standardization = Standardization(
            low + half, torch.diag(half / math.sqrt(3.0)), self.log
        )
        edge = math.sqrt(3.0) * torch.ones(len(names), dtype=torch.float64)
        self.box = (-edge, edge)
        self.bijection = ComposeTransform(
            [
                SigmoidTransform(),
                AffineTransform(-math.sqrt(3.0), 2 * math.sqrt(3.0), event_dim=1),
                self.standardization,
            ]
        )
        self._name(names, units)
        self.settings = {
            "names": names,
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            "log": self.log.tolist(),
        }

    def _u(self, theta: Tensor) -> Tensor:
        return torch.where(self.log, torch.where(self.log, theta, 1.0).log(), theta)

    @property
    def support(self) -> constraints.Constraint:  # noqa: D102 (documented by torch)
        return constraints.independent(constraints.interval(self.low, self.high), 1)

    @property
    def mean(self) -> Tensor:
        """The prior means, shape ``(D,)``."""
        low, high = self.low.double(), self.high.double()  # float32 may not hold their ratio
        width = torch.where(self.log, (high / low).log(), 1.0)
        mean = torch.where(self.log, (high - low) / width, (low + high) / 2)
        return mean.to(self.low.dtype)

    @property
    def variance(self) -> Tensor:
        """The prior variances, shape ``(D,)``."""
        low, high = self.low.double(), self.high.double()  # of narrow boxes little would be left
        width = torch.where(self.log, (high / low).log(), 1.0)
        square = (high**2 - low**2) / (2 * width) - ((high - low) / width) ** 2
        return torch.where(self.log, square, (high - low) ** 2 / 12).to(self.low.dtype)

    def sample(
        self, sample_shape: Sequence[int] = (), *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return draws of shape ``(*sample_shape, D)``, from ``generator`` if one is given."""
        shape = (*_shape(sample_shape), *self.event_shape)
        device = None if generator is None else generator.device
        unit = torch.rand(shape, generator=generator, dtype=self.low.dtype, device=device)
        unit = unit.to(self.low.device)
        low, high = self._u(self.low), self._u(self.high)
        u = low + unit * (high - low)
        theta = torch.where(self.log, u.exp(), u)
        # exp(log(high)) may exceed high by one rounding; the bound itself is in the support
        return torch.minimum(torch.maximum(theta, self.low), self.high)

    def within(self, low: Tensor, high: Tensor) -> BoxPrior:
        """Return the prior on the part of its box between ``low`` and ``high``, each ``(D,)``.

        Example:
            >>> BoxPrior({"mass": (2.0, 6.0)}).within(torch.tensor([1.0]), torch.tensor([3.0]))
            BoxPrior(mass: [2, 3])
        """
        low, high = (real_numbers("bounds of shape (D,)", bound).cpu() for bound in (low, high))
        if not low.shape == high.shape == self.low.shape:
            expected = f"bounds of shape {tuple(self.low.shape)}"
            raise ValueError(message(expected, (tuple(low.shape), tuple(high.shape))))
        low, high = torch.maximum(low, self.low), torch.minimum(high, self.high)
        bounds = zip(self.names, zip(low.tolist(), high.tolist(), strict=True), strict=True)
        return BoxPrior(
            list(bounds),
            log=[name for name, log in zip(self.names, self.log.tolist(), strict=True) if log],
            units=dict(zip(self.names, self.units, strict=True)),
        )

    def contains(self, theta: Tensor) -> Tensor:
        """Return which parameters lie in the box (up to rounding), boolean, shape ``(*)``."""
        self._check_event(theta)
        width = self.high - self.low
        below = self.low - 1e-6 * torch.where(self.log, self.low, width)
        above = self.high + 1e-6 * torch.where(self.log, self.high, width)
        low, high = below.to(theta.device), above.to(theta.device)
        return ((theta >= low) & (theta <= high)).all(-1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, ``-inf`` outside the box, shape ``(*)``."""
        inside = self.contains(value)
        width = (self._u(self.high) - self._u(self.low)).log().to(value.device)
        log = self.log.to(value.device)
        safe = torch.where(log & (value > 0), value, torch.ones_like(value))
        density = -(width + safe.log()).sum(-1)
        return torch.where(inside, density, -torch.inf)

    def __repr__(self) -> str:
        rows = zip(self.names, self.low.tolist(), self.high.tolist(), self.units, strict=True)
        body = ", ".join(f"{n}: [{lo:.4g}, {hi:.4g}] {u}".rstrip() for n, lo, hi, u in rows)
        return f"BoxPrior({body})"


def _check_bounds(
    pairs: Sequence[tuple[str, tuple[float, float]]], names: Sequence[str], log: Sequence[str]
) -> None:
    if isinstance(log, str | bytes) or not isinstance(log, Sequence | Set):
        raise TypeError(message("log= to be a list of names", log, hint=f"log=[{str(log)!r}]"))
    for name, (low, high) in pairs:
        if not all(abs(bound) <= _LARGEST for bound in (low, high)):
            raise ValueError(
                message(
                    f"finite bounds for {name!r} (a uniform density needs a finite box, and "
                    f"float32 the squares of numbers up to {_LARGEST:g})",
                    (low, high),
                    hint="finite bounds, or GaussianPrior for an unbounded parameter",
                )
            )
        if low >= high:
            hint = f"({high}, {low})" if low > high else "no parameter for what is known exactly"
            raise ValueError(message(f"low < high for {name!r}", (low, high), hint=hint))
        if not np.float32(low) < np.float32(high):
            raise ValueError(
                message(
                    f"bounds of {name!r} that differ in float32, which parameters are kept in",
                    (low, high),
                    hint="wider bounds, or leave a known parameter out of the prior",
                )
            )
        if name in log and low <= 0:
            raise ValueError(
                message(
                    f"a positive lower bound for the logarithmic parameter {name!r}",
                    (low, high),
                    hint="a small positive lower bound, or drop it from log=",
                )
            )
        if name in log and np.float32(low) < np.finfo(np.float32).tiny:
            raise ValueError(
                message(
                    f"a lower bound for the logarithmic parameter {name!r} of at least "
                    f"{np.finfo(np.float32).tiny:.2g}, since parameters are kept in float32",
                    (low, high),
                    hint="a larger lower bound, or another unit",
                )
            )
    for name in log:
        if name not in names:
            raise ValueError(message("log= to name declared parameters", name, available=names))


class GaussianPrior(Prior):
    r"""A Gaussian over parameters, :math:`p(\theta) = N(\theta; m, \Sigma)`, unbounded.

    Args:
        moments: ``{name: (mean, standard deviation)}`` in the parameters' units.
        correlation: Correlation matrix, shape ``(D, D)``; independent if omitted.
        units: ``{name: unit}``, for reports and pictures.

    Raises:
        ValueError: For no parameters, duplicate names, NaN or infinite moments, standard
            deviations that are not positive, and a correlation that is not symmetric and positive
            definite.

    Example:
        >>> prior = GaussianPrior({"mass": (4.0, 0.5), "offset": (0.0, 0.1)})
        >>> prior.sample((3,)).shape, prior.mean
        (torch.Size([3, 2]), tensor([4., 0.]))
    """

    def __init__(
        self,
        moments: Pairs,
        *,
        correlation: Tensor | None = None,
        units: Mapping[str, str] | None = None,
    ) -> None:
        pairs = _as_list(moments, "(mean, standard deviation)")
        names = [name for name, _ in pairs]
        for name, (mean, sd) in pairs:
            if not (abs(mean) <= _LARGEST and 0 < sd <= _LARGEST and np.float32(sd) > 0):
                expected = f"a finite mean and a positive deviation for {name!r} (in float32)"
                raise ValueError(message(expected, (mean, sd)))
        mean = torch.tensor([m for _, (m, _) in pairs], dtype=torch.float64)
        sd = torch.tensor([s for _, (_, s) in pairs], dtype=torch.float64)
        self.standardization = Standardization(
            mean,
            sd[:, None] * _correlation_tril(correlation, len(names)),
            torch.zeros(len(names), dtype=torch.bool),
        )
        self.box = None
        self.bijection = self.standardization
        self._name(names, units)
        self.settings = {
            "names": names,
            "mean": mean.tolist(),
            "scale_tril": self.standardization.scale_tril.tolist(),
        }

    @property
    def support(self) -> constraints.Constraint:  # noqa: D102 (documented by torch)
        return constraints.real_vector

    @property
    def mean(self) -> Tensor:
        """The prior means, shape ``(D,)``."""
        return self.standardization.mean.to(torch.get_default_dtype())

    @property
    def variance(self) -> Tensor:
        """The prior variances, shape ``(D,)``."""
        scale = self.standardization.scale_tril.to(torch.get_default_dtype())
        return scale.square().sum(-1)

    def sample(
        self, sample_shape: Sequence[int] = (), *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return draws of shape ``(*sample_shape, D)``, from ``generator`` if one is given."""
        shape = (*_shape(sample_shape), *self.event_shape)
        device = None if generator is None else generator.device
        noise = torch.randn(shape, generator=generator, device=device)
        return self.unstandardize(noise.to(self.standardization.mean.device))

    def contains(self, theta: Tensor) -> Tensor:
        """Return which parameters are finite: the support is all of R^D; shape ``(*)``."""
        self._check_event(theta)
        return theta.isfinite().all(-1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, shape ``(*)``."""
        z = self.standardize(value)
        base = -0.5 * (z.square() + math.log(2 * math.pi)).sum(-1)
        return base - self.standardization.log_abs_det_jacobian(z, value)

    def __repr__(self) -> str:
        rows = zip(
            self.names, self.mean.tolist(), self.variance.sqrt().tolist(), self.units, strict=True
        )
        body = ", ".join(f"{n}: {m:.4g} ± {s:.4g} {u}".rstrip() for n, m, s, u in rows)
        return f"GaussianPrior({body})"


def _correlation_tril(correlation: Tensor | None, size: int) -> Tensor:
    if correlation is None:
        return torch.eye(size, dtype=torch.float64)
    correlation = real_numbers("a correlation matrix", correlation, torch.float64).cpu()
    ones = torch.ones(size, dtype=torch.float64)
    if correlation.shape != (size, size) or not torch.allclose(correlation.diagonal(), ones):
        raise ValueError(
            message(
                f"a correlation matrix of shape ({size}, {size}) with unit diagonal",
                tuple(correlation.shape),
            )
        )
    if not torch.allclose(correlation, correlation.mT):
        raise ValueError(message("a symmetric correlation matrix", correlation.tolist()))
    tril, failed = torch.linalg.cholesky_ex(correlation)
    if failed:
        raise ValueError(message("a positive definite correlation matrix", correlation.tolist()))
    return tril
