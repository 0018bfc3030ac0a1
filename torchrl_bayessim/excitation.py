r"""Actions that tell the parameters apart: the experiment with the most expected information.

What is collected decides what can be learned. The search compares experiments by
:func:`.information.information_bound`, which takes one simulation for each draw of the parameters,
and what the best one tells is that of :func:`.information.expected_information`. The actions are
found by the cross-entropy method on smooth sequences (Rubinstein & Kroese, 2004).
"""

from __future__ import annotations

__all__ = [
    "Experiment",
    "between_knots",
    "excite",
    "replayed",
]

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from .counts import check_count
from .envs.task import Task
from .errors import message
from .information import Simulate, draws_of_parameters, expected_information, information_bound
from .kinds import check_function, check_kind, real_numbers
from .physics.protocol import Physics
from .randomness import generator
from .replay import Replay
from .replay_actions import ReplayActions

_ELITE = 0.125  # share of the candidates that the next ones are drawn around


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
    theta = draws_of_parameters(theta)
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
