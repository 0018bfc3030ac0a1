"""Where parameters come from: anything that samples.

A *source* gives parameter vectors θ of shape ``(*shape, D)``: a prior, a posterior, a
``torch.distributions.Distribution``, or one of those below. Domain randomisation (Tobin et al.
2017, https://arxiv.org/abs/1703.06907) draws from a prior; BayesSim (Ramos, Possas and Fox 2019,
https://arxiv.org/abs/1906.01728) draws from the posterior instead.
"""

from __future__ import annotations

__all__ = [
    "Defensive",
    "Empirical",
    "Grid",
    "Source",
    "check_prior_share",
    "check_source",
    "draw",
    "names_of",
]

import inspect
from numbers import Real
from typing import Any, Protocol

import torch
from torch import Tensor

from .errors import message
from .randomness import generator, isolated


class Source(Protocol):
    """Anything with ``sample(shape)``, or ``sample(shape, generator=)``, of shape ``(*shape, D)``.

    A source that takes no generator is sampled with the global generators seeded, and restored.
    """

    # *_ and **_ leave room for the generator and for what a library adds to its own `sample`
    def sample(self, shape: torch.Size, /, *_: Any, **__: Any) -> Tensor:
        """Return independent draws, shape ``(*shape, D)``."""
        ...


def draw(source: Source, count: int, *, key: tuple[int | str, ...]) -> Tensor:
    """Return ``count`` draws, float32 on the CPU, as a function of ``key`` alone.

    Args:
        source: Where to draw from.
        count: The number ``N`` of draws.
        key: What the draws are for, e.g. ``(seed, "theta", 3)``; see `randomness`.

    Returns:
        Finite values, shape ``(N, D)``.

    Raises:
        TypeError: ``source`` cannot be sampled.
        ValueError: The source gave another shape, or values that are not finite.

    Example:
        >>> source = torch.distributions.Uniform(torch.zeros(2), torch.ones(2))
        >>> bool((draw(source, 3, key=(0, "a")) == draw(source, 3, key=(0, "a"))).all())
        True
    """
    check_source(source)
    shape = torch.Size((count,))
    with torch.no_grad():
        if "generator" in inspect.signature(source.sample).parameters:
            theta = source.sample(shape, generator=generator(*key))
        else:
            with isolated(*key):
                theta = source.sample(shape)
    if theta.ndim != 2 or len(theta) != count:
        raise ValueError(
            message(
                f"draws of shape ({count}, D) from {type(source).__name__}.sample",
                tuple(theta.shape),
                hint="one parameter still needs an axis of its own, (count, 1)",
            )
        )
    if not theta.isfinite().all():
        bad = theta[~theta.isfinite().all(-1)][0].tolist()
        raise ValueError(message(f"finite draws from {type(source).__name__}.sample", bad))
    return theta.to("cpu", torch.float32)


def check_source(source: object) -> None:
    """Refuse what cannot be sampled.

    Raises:
        TypeError: ``source`` has no method ``sample``.
    """
    if not callable(getattr(source, "sample", None)):
        hint = "a prior, a posterior, a torch distribution, or randomizer.pin(theta)"
        if hasattr(source, "condition"):  # what it samples depends on the real data
            hint = "posterior.condition(summaries of the real trajectories)"
        raise TypeError(message("a source with sample(shape)", type(source).__name__, hint=hint))


def check_prior_share(share: float) -> None:
    """Refuse what is no probability of a prior draw.

    Raises:
        ValueError: It is no number between 0 and 1.
    """
    if not (isinstance(share, Real) and 0 <= share <= 1):
        raise ValueError(message("prior_share to be a probability, 0 to 1", share))


def names_of(source: object) -> tuple[str, ...] | None:
    """Return the parameters' names if the source knows them."""
    names = getattr(source, "names", None)
    return None if names is None else tuple(names)


