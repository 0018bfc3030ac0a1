r"""One posterior from several independent trajectories.

For trajectories that are independent given the parameters,

.. math::
    p(\theta \mid x_1 \dots x_n) \propto p(\theta)^{1-n} \prod_i p(\theta \mid x_i) .

In standardised coordinates a box prior is constant and drops out, and a Gaussian prior is N(0, I).
The product of mixtures is a mixture again; after every factor it is reduced to a bounded number of
components. The factors are sorted first, so the order of the trajectories does not matter.
What answers leave open together, no product of them closes: see :mod:`.design_effect`.
"""

from __future__ import annotations

__all__ = ["pool"]

import torch
from torch import Tensor

from .design_effect import widened
from .mixtures import Mixture, divide, multiply, reduce
from .truncation import TruncatedGaussianMixture

MAX_COMPONENTS = 24


def pool(
    each: TruncatedGaussianMixture, *, bounded: bool, effect: Tensor | None = None
) -> TruncatedGaussianMixture:
    """Return the pooled posterior of a batch ``(n,)`` of posteriors, in standardised coordinates.

    Args:
        each: One mixture per trajectory, batch shape ``(n,)``.
        bounded: Whether the prior is a box (constant in these coordinates) or N(0, I).
        effect: How many times less they say together in each parameter than if they shared no
            error, shape ``(D,)``; default 1.

    Example:
        >>> each = TruncatedGaussianMixture(torch.zeros(4, 1), torch.zeros(4, 1, 1),
        ...                                 torch.ones(4, 1, 1, 1), None)
        >>> pool(each, bounded=True).scale_tril.flatten()
        tensor([0.5000], dtype=torch.float64)
    """
    parts = (each.loc, each.logits, each.scale_tril)
    keys = torch.cat([part.flatten(1) for part in parts], -1).tolist()
    order = sorted(range(len(keys)), key=keys.__getitem__)
    answers = each.untruncated
    if effect is not None:
        answers = widened(answers, effect, bounded=bounded)
    factors = [Mixture(*(part[i] for part in answers)) for i in order]
    product = factors[0]
    identity = torch.eye(each.loc.shape[-1]).to(each.loc)
    for factor in factors[1:]:
        product = multiply(product, factor)
        if not bounded:
            # no component of a posterior is wider than the prior
            zero = torch.zeros_like(identity[0])
            product = divide(product, zero, identity, widest=identity).mixture
        product = reduce(product, MAX_COMPONENTS)
    return TruncatedGaussianMixture.restrict(*product, each.box, diagonal=False)
