r"""How much less n trajectories say together than n independent answers would.

A network's answer to a trajectory leaves two things open: what this trajectory does not say, which
the next one may, and what the network does not know, which it leaves open again. A product of n
answers takes all of it for the first. Of observations that share a part :math:`\rho` of their
variance (the intraclass correlation), n are worth

.. math::
    \frac{n}{1 + (n - 1) \rho}

independent ones; the denominator is the design effect (Kish, 1965, *Survey Sampling*, section 5.4;
of answers that are unlike sure, n is their effective number, :math:`(\sum \Lambda)^2 / \sum
\Lambda^2` of their precisions, section 11.2). Here the observations are the answers' scores

.. math::
    s = \frac{\partial}{\partial \theta} \log \frac{q(\theta \mid x)}{p(\theta)} .

At the true parameters those of a right posterior have mean 0 over trajectories, whatever the
parameters are; what is not 0 on average is the network's. So each answer is made wider in every
parameter by the root of the design effect before they are multiplied.

Two estimates of :math:`\rho` need no further simulations; each errs to the side of too little, and
the larger one is taken:

* **Neighbours** of a fit: pairs of nearly the same parameters have scores at their own parameters
  that are nearly those of two trajectories of one system. Where a prior is a box, means do not
  leave it, and answers near its edges share more: it is estimated there and elsewhere.
* **Rows**: answers to the n real trajectories scatter by what differs between these. Answers that
  lie much closer together than each of them is wide leave the rest open together; where a parameter
  does nothing, they leave all of it.
"""

from __future__ import annotations

__all__ = [
    "design_effect",
    "dispersion",
    "most_of_alike",
    "shared_by_neighbours",
    "shared_by_rows",
    "widened",
]

import torch
from scipy.stats import chi2
from torch import Tensor

from .mixtures import Mixture, component_log_prob, moment_match

_NEIGHBOURS = 3
_FARTHEST = 3.0  # deviations, beyond which a score says no more
_SURE = 0.05  # chance of rows that share nothing to lie so close together
_EDGE = 1.0  # prior deviations from an edge within which answers share more
_FAINT = 0.1  # precision, in units of the prior's, of what says too little to have a place
_NOTHING = 0.01  # the same, of what may be nothing
_PLACES = 64  # where rows may agree, that are tried
_LOCAL = 2.0  # deviations within which a component belongs to a mode


def design_effect(
    each: Mixture, shared: Tensor, *, bounded: bool, at_edges: Tensor | None = None
) -> Tensor:
    """Return how many times less n answers say together than n that share nothing, ``(D,)``.

    Parameters that answers cannot tell apart get one effect: a ridge that was made wider in one of
    two parameters alone would turn, and lie elsewhere.

    Args:
        each: The answers, whatever a box cuts off, batch shape ``(n,)``.
        shared: What a fit has found, :func:`shared_by_neighbours`, shape ``(D,)``.
        bounded: Whether the prior is a box (constant in these coordinates) or N(0, I).
        at_edges: What it has found where the answers are near an edge of the box; default the same.
    """
    if len(each.loc) < 2:
        return torch.ones_like(each.loc[0, 0])
    at = _agreed(each)
    precision, pull, covariance = _gaussians(each, at, bounded=bounded)
    shared = shared.to(each.loc)
    if bounded and at_edges is not None:
        near = (2 - 2 * _from_edges(at) / _EDGE).clamp(0.0, 1.0)
        shared = shared + near * (at_edges.to(each.loc) - shared)
    share = most_of_alike(torch.maximum(shared, _by_rows(precision, pull)), covariance)
    return 1 + (_effective(precision) - 1) * share


def most_of_alike(share: Tensor, covariance: Tensor) -> Tensor:
    """Return for each parameter the largest share of those that it cannot be told from, ``(D,)``.

    Times the squares of their correlations.

    Args:
        share: Of each parameter, shape ``(D,)``.
        covariance: Of answers, shape ``(n, D, D)``; squares are averaged over these.
    """
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    alike = (covariance / (deviation.unsqueeze(-1) * deviation.unsqueeze(-2))).square().mean(0)
    return (alike * share).amax(-1)