class Defensive:
    """A source mixed with the prior: ``(1 - w) q(θ) + w p(θ)``.

    However overconfident ``q`` is, training still meets the whole prior, and the importance
    weights ``p / mixture`` stay below ``1 / w`` (Hesterberg 1995, defensive mixtures).

    Args:
        source: The distribution to defend against, q.
        prior: What it is mixed with, p.
        prior_share: The probability w of a draw from the prior, between 0 and 1.

    Raises:
        ValueError: ``prior_share`` is not a probability, or the two name other parameters.

    Example:
        >>> near, wide = Empirical(torch.zeros(1, 1)), Empirical(torch.ones(1, 1))
        >>> draw(Defensive(near, wide, 0.1), 10_000, key=(0,)).mean().item()
        0.09...
    """

    def __init__(self, source: Source, prior: Source, prior_share: float) -> None:
        check_prior_share(prior_share)
        names = [names_of(source), names_of(prior)]
        if None not in names and names[0] != names[1]:
            raise ValueError(message(f"a prior over {names[0]}, as the source", names[1]))
        self.source, self.prior, self.prior_share = source, prior, prior_share
        self.names = names[0] or names[1]

    def sample(self, shape: torch.Size, *, generator: torch.Generator) -> Tensor:
        """Return independent draws from the mixture, shape ``(*shape, D)``."""
        count = torch.Size(shape).numel()
        device = generator.device
        key = int(torch.randint(2**62, (), generator=generator, device=device))
        unit = torch.rand(count, generator=generator, device=device).cpu()
        from_prior = unit < self.prior_share
        theta = draw(self.source, count, key=(key, "source"))
        theta[from_prior] = draw(self.prior, count, key=(key, "prior"))[from_prior]
        return theta.reshape(*shape, -1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the mixture's log-density, shape ``(*)``; both parts must have one."""
        parts: list[Any] = [self.source, self.prior]
        weights = torch.tensor([1 - self.prior_share, self.prior_share]).log()
        terms = [p.log_prob(value) + w for p, w in zip(parts, weights, strict=True)]
        return torch.logaddexp(*terms)


class Empirical:
    """Given parameter vectors, each as likely as any other; drawn with replacement.

    Args:
        theta: The vectors, shape ``(M, D)``.
        names: The parameters' names, if known.

    Raises:
        ValueError: ``theta`` is not ``(M, D)`` with ``M > 0``, or not finite.

    Example:
        >>> draw(Empirical([[0.1], [0.2]]), 4, key=(0,)).shape
        torch.Size([4, 1])
    """

    def __init__(self, theta: Any, *, names: tuple[str, ...] | None = None) -> None:
        self.theta, self.names = _rows(theta), names

    def sample(self, shape: torch.Size, *, generator: torch.Generator) -> Tensor:
        """Return rows drawn with replacement, shape ``(*shape, D)``."""
        count, device = len(self.theta), generator.device
        index = torch.randint(count, tuple(shape), generator=generator, device=device)
        return self.theta[index.cpu()]


class Grid:
    """Row ``i mod M`` for environment ``i``, in every episode: one environment per grid point.

    For robustness curves: build as many environments as there are points, or fewer and several
    grids in turn.

    Args:
        theta: The points, shape ``(M, D)``.
        names: The parameters' names, if known.

    Raises:
        ValueError: ``theta`` is not ``(M, D)`` with ``M > 0``, or not finite.

    Example:
        >>> Grid([[0.1], [0.2]]).rows(torch.tensor([0, 1, 2]))
        tensor([[0.1000],
                [0.2000],
                [0.1000]])
    """

    def __init__(self, theta: Any, *, names: tuple[str, ...] | None = None) -> None:
        self.theta, self.names = _rows(theta), names

    def rows(self, environments: Tensor) -> Tensor:
        """Return the rows of these environments, shape ``(*environments.shape, D)``."""
        return self.theta[environments % len(self.theta)]


def _rows(theta: Any) -> Tensor:
    rows = torch.as_tensor(theta, dtype=torch.float32).detach().cpu()
    if rows.ndim != 2 or not rows.numel():
        raise ValueError(message("rows of shape (M, D), M and D > 0", tuple(rows.shape)))
    if not rows.isfinite().all():
        raise ValueError(message("finite rows", rows[~rows.isfinite().all(-1)][0].tolist()))
    return rows
