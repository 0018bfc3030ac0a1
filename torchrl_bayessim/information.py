r"""How much an experiment tells: the expected information about the parameters, in nats.

It is the mutual information of parameters and measurements (Lindley, 1956), the expected divergence
of the posterior from what is believed. Where the posterior is nearly Gaussian it is, in nats,

.. math::
    I \approx \operatorname{E}_\theta \tfrac12 \log\det\big(\mathbb 1 + C F(\theta)\big),
    \qquad F = \sum_i \frac{\nabla y_i \nabla y_i^T}{\sigma_i^2}

with the covariance :math:`C` of what is believed and Fisher's information matrix :math:`F` of
outputs :math:`y_i` that are measured with independent noise of deviation :math:`\sigma_i` (Chaloner
& Verdinelli, 1995; Long et al., 2013, https://doi.org/10.1016/j.cma.2013.02.017):
`expected_information`. It takes D + 1 simulations for each draw of D parameters. One is enough for
the entropy of a Gaussian with the covariance of the outputs :math:`y_1 \dots y_P` under P draws,

.. math::
    B = \tfrac12 \log\det\Big(\mathbb 1 + \tfrac{1}{P - 1}
    \sum_p \tfrac{(y_p - \bar y)}{\sigma} \tfrac{(y_p - \bar y)^T}{\sigma}\Big)

which no distribution of that covariance exceeds, `information_bound`: both are the same where
outputs are linear in Gaussian parameters, and where they are not the bound may be several times the
information, as bent outputs fill more directions than there are parameters. At most P - 1
directions count, so the determinant is that of a P by P matrix, or of one with a row for each
reading where those are fewer.
"""

from __future__ import annotations

__all__ = ["Simulate", "draws_of_parameters", "expected_information", "information_bound"]

from collections.abc import Callable

import torch
from torch import Tensor

from .errors import message
from .kinds import check_function, real_numbers

_STEP = 0.01  # of finite differences, in deviations of the draws: small beside most posteriors

Simulate = Callable[[Tensor, Tensor], Tensor]
"""Parameters ``(P, D)`` and actions ``(S, T, A)`` to outputs ``(P, S, T, Y)``."""


def expected_information(
    simulate: Simulate, theta: Tensor, actions: Tensor, *, noise: Tensor
) -> Tensor:
    r"""Return the expected information of each experiment in nats, shape ``(S,)``.

    .. math::
        I = \tfrac1P \sum_p \tfrac12 \log\det\big(\mathbb 1 + C F(\theta_p)\big)

    with the draws' covariance :math:`C` and Fisher's information :math:`F` by finite differences,
    one-sided towards the draws' mean, so that they stay where the draws are (see the module for the
    source). It is exact where outputs are linear in Gaussian parameters. Of parameters that are
    uniform in a box, and told well, it says up to :math:`\tfrac12 \log(2 \pi e / 12) = 0.18` nats
    too much each, as a Gaussian of their covariance has so much more entropy; of posteriors with
    several modes it knows one.

    Args:
        simulate: See `Simulate`.
        theta: Draws from what is believed, shape ``(P, D)``.
        actions: Of the experiments, shape ``(S, T, A)``. One in which a simulation diverges tells
            nothing.
        noise: Standard deviation of each output's measurement, shape ``(Y,)``.

    Raises:
        TypeError: For noise or parameters that are no numbers, and what is no simulator.
        ValueError: For parameters that are not finite or fewer than 2, outputs of another shape
            than ``(P, S, T, Y)``, and deviations that are not positive.

    Example:
        >>> theta = torch.tensor([[-1.0], [0.0], [1.0]])  # of variance 1
        >>> actions = torch.tensor([0.0, 1.0]).reshape(2, 1, 1)
        >>> simulate = lambda theta, actions: theta[:, None, None] * actions
        >>> expected_information(simulate, theta, actions, noise=torch.tensor([0.1]))
        tensor([0.0000, 2.3076], dtype=torch.float64)
        >>> 0.5 * torch.tensor(1 + 1 / 0.1**2).log()
        tensor(2.3076)
    """
    check_function("simulate, a function of parameters and actions", simulate)
    theta = draws_of_parameters(theta)
    noise = real_numbers("deviations of the noise, shape (Y,)", noise)
    count, size = theta.shape
    near, steps = _neighbours(theta)
    y, good = _readings(simulate(torch.cat([theta, near.flatten(0, 1)]), actions), noise)
    moved = y[:, count:].unflatten(1, (count, size)) - y[:, :count, None]  # (S, P, D, T Y)
    # of a parameter that cannot move nothing is to be learned
    slope = torch.where(steps[..., None] == 0, 0.0, moved / steps[..., None])
    values, vectors = torch.linalg.eigh(theta.double().mT.cov().reshape(size, size))
    root = vectors * values.clamp(min=0).sqrt()  # C = root root^T
    scaled = root.mT @ slope
    nats = 0.5 * torch.linalg.eigvalsh(scaled @ scaled.mT).clamp(min=0).log1p().sum(-1)
    return torch.where(good, nats.mean(1), 0.0)


