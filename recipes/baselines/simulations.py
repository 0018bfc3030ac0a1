"""Draws of causes and parameters, simulated on the recorded commands, and their summaries.

Each draw is told apart from the nominal simulation ``ŷ₀``: with ``d = (y - ŷ₀) / σ`` and its noise,
the trajectory that is summarised has the states ``[d, ŷ₀]`` and the recorded commands.
"""

from __future__ import annotations

__all__ = ["Draws", "drawn", "simulations"]

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from torchrl_bayessim.diagnosis.objective import Point, Unit, parameters_at, strengths_of
from torchrl_bayessim.diagnosis.segments import Segments, cut
from torchrl_bayessim.summaries import SummaryStatistics, cross_correlation, linear_dynamics

from .whole_runs import Array, Runs

_RUNS = 3  # of a draw: one of each kind of excitation, so that the budget makes more draws
_WEAKEST = 0.02  # of an effect's range
_FAR = 1e4  # standard deviations of the noise, beyond which a simulation has diverged


@dataclass(frozen=True, eq=False)
class Draws:
    """Summaries of simulations, and that of the robot.

    Attributes:
        units: The cause of each, ``None`` for none.
        points: What was simulated.
        summaries: Shape ``(N, L)``.
        observed: Shape ``(L,)``.
    """

    units: tuple[Unit | None, ...]
    points: tuple[Point, ...]
    summaries: Tensor
    observed: Tensor


def drawn(runs: Runs, names: Sequence[str], count: int, rng: np.random.Generator) -> list[Point]:
    """Return points from the prior: parameters, and one cause of a random name, place, strength.

    Args:
        runs: The case.
        names: Of causes, all equally likely; ``none`` for none.
        count: The number of points.
        rng: Of the draws.
    """
    size = runs.sets["train"].size
    points = []
    for i in range(count):
        z = np.append(rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), size - 1), 0.0)
        there = [unit for unit in runs.units if unit.name == names[i % len(names)]]
        if not there:
            points.append(Point(z))
            continue
        unit = there[int(rng.integers(len(there)))]
        strength = unit.high * np.exp(rng.uniform(np.log(_WEAKEST), 0.0))
        sign = rng.choice([-1.0, 1.0]) if unit.low < 0 else 1.0
        points.append(Point(z, {unit: float(sign * strength)}))
    return points


def simulations(
    runs: Runs, names: Sequence[str], *, budget: int, least: int, rng: np.random.Generator
) -> Draws:
    """Return as many draws as so many simulated time steps make, and at least some.

    Args:
        runs: The case.
        names: Of causes, all equally likely; ``none`` for none.
        budget: Time steps.
        least: Draws at least, whatever the budget.
        rng: Of draws and noise.
    """
    logs = [log for part in runs.logs.values() for log in part][:_RUNS]
    segments = cut(logs, min(len(log) for log in logs) - 1)
    price = len(segments) * segments.horizon * runs.predictor.substeps
    points = drawn(runs, names, max(least, budget // price), rng)
    nominal = Point(np.zeros(runs.sets["train"].size))
    base, *residuals = _residuals(runs, segments, [nominal, *points])
    noise = rng.standard_normal((len(residuals), *base.shape))
    apart = np.concatenate([base[None] / runs.noise, (base - residuals) / runs.noise + noise])
    alive = np.abs(np.nan_to_num(apart, nan=np.inf)).max((1, 2, 3)) < _FAR
    summaries = _summarised(runs, segments, np.nan_to_num(np.clip(apart, -_FAR, _FAR)))
    kept = [p for p, fine in zip(points, alive[1:].tolist(), strict=True) if fine]
    return Draws(
        tuple(next(iter(p.strengths), None) for p in kept),
        tuple(kept),
        summaries[1:][torch.from_numpy(alive[1:])],
        summaries[0],
    )


def _residuals(runs: Runs, segments: Segments, points: Sequence[Point]) -> Array:
    theta = parameters_at(runs.system.prior, np.stack([p.z for p in points]))
    strengths = strengths_of(points, runs.system.robot)
    return runs.predictor.residuals(segments, theta, strengths)


def _summarised(runs: Runs, segments: Segments, apart: NDArray[np.float64]) -> Tensor:
    """Return summaries, ``(N, L)``, of deviations ``(N, S, H, C)``."""
    theta = parameters_at(runs.system.prior, np.zeros((1, runs.sets["train"].size)))
    qpos, qvel = runs.predictor.states(segments, theta)
    motion = runs.predictor.sensing.values(qpos, qvel)
    motion = np.broadcast_to(motion / (motion.std((0, 1, 2)) + 1e-9), apart.shape)
    states = torch.from_numpy(np.concatenate([apart, motion], -1))
    at = segments.history
    commands = torch.from_numpy(segments.ctrl[:, at + 1 : at + segments.horizon])
    batch = states.shape[0], states.shape[1], states.shape[2] - 1
    done = torch.zeros(*batch, 1, dtype=torch.bool)
    done[:, :, -1] = True
    trajectories = TensorDict(
        {
            "observation": states[:, :, :-1],
            "action": commands.expand(*batch, -1),
            "next": {"observation": states[:, :, 1:], "done": done},
        },
        batch,
    )
    return SummaryStatistics(linear_dynamics, cross_correlation).together(trajectories)