def shared_by_neighbours(each: Mixture, z: Tensor, *, bounded: bool) -> tuple[Tensor, Tensor]:
    """Return the share of the scores' mean square that pairs of near parameters have in common.

    Args:
        each: The answer to every pair's summary, whatever a box cuts off, batch shape ``(N,)``.
        z: Its parameters in standardised coordinates, shape ``(N, D)``.
        bounded: Whether the prior is a box (constant in these coordinates) or N(0, I).

    Returns:
        One share in ``[0, 1]`` for each parameter, shape ``(D,)``; and those near edges of a box,
        where there are any.

    Example:
        >>> z = torch.linspace(-1, 1, 200, dtype=torch.float64)[:, None]
        >>> g = torch.Generator().manual_seed(0)
        >>> noise = torch.randn(2, 200, 1, generator=g, dtype=torch.float64) / 2**0.5
        >>> scale = torch.ones(200, 1, 1, 1, dtype=torch.float64)
        >>> answers = lambda loc: Mixture(0 * loc, loc[:, None], scale)
        >>> own, _ = shared_by_neighbours(answers(z + noise.sum(0)), z, bounded=True)
        >>> common, _ = shared_by_neighbours(answers(z + noise[0] + 0.7), z, bounded=True)
        >>> own.item() < 0.1, 0.3 < common.item() < 0.6
        (True, True)
    """
    if len(z) < 2:
        return z.new_zeros(z.shape[-1]), z.new_zeros(z.shape[-1])
    score = _score(each, z, bounded=bounded).clamp(-_FARTHEST, _FARTHEST)
    apart = torch.cdist(z, z).fill_diagonal_(torch.inf)
    near = apart.topk(min(_NEIGHBOURS, len(z) - 1), largest=False).indices
    common = (score.unsqueeze(1) * score[near]).mean(1)
    square = score.square()
    if not bounded:
        share = _share(common, square, torch.ones_like(z))
        return share, share
    at_edges = (_from_edges(z) < _EDGE).to(z)
    return _share(common, square, 1 - at_edges), _share(common, square, at_edges)


def _share(common: Tensor, square: Tensor, where: Tensor) -> Tensor:
    """Return which share of the squares is in common, where ``where`` is 1; ``(D,)`` of ``(N, D)``.

    Less what chance makes of it.
    """
    count = where.sum(0).clamp_min(2)
    mean = (common * where).sum(0) / count
    spread = (((common - mean) * where).square().sum(0) / (count - 1)).sqrt()
    chance = spread * (2 / count).sqrt()  # each pair counts as a neighbour, too
    return ((mean - chance) / ((square * where).sum(0) / count).clamp_min(1e-12)).clamp(0.0, 1.0)


def _from_edges(z: Tensor) -> Tensor:
    """Return how far values are from the nearer edge of a box, in prior deviations."""
    return 3**0.5 - z.abs()


def _score(mixture: Mixture, z: Tensor, *, bounded: bool) -> Tensor:
    """Return the scores of answers at ``z``, times the answers' deviations, ``(N, D)``."""
    precision = torch.cholesky_inverse(mixture.scale_tril)
    away = (z.unsqueeze(-2) - mixture.loc).unsqueeze(-1)
    pull = -(precision @ away).squeeze(-1)
    height = 0.5 * (pull * away.squeeze(-1)).sum(-1)
    height = height - mixture.scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    share = (mixture.logits + height).softmax(-1)
    score = (share.unsqueeze(-1) * pull).sum(-2) + (0 if bounded else z)
    _, covariance = moment_match(mixture)
    return score * covariance.diagonal(dim1=-2, dim2=-1).sqrt()


