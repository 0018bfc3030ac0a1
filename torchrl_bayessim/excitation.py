r"""Actions that tell the parameters apart: the experiment with the most expected information.

What is collected decides what can be learned. Let the outputs of an experiment under parameters
:math:`\theta_1 \dots \theta_P`, drawn from what is believed so far, be :math:`y_p`, measured with
independent noise of deviation :math:`\sigma`. With the Gaussian that has the outputs' covariance,
the mutual information of parameters and measurements is

.. math::
    I = \tfrac12 \log\det\Big(\mathbb 1 + \tfrac{1}{P - 1}
    \sum_p \tfrac{(y_p - \bar y)}{\sigma} \tfrac{(y_p - \bar y)^T}{\sigma}\Big)

(Lindley, 1956; for small deviations of the parameters this is the D-optimality of Fisher's
information matrix). At most P - 1 directions count, so the determinant is that of a P by P matrix,
or of one with a row for each reading where those are fewer.
The actions are found by the cross-entropy method on smooth sequences (Rubinstein & Kroese, 2004).
"""

from __future__ import annotations

__all__ = ["Experiment", "excite", "expected_information", "replayed"]

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .counts import check_count
from .envs.task import Task
from .errors import message
from .kinds import check_function, check_kind, real_numbers
from .physics.protocol import Physics
from .randomness import generator
from .replay import Replay

_ELITE = 0.125  # share of the candidates that the next ones are drawn around

Simulate = Callable[[Tensor, Tensor], Tensor]
"""Parameters ``(P, D)`` and actions ``(S, T, A)`` to outputs ``(P, S, T, Y)``."""


class Experiment(NamedTuple):
    """Actions to play, and what they are expected to tell.

    Attributes:
        actions: Shape ``(T, A)``.
        nats: Expected information about the parameters.
    """

    actions: Tensor
    nats: float


