r"""The bijection between parameters in their units and coordinates of mean 0 and variance 1.

.. math::
    z = S^{-1} (u - m), \qquad u_d = \theta_d \text{ or } \log \theta_d .
"""

from __future__ import annotations

__all__ = ["Standardization"]

import torch
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.transforms import Transform


class Standardization(Transform):
    r"""The bijection :math:`z \mapsto \theta`: :math:`u = m + S z`, then exp where logarithmic.

    Args:
        mean: :math:`m`, shape ``(D,)``.
        scale_tril: :math:`S`, lower triangular, shape ``(D, D)``.
        log: Which parameters are logarithmic, boolean, shape ``(D,)``.
    """

    domain = constraints.real_vector
    codomain = constraints.real_vector
    bijective = True

    def __init__(self, mean: Tensor, scale_tril: Tensor, log: Tensor) -> None:
        super().__init__()
        self.mean, self.scale_tril, self.log = mean, scale_tril, log

    def _call(self, x: Tensor) -> Tensor:
        mean, scale, log = self._at(x)
        u = mean + x @ scale.mT
        return torch.where(log, u.exp(), u) if self.log.any() else u

    def _inverse(self, y: Tensor) -> Tensor:
        mean, scale, log = self._at(y)
        u = torch.where(log, self._log(y), y) if self.log.any() else y
        centred = (u - mean).unsqueeze(-1)
        return torch.linalg.solve_triangular(scale, centred, upper=False).squeeze(-1)

    def _at(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what it is made of, where ``x`` is and as precise."""
        return self.mean.to(x), self.scale_tril.to(x), self.log.to(x.device)

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        r"""Return :math:`\log |\partial\theta / \partial z|`, shape ``(*)``."""
        volume = self.scale_tril.diagonal().log().sum().to(x)
        if not self.log.any():
            return volume.expand(x.shape[:-1])
        return volume + self._log(y).sum(-1)

    def _log(self, y: Tensor) -> Tensor:
        """Return the logarithm of logarithmic parameters, finite below 0, and 0 for others."""
        return torch.where(self.log.to(y.device), y.clamp_min(torch.finfo(y.dtype).tiny), 1.0).log()