def shared_by_rows(each: Mixture, *, bounded: bool) -> Tensor:
    r"""Return the least share that answers to n trajectories of one system have in common.

    In Gaussian terms, with the precision :math:`\Lambda_i` and the mean of each likelihood, and
    their mean m by precision: scores at m have squares that sum to

    .. math::
        (1 - \rho) \Big(\sum_i \Lambda_i - \sum_i \Lambda_i (\sum_j \Lambda_j)^{-1}
        \Lambda_i\Big)

    on average (Cochran, 1954, Biometrics 10). It is the least :math:`\rho` that a chi-squared
    distribution of as many degrees as there are effective answers but one allows at 5 %.

    Args:
        each: The answers, whatever a box cuts off, batch shape ``(n,)``.
        bounded: As of :func:`design_effect`.

    Returns:
        One share in ``[0, 1]`` for each parameter, shape ``(D,)``.

    Example:
        >>> scale = torch.ones(20, 1, 1, 1, dtype=torch.float64)
        >>> answers = lambda loc: Mixture(0 * loc[:, None], loc[:, None, None], scale)
        >>> x = torch.randn(20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> shared_by_rows(answers(x), bounded=True).item()
        0.0
        >>> shared_by_rows(answers(x / 10), bounded=True).item() > 0.9
        True
    """
    if len(each.loc) < 2:
        return torch.zeros_like(each.loc[0, 0])
    precision, pull, _ = _gaussians(each, _agreed(each), bounded=bounded)
    return _by_rows(precision, pull)


def dispersion(each: Mixture, *, bounded: bool) -> tuple[Tensor, Tensor]:
    """Return how far answers to n trajectories lie apart, as a share of what they leave open.

    Args:
        each: The answers, whatever a box cuts off, batch shape ``(n,)``.
        bounded: As of :func:`design_effect`.

    Returns:
        Cochran's statistic per degree of freedom in every parameter, ``(D,)``: near 1 where each
        answer is as sure as it should be, and one system gave them all; and how likely as much is
        then.

    Example:
        >>> scale = torch.ones(6, 1, 1, 1, dtype=torch.float64)
        >>> answers = lambda loc: Mixture(0 * loc[:, None], loc[:, None, None], scale)
        >>> apart, likely = dispersion(answers(torch.tensor([-5.0, 5, -4, 4, -3, 3]).double()),
        ...                            bounded=True)
        >>> round(apart.item()), likely.item() < 1e-6
        (20, True)
    """
    share, degrees = _scatter(*_natural(*moment_match(each), bounded=bounded))
    likely = chi2.sf((share * degrees).cpu().numpy(), degrees.cpu().numpy())
    return share, torch.as_tensor(likely).to(share)


def _by_rows(precision: Tensor, pull: Tensor) -> Tensor:
    share, degrees = _scatter(precision, pull)
    least = torch.as_tensor(chi2.ppf(_SURE, degrees.cpu().numpy())).to(degrees)
    return (1 - share * degrees / least.clamp_min(1e-300)).clamp(0.0, 1.0)


def _scatter(precision: Tensor, pull: Tensor) -> tuple[Tensor, Tensor]:
    """Return the scores' squares by those expected, 1 where nothing is, and their degrees."""
    total = precision.sum(0)
    inverse = torch.linalg.pinv(total, hermitian=True)
    middle = inverse @ pull.sum(0)
    score = (pull - precision @ middle).squeeze(-1)
    expected = (total - (precision @ inverse @ precision).sum(0)).diagonal()
    share = score.square().sum(0) / expected.clamp_min(1e-12)
    degrees = (_effective(precision) - 1).clamp_min(1e-6)
    return torch.where(expected > 1e-12, share, torch.ones_like(share)), degrees


def _effective(precision: Tensor) -> Tensor:
    """Return how many answers of one precision say as much about each parameter, ``(D,)``."""
    own = precision.diagonal(dim1=-2, dim2=-1).clamp_min(0.0)
    return (own.sum(0).square() / own.square().sum(0).clamp_min(1e-300)).clamp_min(1.0)