def draws_of_parameters(theta: object) -> Tensor:
    """Return draws of parameters, shape ``(P, D)``, in floating point."""
    theta = real_numbers("draws of parameters, shape (P, D)", theta)
    if theta.ndim != 2 or len(theta) < 2 or not theta.isfinite().all():
        got = f"shape {tuple(theta.shape)}"
        raise ValueError(message("two or more finite draws of parameters, shape (P, D)", got))
    return theta if theta.is_floating_point() else theta.to(torch.get_default_dtype())


def _neighbours(theta: Tensor) -> tuple[Tensor, Tensor]:
    """Return each draw with one parameter moved, ``(P, D, D)``, and how far, ``(P, D)``."""
    mean, deviation = theta.double().mean(0), theta.double().std(0)
    steps = torch.where(theta > mean, -_STEP, _STEP) * deviation
    near = (theta[:, None] + torch.diag_embed(steps)).to(theta.dtype)
    moved = near.double() - theta.double()[:, None]  # what rounding has left of the steps
    return near, moved.diagonal(dim1=1, dim2=2)


def _readings(outputs: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return outputs in deviations of their noise, ``(S, P, T Y)``, and which have no gaps.

    Experiments in which a simulation diverged are all zeros.
    """
    if outputs.ndim != 4 or len(outputs) < 2 or noise.shape != outputs.shape[-1:]:
        raise ValueError(
            message(
                "outputs of shape (P >= 2, S, T, Y) and noise of shape (Y,)",
                (tuple(outputs.shape), tuple(noise.shape)),
            )
        )
    if not (noise > 0).all():
        raise ValueError(message("positive deviations of the noise", noise.tolist()))
    y = (outputs.double() / noise.double()).flatten(2).movedim(1, 0)
    good = y.isfinite().all(-1).all(-1)
    return torch.where(good[:, None, None], y, 0.0), good


def information_bound(outputs: Tensor, noise: Tensor) -> Tensor:
    r"""Return what each experiment cannot tell more than, in nats, shape ``(S,)``.

    .. math::
        B = \tfrac12 \log\det\Big(\mathbb 1 + \tfrac{1}{P - 1}
        \sum_p \tfrac{(y_p - \bar y)}{\sigma} \tfrac{(y_p - \bar y)^T}{\sigma}\Big)

    Of all measurements with one covariance Gaussian ones have the most entropy. For few draws the
    sum estimates that covariance poorly; what it says of the draws themselves holds for any number.

    Args:
        outputs: Under each of P parameter vectors, shape ``(P, S, T, Y)``. An experiment in which
            a simulation diverges tells nothing.
        noise: Standard deviation of each output's measurement, shape ``(Y,)``.

    Example:
        >>> theta = torch.linspace(-1, 1, 9)
        >>> seen, unseen = theta, 0 * theta
        >>> outputs = torch.stack([seen, unseen], 1)[..., None, None]
        >>> information_bound(outputs, torch.tensor([0.1])).round(decimals=2)
        tensor([1.9300, 0.0000], dtype=torch.float64)
    """
    y, _ = _readings(outputs, noise)
    y = y - y.mean(1, keepdim=True)
    rows = y if y.shape[1] <= y.shape[2] else y.mT  # det(1 + y y^T) = det(1 + y^T y)
    spread = torch.linalg.eigvalsh(rows @ rows.mT / (y.shape[1] - 1)).clamp(min=0)
    return 0.5 * spread.log1p().sum(-1)
