r"""Actions that tell the parameters apart: the experiment with the most expected information.

What is collected decides what can be learned. What an experiment tells is the mutual information of
parameters and measurements (Lindley, 1956), the expected divergence of the posterior from what is
believed. Where the posterior is nearly Gaussian it is, in nats,

.. math::
    I \approx \operatorname{E}_\theta \tfrac12 \log\det\big(\mathbb 1 + C F(\theta)\big),
    \qquad F = \sum_i \frac{\nabla y_i \nabla y_i^T}{\sigma_i^2}

with the covariance :math:`C` of what is believed and Fisher's information matrix :math:`F` of
outputs :math:`y_i` that are measured with independent noise of deviation :math:`\sigma_i` (Chaloner
& Verdinelli, 1995; Long et al., 2013, https://doi.org/10.1016/j.cma.2013.02.017):
`expected_information`. It takes D + 1 simulations for each draw of D parameters. The search takes
one: it compares experiments by the entropy of a Gaussian with the covariance of the outputs
:math:`y_1 \dots y_P` under P draws,

.. math::
    B = \tfrac12 \log\det\Big(\mathbb 1 + \tfrac{1}{P - 1}
    \sum_p \tfrac{(y_p - \bar y)}{\sigma} \tfrac{(y_p - \bar y)^T}{\sigma}\Big)

which no distribution of that covariance exceeds, `information_bound`: both are the same where
outputs are linear in Gaussian parameters, and where they are not the bound may be several times the
information, as bent outputs fill more directions than there are parameters. At most P - 1
directions count, so the determinant is that of a P by P matrix, or of one with a row for each
reading where those are fewer.
The actions are found by the cross-entropy method on smooth sequences (Rubinstein & Kroese, 2004).
"""

from __future__ import annotations

__all__ = [
    "Experiment",
    "between_knots",
    "excite",
    "expected_information",
    "information_bound",
    "replayed",
]

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from .counts import check_count
from .envs.task import Task
from .errors import message
from .kinds import check_function, check_kind, real_numbers
from .physics.protocol import Physics
from .randomness import generator
from .replay import Replay
from .replay_actions import ReplayActions

_ELITE = 0.125  # share of the candidates that the next ones are drawn around
_STEP = 0.01  # of finite differences, in deviations of the draws: small beside most posteriors

Simulate = Callable[[Tensor, Tensor], Tensor]
"""Parameters ``(P, D)`` and actions ``(S, T, A)`` to outputs ``(P, S, T, Y)``."""


class Experiment(NamedTuple):
    """Actions to play, and what they are expected to tell.

    Attributes:
        actions: Shape ``(T, A)``.
        nats: Expected information about the parameters, as of `expected_information`.
    """

    actions: Tensor
    nats: float

    def policy(self, env: EnvBase, *, step_key: NestedKey = "step_count") -> ReplayActions:
        """Return the policy that plays the actions from every reset on, in all environments.

        For ``env.rollout`` and for collectors. After the last action it is held: end episodes there
        with ``StepCounter(max_steps=len(experiment.actions))``.

        Args:
            env: Where it will act.
            step_key: Entry that counts the steps of the episode (``StepCounter``'s).

        Raises:
            TypeError: ``env`` is no environment.
            ValueError: Its actions have another shape, or nothing counts its steps.

        Example:
            >>> from torchrl.envs import StepCounter, TransformedEnv
            >>> from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv
            >>> env = TransformedEnv(PendulumEnv(2), StepCounter())
            >>> experiment = Experiment(torch.tensor([[0.5], [-1.0]]), nats=0.0)
            >>> env.rollout(2, experiment.policy(env))["action"].squeeze(-1)
            tensor([[ 0.5000, -1.0000],
                    [ 0.5000, -1.0000]])
        """
        check_kind("an environment", env, EnvBase)
        action_key, observed = env.action_key, env.full_observation_spec
        spec = env.full_action_spec[action_key]
        shape = spec.shape[len(env.batch_size) :]
        if shape != self.actions.shape[1:]:
            expected = f"an environment with actions of shape {tuple(self.actions.shape[1:])}"
            raise ValueError(message(expected, tuple(shape)))
        known = list(observed.keys(include_nested=True, leaves_only=True))
        if step_key not in known:
            hint = "TransformedEnv(env, StepCounter())"
            expected = "the key of what counts the episode's steps"
            raise ValueError(message(expected, step_key, available=known, hint=hint))
        actions = self.actions.to(spec.device, spec.dtype)
        return ReplayActions(actions[None], step_key=step_key, action_key=action_key)


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
    theta = _draws(theta)
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