def expected_information(outputs: Tensor, noise: Tensor) -> Tensor:
    """Return the expected information of each experiment in nats, shape ``(S,)``.

    Args:
        outputs: Under each of P parameter vectors, shape ``(P, S, T, Y)``. An experiment in which
            a simulation diverges tells nothing.
        noise: Standard deviation of each output's measurement, shape ``(Y,)``.

    Example:
        >>> theta = torch.linspace(-1, 1, 9)
        >>> seen, unseen = theta, 0 * theta
        >>> outputs = torch.stack([seen, unseen], 1)[..., None, None]
        >>> expected_information(outputs, torch.tensor([0.1])).round(decimals=2)
        tensor([1.9300, 0.0000], dtype=torch.float64)
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
    y = torch.where(good[:, None, None], y, 0.0)
    y = y - y.mean(1, keepdim=True)
    rows = y if y.shape[1] <= y.shape[2] else y.mT  # det(1 + y y^T) = det(1 + y^T y)
    spread = torch.linalg.eigvalsh(rows @ rows.mT / (y.shape[1] - 1)).clamp(min=0)
    return 0.5 * spread.log1p().sum(-1)


def excite(
    simulate: Simulate,
    theta: Tensor,
    *,
    noise: Tensor,
    bounds: tuple[Tensor, Tensor],
    steps: int,
    knots: int = 10,
    candidates: int = 64,
    rounds: int = 4,
    seed: int = 0,
) -> Experiment:
    """Return the open-loop experiment that is expected to tell most.

    Args:
        simulate: See `Simulate`; `replayed` makes one of a MuJoCo task.
        theta: Draws from what is believed, shape ``(P, D)``: 16 to 64 are enough.
        noise: Standard deviation of each output's measurement, shape ``(Y,)``.
        bounds: Lowest and highest actions, each of shape ``(A,)``.
        steps: Length T of the experiment.
        knots: Actions are linear between so many points in time.
        candidates: Sequences that are simulated per round, under all parameters.
        rounds: Of the search.
        seed: Same seed, same experiment.

    Raises:
        TypeError: For counts that are no whole numbers, bounds, noise or parameters that are no
            numbers, and what is no simulator.
        ValueError: For counts that are not positive, fewer than 2 knots, parameters that are not
            finite or fewer than 2, and lowest actions that are not below the highest.

    Example:
        >>> simulate = lambda theta, actions: theta[:, None, None] * actions.cumsum(1)
        >>> found = excite(simulate, torch.linspace(1, 2, 8)[:, None], noise=torch.tensor([1.0]),
        ...                bounds=(-torch.ones(1), torch.ones(1)), steps=20)
        >>> bool(found.actions.mean().abs() > 0.6)  # push one way as long as possible
        True
    """
    counts = {"steps": steps, "candidates": candidates, "rounds": rounds}
    for name, value in counts.items():
        check_count(name, value)
    check_count("knots", knots, least=2)
    check_function("simulate, a function of parameters and actions", simulate)
    theta = real_numbers("draws of parameters, shape (P, D)", theta)
    noise = real_numbers("deviations of the noise, shape (Y,)", noise)
    if theta.ndim != 2 or len(theta) < 2 or not theta.isfinite().all():
        got = f"shape {tuple(theta.shape)}"
        raise ValueError(message("two or more finite draws of parameters, shape (P, D)", got))
    low, high = _bounds(bounds)
    g = generator(seed, "excitation")
    mean = torch.zeros(knots, len(low), dtype=torch.float64)
    deviation = torch.ones_like(mean)
    best, most = mean, -1.0
    for _ in range(rounds):
        points = mean + deviation * torch.randn(candidates, *mean.shape, generator=g).double()
        points = torch.cat([points[1:], best[None]]).clamp(-1, 1)  # the best stays
        nats = expected_information(simulate(theta, _actions(points, low, high, steps)), noise)
        order = nats.argsort(descending=True)
        if nats[order[0]] > most:
            best, most = points[order[0]], nats[order[0]].item()
        elite = points[order[: max(2, round(_ELITE * candidates))]]
        mean, deviation = elite.mean(0), elite.std(0) + 0.05
    return Experiment(_actions(best[None], low, high, steps)[0], most)


def _bounds(bounds: object) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest actions, each of shape ``(A,)``."""
    expected = "bounds=(lowest, highest) actions, each of shape (A,)"
    check_kind(expected, bounds, tuple, list)
    pair: Any = bounds
    if len(pair) != 2:
        raise ValueError(message(expected, f"{len(pair)} parts"))
    low, high = (real_numbers(expected, bound).double() for bound in pair)
    if low.ndim != 1 or low.shape != high.shape or not len(low) or not (low < high).all():
        raise ValueError(message(f"{expected}, low < high", (low.tolist(), high.tolist())))
    return low, high


def _actions(points: Tensor, low: Tensor, high: Tensor, steps: int) -> Tensor:
    """Return sequences ``(S, T, A)`` through points ``(S, knots, A)`` between -1 and 1."""
    smooth = torch.nn.functional.interpolate(
        points.mT, size=steps, mode="linear", align_corners=True
    ).mT
    return (low + (smooth + 1) / 2 * (high - low)).float()


def replayed(
    task: str | Task,
    start: Mapping[str, Tensor],
    physics: Physics,
    *,
    outputs: Sequence[str] = ("qpos", "qvel"),
) -> Simulate:
    """Return a simulator of experiments on a MuJoCo task, all from one start state.

    Args:
        task: A name or a task, as of `Replay`.
        start: Components of the start state, each of shape ``(size,)``, such as ``qpos``.
        physics: What the columns of theta set.
        outputs: What is measured, side by side in this order.
    """

    def simulate(theta: Tensor, actions: Tensor) -> Tensor:
        state = {name: value.expand(len(actions), -1) for name, value in start.items()}
        experiments = Replay(
            task, {**state, "action": actions}, physics=physics, outputs=tuple(outputs)
        )
        found = experiments(theta)
        return torch.cat([found[name] for name in outputs], -1)

    return simulate
