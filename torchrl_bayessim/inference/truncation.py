r"""Gaussians restricted to a box: exact mass, exact density, sampling that cannot hang.

For :math:`y = \mu + L \varepsilon` and a box :math:`[l, h]`, separation of variables (Genz, 1992,
"Numerical computation of multivariate normal probabilities", J. Comput. Graph. Stat. 1) writes the
mass as an expectation over uniforms :math:`u`,

.. math::
    Z = \operatorname{E}_u \prod_d e_d, \quad e_d = \Phi(b_d) - \Phi(a_d), \quad
    \varepsilon_d = \Phi^{-1}(\Phi(a_d) + u_d e_d),

where :math:`a_d, b_d` are the limits of coordinate d given the coordinates before it. For a
diagonal :math:`L` the product does not depend on :math:`u` and is exact; otherwise a fixed
quasi-random set of points integrates it. All of it is done in float64 and is differentiable.
"""

from __future__ import annotations

__all__ = ["TruncatedGaussianMixture", "log_mass"]

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import ClassVar

import torch
from torch import Size, Tensor
from torch.distributions import Distribution

from .mixtures import Mixture, component_log_prob
from .truncated_normal import log_interval, truncated_quantile

POINTS = 256  # quasi-random points for the mass of a correlated component
INSIDE = 6.5  # deviations from every edge at which less than 1e-10 is cut off
CHAIN = 24  # independence-Metropolis steps for a draw from a correlated component


@lru_cache(maxsize=32)
def _points(dimension: int, count: int) -> Tensor:
    engine = torch.quasirandom.SobolEngine(dimension, scramble=True, seed=0)
    with torch.inference_mode(mode=False):  # kept for training too
        return engine.draw(count, dtype=torch.float64).clamp(1e-12, 1 - 1e-12)