def _draws(theta: object) -> Tensor:
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

    Candidates are compared by `information_bound`, which takes one simulation for each draw of
    parameters; what the best one tells is then asked of `expected_information`.

    Args:
        simulate: See `Simulate`; `replayed` makes one of a MuJoCo task.
        theta: Draws from what is believed, shape ``(P, D)``: 16 to 64 are enough.
        noise: Standard deviation of each output's measurement, shape ``(Y,)``.
        bounds: Lowest and highest actions, finite, each of shape ``(A,)``.
        steps: Length T of the experiment.
        knots: Actions are linear between so many points in time.
        candidates: Sequences that are simulated per round, under all parameters: the best so far
            and new ones.
        rounds: Of the search.
        seed: Same seed, same experiment.

    Raises:
        TypeError: For counts that are no whole numbers, bounds, noise or parameters that are no
            numbers, and what is no simulator.
        ValueError: For counts that are not positive, fewer than 2 knots or candidates, parameters
            that are not finite or fewer than 2, actions without bounds, and lowest ones that are
            not below the highest.

    Example:
        >>> simulate = lambda theta, actions: theta[:, None, None] * actions.cumsum(1)
        >>> found = excite(simulate, torch.linspace(1, 2, 8)[:, None], noise=torch.tensor([1.0]),
        ...                bounds=(-torch.ones(1), torch.ones(1)), steps=20)
        >>> bool(found.actions.mean().abs() > 0.6)  # push one way as long as possible
        True
    """
    for name, value in {"steps": steps, "rounds": rounds}.items():
        check_count(name, value)
    for name, value in {"knots": knots, "candidates": candidates}.items():
        check_count(name, value, least=2)  # one candidate would be the best so far, never a new one
    check_function("simulate, a function of parameters and actions", simulate)
    theta = _draws(theta)
    noise = real_numbers("deviations of the noise, shape (Y,)", noise)
    low, high = _bounds(bounds)
    g = generator(seed, "excitation")
    mean = torch.zeros(knots, len(low), dtype=torch.float64)
    deviation = torch.ones_like(mean)
    best, most = mean, -1.0
    for _ in range(rounds):
        points = mean + deviation * torch.randn(candidates, *mean.shape, generator=g).double()
        points = torch.cat([points[1:], best[None]]).clamp(-1, 1)  # the best stays
        outputs = simulate(theta, between_knots(points, low, high, steps))
        bound = information_bound(outputs, noise)
        order = bound.argsort(descending=True)
        if bound[order[0]] > most:
            best, most = points[order[0]], bound[order[0]].item()
        elite = points[order[: max(2, round(_ELITE * candidates))]]
        mean, deviation = elite.mean(0), elite.std(0) + 0.05
    actions = between_knots(best[None], low, high, steps)
    nats = expected_information(simulate, theta, actions, noise=noise)
    return Experiment(actions[0], nats.item())


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
    if not (low.isfinite().all() and high.isfinite().all()):
        hint = "the range that the experiment may use"
        raise ValueError(message(f"{expected}, finite", (low.tolist(), high.tolist()), hint=hint))
    return low, high


def between_knots(points: Tensor, low: Tensor, high: Tensor, steps: int) -> Tensor:
    """Return actions that are linear between points in time, shape ``(S, T, A)``.

    Args:
        points: The knots, evenly spaced in time, between -1 for ``low`` and 1 for ``high``, shape
            ``(S, knots, A)``.
        low: Lowest actions, shape ``(A,)``.
        high: Highest actions, shape ``(A,)``.
        steps: Length T.

    Example:
        >>> points = torch.tensor([-1.0, 1.0, 0.0]).reshape(1, 3, 1)
        >>> between_knots(points, torch.zeros(1), 4 * torch.ones(1), 5).flatten()
        tensor([0., 2., 4., 3., 2.])
    """
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