def _gaussians(each: Mixture, at: Tensor, *, bounded: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Return each likelihood's precision, precision times mean, and each answer's covariance.

    Of an answer with several modes, that of the mode at ``at``.
    """
    far = component_log_prob(at, each.loc, each.scale_tril) - component_log_prob(
        each.loc, each.loc.unsqueeze(-2), each.scale_tril.unsqueeze(-3)
    ).squeeze(-1)
    local = each._replace(logits=each.logits + far / _LOCAL**2)
    mean, covariance = moment_match(local)
    return *_natural(mean, covariance, bounded=bounded), covariance


def _natural(mean: Tensor, covariance: Tensor, *, bounded: bool) -> tuple[Tensor, Tensor]:
    """Return the precision, and precision times mean, of likelihoods by answers' moments."""
    precision = torch.linalg.pinv(covariance, hermitian=True)
    pull = precision @ mean.unsqueeze(-1)
    return (precision, pull) if bounded else _likelihoods(precision, pull)


def _likelihoods(precision: Tensor, pull: Tensor) -> tuple[Tensor, Tensor]:
    """Return answers under N(0, I) without it, by precision and precision times mean.

    What is wider than the prior says nothing.
    """
    values, vectors = torch.linalg.eigh(precision - torch.eye(precision.shape[-1]).to(precision))
    values = values.clamp_min(0.0).unsqueeze(-1)
    said = vectors @ (values * vectors.mT)
    something = values.square() / (values.square() + _NOTHING**2)
    return said, vectors @ (something * (vectors.mT @ pull))


def _agreed(each: Mixture) -> Tensor:
    """Return where all answers together are likeliest, of their components' means, ``(D,)``."""
    means = each.loc.flatten(0, 1)
    places = means[:: max(1, len(means) // _PLACES)]
    apart = component_log_prob(places[:, None], each.loc, each.scale_tril)
    together = (each.logits.log_softmax(-1) + apart).logsumexp(-1).sum(-1)
    return places[together.argmax()]


def widened(each: Mixture, effect: Tensor, *, bounded: bool) -> Mixture:
    r"""Return answers to n trajectories of which the product is as sure as they are together.

    Likelihoods :math:`N(m, S^{-1})` are made wider by the root of the design effect, and stay where
    they are: :math:`S \to F S F` with :math:`F = \operatorname{diag}(\text{effect})^{-1/2}`. Under
    a Gaussian prior that of a component is :math:`N(\mu, \Lambda^{-1}) / N(0, I)`, with :math:`S =
    \Lambda - I` and :math:`S m = \Lambda \mu`, and m is anywhere in directions that it says nothing
    of. So :math:`c = S (S^2 + \epsilon^2 I)^{-1} \Lambda \mu` stays where it is, and the rest
    becomes less by :math:`F^2`:

    .. math::
        \Lambda \mu \to F S F c + F^2 (\Lambda \mu - S c) .

    Args:
        each: The answers, batch shape ``(n,)``.
        effect: Of :func:`design_effect`, shape ``(D,)``.
        bounded: As of :func:`design_effect`.
    """
    if (effect == 1).all():
        return each
    narrower = effect.rsqrt()
    if bounded:
        return each._replace(scale_tril=each.scale_tril / narrower.unsqueeze(-1))
    identity = torch.eye(each.loc.shape[-1]).to(each.loc)
    precision = torch.cholesky_inverse(each.scale_tril)
    said, pull = _likelihoods(precision, precision @ each.loc.unsqueeze(-1))
    place = said @ torch.linalg.solve(said @ said + _FAINT**2 * identity, pull)
    less = narrower.unsqueeze(-1) * said * narrower
    rest = narrower.square().unsqueeze(-1) * (pull - said @ place)
    total = identity + less
    loc = torch.linalg.solve(total, less @ place + rest).squeeze(-1)
    return Mixture(each.logits, loc, torch.linalg.cholesky(torch.linalg.inv(total)))
