r"""Features of summary statistics: a small network, or quasi-Monte-Carlo random Fourier features.

By Bochner's theorem a stationary kernel is the characteristic function of its spectral density
p(w), and

.. math::
    k(x - x') = \operatorname{E}_w \cos(w^T (x - x')) \approx \phi(x)^T \phi(x'), \qquad
    \phi(x) = \tfrac{1}{\sqrt M} [\cos(w_m^T x), \sin(w_m^T x)]_{m=1..M} .

(Rahimi & Recht, 2007; BayesSim, Ramos et al., 2019, sec. III-C. The paper's :math:`-i\sin` and its
bias drop out of the real form.) The frequencies are drawn by a scrambled Halton sequence through
the spectral density's quantiles. One convention: ``lengthscale`` l enters as x / l, so the RBF
kernel is :math:`\exp(-r^2 / 2 l^2)`.
"""

from __future__ import annotations

__all__ = [
    "Features",
    "FourierFeatures",
    "NeuralFeatures",
    "ResidualFeatures",
    "spectral_frequencies",
]

import math
from typing import Literal

import numpy as np
import torch
from scipy.special import ndtri
from scipy.stats import chi2, qmc
from torch import Tensor, nn
from torch.nn.functional import silu

from ..counts import check_count
from ..errors import message

Kernel = Literal["rbf", "matern12", "matern32", "matern52"]
DEGREES = {"rbf": None, "matern12": 1, "matern32": 3, "matern52": 5}


def spectral_frequencies(kernel: Kernel, count: int, dim: int, *, seed: int = 0) -> Tensor:
    r"""Return frequencies :math:`w_m` of a unit-lengthscale kernel, shape ``(count, dim)``.

    The spectral density of the RBF kernel is N(0, I). That of the Matérn kernel of smoothness
    :math:`\nu` is the *multivariate* Student t with :math:`2\nu` degrees of freedom,
    :math:`w = z \sqrt{2\nu / u}` with one :math:`u \sim \chi^2_{2\nu}` for all coordinates: a t
    per coordinate would give a product of one-dimensional kernels instead.

    Raises:
        ValueError: For an unknown kernel.
    """
    if kernel not in DEGREES:
        raise ValueError(message("the name of a kernel", kernel, available=DEGREES))
    degrees = DEGREES[kernel]
    halton = qmc.Halton(dim + (degrees is not None), scramble=True, rng=np.random.default_rng(seed))
    uniform = np.clip(halton.random(count), 1e-9, 1 - 1e-9)  # a quantile at 0 would be infinite
    w = ndtri(uniform[:, :dim])
    if degrees is not None:
        w *= np.sqrt(degrees / chi2.ppf(uniform[:, dim:], degrees))
    return torch.as_tensor(w, dtype=torch.get_default_dtype())


class Features(nn.Module):
    """A map from standardised summaries ``(*, dim)`` to features ``(*, out_features)``.

    Subclass it to condition a posterior on features of your own.
    """

    dim: int
    out_features: int


class FourierFeatures(Features):
    """Random Fourier features of a stationary kernel.

    Args:
        dim: Size L of the input.
        frequencies: Number M of frequencies; there are ``2 * M`` features.
        kernel: ``"rbf"``, ``"matern12"``, ``"matern32"`` or ``"matern52"``.
        lengthscale: In units of the (standardised) inputs; see ``select_lengthscale``.
        seed: Of the scrambling.

    Example:
        >>> phi = FourierFeatures(2, frequencies=4096, kernel="matern32")
        >>> x = torch.tensor([[0.0, 0.0], [0.6, -0.8]])
        >>> round((phi(x[0]) @ phi(x[1])).item(), 2)  # (1 + sqrt 3) exp(-sqrt 3) = 0.483
        0.48
    """

    frequencies: Tensor
    lengthscale: Tensor

    def __init__(
        self,
        dim: int,
        *,
        frequencies: int = 256,
        kernel: Kernel = "rbf",
        lengthscale: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.dim, self.out_features, self.kernel = dim, 2 * frequencies, kernel
        self.register_buffer(
            "frequencies", spectral_frequencies(kernel, frequencies, dim, seed=seed)
        )
        self.register_buffer("lengthscale", torch.tensor(float(lengthscale)))

    def forward(self, x: Tensor) -> Tensor:
        """Return the features of ``x`` ``(*, L)``, shape ``(*, 2 * M)``; their norm is 1."""
        phase = (x / self.lengthscale) @ self.frequencies.mT
        return torch.cat([phase.cos(), phase.sin()], -1) / math.sqrt(len(self.frequencies))


class NeuralFeatures(Features):
    """A multilayer perceptron, as the features of the paper's "BayesSim NN".

    Args:
        dim: Size L of the input.
        widths: Units of each hidden layer.
        seed: Of the initial weights.

    Example:
        >>> NeuralFeatures(3, widths=(24, 24))(torch.zeros(5, 3)).shape
        torch.Size([5, 24])
    """

    def __init__(self, dim: int, *, widths: tuple[int, ...] = (128, 128), seed: int = 0) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        with torch.random.fork_rng(devices=[]):
            torch.random.default_generator.manual_seed(seed)
            for size_in, size_out in zip((dim, *widths), widths, strict=False):
                layers += [nn.Linear(size_in, size_out), nn.SiLU()]
        self.layers = nn.Sequential(*layers)
        self.dim, self.out_features = dim, widths[-1]

    def forward(self, x: Tensor) -> Tensor:
        """Return the last hidden layer for ``x`` ``(*, L)``, shape ``(*, widths[-1])``."""
        return self.layers(x)


class ResidualFeatures(Features):
    r"""A multilayer perceptron whose later layers add to the first: the default.

    .. math::
        h_0 = \sigma(W_0 x + b_0), \qquad h_{i} = h_{i-1} + \sigma(W_i h_{i-1} + b_i),

    with :math:`\sigma` the SiLU (He, Zhang, Ren & Sun, 2016, "Deep residual learning for image
    recognition", arXiv:1512.03385).

    Args:
        dim: Size L of the input.
        width: Units of every layer.
        blocks: Layers that add to the first.
        seed: Of the initial weights.

    Raises:
        TypeError: A size is no whole number.
        ValueError: It is not positive.

    Example:
        >>> ResidualFeatures(3, width=32)(torch.zeros(5, 3)).shape
        torch.Size([5, 32])
    """

    def __init__(self, dim: int, *, width: int = 96, blocks: int = 2, seed: int = 0) -> None:
        super().__init__()
        for name, value in {"dim": dim, "width": width, "blocks": blocks}.items():
            check_count(name, value)
        with torch.random.fork_rng(devices=[]):
            torch.random.default_generator.manual_seed(seed)
            self.first = nn.Linear(dim, width)
            self.blocks = nn.ModuleList(nn.Linear(width, width) for _ in range(blocks))
        self.dim, self.out_features = dim, width

    def forward(self, x: Tensor) -> Tensor:
        """Return the last hidden layer for ``x`` ``(*, L)``, shape ``(*, width)``."""
        hidden = silu(self.first(x))
        for block in self.blocks:
            hidden = hidden + silu(block(hidden))
        return hidden