def _chain(
    loc: Tensor, scale_tril: Tensor, box: tuple[Tensor, Tensor], u: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Return the noise of as many coordinates as ``u`` has columns, and the log of the product."""
    noise: list[Tensor] = []
    log_weight = torch.zeros((), dtype=loc.dtype, device=loc.device)
    for d in range(loc.shape[-1]):
        shift = loc[..., d]
        if noise:
            shift = shift + (scale_tril[..., d, :d] * torch.stack(noise, -1)).sum(-1)
        scale = scale_tril[..., d, d]
        a, b = (box[0][d] - shift) / scale, (box[1][d] - shift) / scale
        log_weight = log_weight + log_interval(a, b)
        if d < u.shape[-1]:
            noise.append(truncated_quantile(a, b, u[..., d]))
    return noise, log_weight


def separate(
    loc: Tensor, scale_tril: Tensor, box: tuple[Tensor, Tensor], u: Tensor
) -> tuple[Tensor, Tensor]:
    """Return points of the box made from uniforms, and the log of their mass product.

    Args:
        loc: Component means, shape ``(*, D)``.
        scale_tril: Cholesky factors, shape ``(*, D, D)``.
        box: Lower and upper limits, each of shape ``(D,)``.
        u: Uniforms that broadcast with ``(*, D)``.

    Returns:
        Points of shape ``(*, D)`` and the log-weight of each, shape ``(*)``.
    """
    noise, log_weight = _chain(loc, scale_tril, box, u)
    point = loc + (scale_tril @ torch.stack(noise, -1).unsqueeze(-1)).squeeze(-1)
    # the first limits do not depend on u, so with D = 1 the weight has no points' axis yet
    return torch.minimum(torch.maximum(point, box[0]), box[1]), log_weight.expand(point.shape[:-1])


def log_mass(
    loc: Tensor,
    scale_tril: Tensor,
    box: tuple[Tensor, Tensor],
    *,
    diagonal: bool,
    points: int = POINTS,
) -> Tensor:
    """Return the log of each component's mass inside the box, shape ``(*)``.

    Example:
        >>> one = torch.ones(1, dtype=torch.float64)
        >>> log_mass(0 * one, torch.eye(1).double(), (-one, one), diagonal=True).exp()
        tensor(0.6827, dtype=torch.float64)
    """
    scale = scale_tril.norm(dim=-1)
    a, b = (box[0] - loc) / scale, (box[1] - loc) / scale
    if diagonal:
        return log_interval(a, b).sum(-1)
    # of a component that ends far inside, nothing is cut off: most are, once a network has learned
    cut = (torch.maximum(a, -b) > -INSIDE).any(-1)
    loc, scale_tril = loc[cut], scale_tril[cut]
    u = _points(loc.shape[-1], points).unsqueeze(1).to(loc.device)
    # no limit depends on the last coordinate
    _, log_weight = _chain(loc.unsqueeze(0), scale_tril.unsqueeze(0), box, u[..., :-1])
    mass = log_weight.logsumexp(0) - math.log(len(log_weight))
    return torch.zeros_like(cut, dtype=loc.dtype).masked_scatter(cut, mass)


class TruncatedGaussianMixture(Distribution):
    r"""A mixture of Gaussians, each restricted to a box and renormalised.

    .. math::
        q(z) = \sum_k \pi_k \frac{N(z; \mu_k, L_k L_k^T)}{Z_k} \;\text{inside the box, 0 outside.}

    :math:`\pi_k` is the probability of component k *inside* the box, so nothing leaks. A Gaussian
    mixture :math:`\sum_k \alpha_k N_k` restricted to the box is the same family with
    :math:`\pi_k \propto \alpha_k Z_k`: see :meth:`restrict`.

    Args:
        logits: Log-weights, shape ``(*, K)``.
        loc: Means of the untruncated components, shape ``(*, K, D)``.
        scale_tril: Cholesky factors, shape ``(*, K, D, D)``.
        box: Lower and upper limits, each of shape ``(D,)``; ``None`` for all of R^D.
        diagonal: Whether every Cholesky factor is diagonal (then mass and draws are exact).
        points: Quasi-random points that integrate the mass of a correlated component.

    Example:
        >>> edge = torch.ones(1)
        >>> wide = TruncatedGaussianMixture(torch.zeros(1), torch.zeros(1, 1),
        ...                                 1e3 * torch.eye(1)[None], (-edge, edge), diagonal=True)
        >>> wide.log_prob(torch.tensor([[0.0], [0.9], [1.1]])).exp()
        tensor([0.5000, 0.5000, 0.0000], dtype=torch.float64)
    """

    arg_constraints: ClassVar[dict] = {}
    has_rsample = False

    def __init__(
        self,
        logits: Tensor,
        loc: Tensor,
        scale_tril: Tensor,
        box: tuple[Tensor, Tensor] | None,
        *,
        diagonal: bool = False,
        points: int = POINTS,
    ) -> None:
        self.logits = logits.double().log_softmax(-1)
        self.loc, self.scale_tril = loc.double(), scale_tril.double()
        self.box = None if box is None else (box[0].to(self.loc), box[1].to(self.loc))
        self.diagonal, self.points = diagonal or loc.shape[-1] == 1, points
        self._log_mass: Tensor | None = None
        super().__init__(logits.shape[:-1], loc.shape[-1:], validate_args=False)

    @classmethod
    def restrict(
        cls,
        logits: Tensor,
        loc: Tensor,
        scale_tril: Tensor,
        box: tuple[Tensor, Tensor] | None,
        *,
        diagonal: bool = False,
    ) -> TruncatedGaussianMixture:
        r"""Restrict :math:`\sum_k \alpha_k N_k` to the box: :math:`\pi_k \propto \alpha_k Z_k`."""
        restricted = cls(logits, loc, scale_tril, box, diagonal=diagonal)
        restricted.logits = (restricted.logits + restricted.log_mass).log_softmax(-1)
        return restricted

    @property
    def log_mass(self) -> Tensor:
        """The log of each component's mass inside the box, shape ``(*, K)``."""
        if self._log_mass is None:
            self._log_mass = (
                torch.zeros_like(self.logits)
                if self.box is None
                else log_mass(
                    self.loc,
                    self.scale_tril,
                    self.box,
                    diagonal=self.diagonal,
                    points=self.points,
                )
            )
        return self._log_mass

    @property
    def untruncated(self) -> Mixture:
        r"""The Gaussian mixture :math:`\sum_k \alpha_k N_k` that was restricted to the box."""
        logits = (self.logits - self.log_mass).log_softmax(-1)
        return Mixture(logits, self.loc, self.scale_tril)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density, ``-inf`` outside the box, shape ``(*)``."""
        value = value.double()
        inside = value.isfinite().all(-1)
        if self.box is not None:
            slack = 1e-6 * (self.box[1] - self.box[0])
            inside &= ((value >= self.box[0] - slack) & (value <= self.box[1] + slack)).all(-1)
        safe = torch.where(inside.unsqueeze(-1), value, 0.0)
        return torch.where(inside, self.formula(safe), -torch.inf)

    def formula(self, value: Tensor) -> Tensor:
        """Return the log-density of values that are known to be inside, float64, shape ``(*)``.

        A value on the rim, which rounding has put outside, has the density of the rim.
        """
        each = component_log_prob(value, self.loc, self.scale_tril) - self.log_mass
        return (self.logits + each).logsumexp(-1)

    def sample(
        self, sample_shape: Sequence[int] = (), *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return draws of shape ``(*sample_shape, *, D)``, from ``generator`` if one is given.

        A correlated component is drawn by independence Metropolis with separation of variables
        as proposal (its weights are bounded by 1): a fixed number of steps, never a rejection
        loop. For diagonal components the first proposal is exact.
        """
        with torch.no_grad():
            shape = Size(sample_shape)
            count = math.prod(shape)
            flat = self.logits.reshape(-1, self.logits.shape[-1])
            # draws are made where the generator is
            weight = flat.exp() if generator is None else flat.exp().to(generator.device)
            index = torch.multinomial(weight, max(count, 1), replacement=True, generator=generator)
            index = index.to(flat.device).T[:count].reshape((*shape, *self.batch_shape))
            loc = self._pick(self.loc, index, 1)
            scale = self._pick(self.scale_tril, index, 2)
            return self._metropolis(loc, scale, generator)

    def _pick(self, values: Tensor, index: Tensor, event_dims: int) -> Tensor:
        extra = index.ndim - len(self.batch_shape)
        values = values.reshape(*[1] * extra, *values.shape)
        values = values.expand(*index.shape[:extra], *values.shape[extra:])
        where = index.reshape(*index.shape, *[1] * (event_dims + 1))
        where = where.expand(*index.shape, 1, *values.shape[-event_dims:])
        return values.gather(index.ndim, where).squeeze(index.ndim)

    def _metropolis(self, loc: Tensor, scale: Tensor, generator: torch.Generator | None) -> Tensor:
        state, log_weight = self._propose(loc, scale, generator)
        for _ in range(0 if self.box is None or self.diagonal else CHAIN):
            point, log_new = self._propose(loc, scale, generator)
            chance = _rand(log_new, generator)
            accept = chance.log() < log_new - log_weight
            state = torch.where(accept.unsqueeze(-1), point, state)
            log_weight = torch.where(accept, log_new, log_weight)
        return state

    def _propose(
        self, loc: Tensor, scale: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        if self.box is None:
            device = loc.device if generator is None else generator.device
            noise = torch.randn(loc.shape, dtype=loc.dtype, device=device, generator=generator)
            point = loc + (scale @ noise.to(loc.device).unsqueeze(-1)).squeeze(-1)
            return point, torch.zeros_like(loc[..., 0])
        return separate(loc, scale, self.box, _rand(loc, generator))

    def quadrature(self, points: int = 256) -> tuple[Tensor, Tensor]:
        """Return fixed points ``(points * K, *, D)`` and weights that sum to 1 over the first axis.

        Quasi-random, so that moments computed from them are smooth and repeatable.
        """
        u = _points(self.loc.shape[-1], points).to(self.loc.device)
        u = u.reshape(points, *[1] * (self.loc.ndim - 1), -1)
        loc, scale = self.loc.unsqueeze(0), self.scale_tril.unsqueeze(0)
        if self.box is None:
            noise = torch.special.ndtri(u)
            where = loc + (scale @ noise.unsqueeze(-1)).squeeze(-1)
            log_weight = torch.zeros_like(where[..., 0])
        else:
            where, log_weight = separate(loc, scale, self.box, u)
        weight = (log_weight.log_softmax(0) + self.logits).exp()
        return where.movedim(-2, 1).flatten(0, 1), weight.movedim(-1, 1).flatten(0, 1)


def _rand(like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Return uniforms of the shape of ``like``, drawn where the generator is."""
    device = like.device if generator is None else generator.device
    uniform = torch.rand(like.shape, dtype=like.dtype, device=device, generator=generator)
    return uniform.to(like.device)
