"""What one who knows the parameters, the noise and every strength would name.

At the true parameters every effect at every place is simulated at many strengths, and the most
likely of all is named: ``argmax_e max_s log p(y | θ, e, s)`` on segments of the logs, whitened by
the true noise. What separates the diagnosis from it is what not knowing costs; what separates it
from one is in the data and in the catalogue's forms. It runs when the labels are open.
"""

from __future__ import annotations

__all__ = ["named_by_oracle"]

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from baselines.strength_grid import best_strengths, on_grid

from torchrl_bayessim.diagnosis.objective import Objective, Unit, units_of
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.diagnosis.time_steps import with_fewest_steps
from torchrl_bayessim.diagnosis.whitening import whitening
from torchrl_bayessim.effects.catalogue import CATALOGUE, effect
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

_HORIZON, _SEGMENTS, _HISTORY = 20, 40, 0.4  # control steps, of all logs, s
_LEVELS = np.geomspace(0.003, 1.0, 8)  # of an effect's range
_FINER = np.geomspace(0.45, 2.2, 7)  # times the best of them
_ROUNDS = ((8, _FINER), (4, _FINER**0.25))  # how many go on, and where they look


def named_by_oracle(system: System, logs: Sequence[Log], label: Mapping[str, Any]) -> str:
    """Return the name of the most likely effect.

    Args:
        system: The nominal system of the case.
        logs: Its logs.
        label: What is true: ``theta`` by parameter, ``noise`` of the tangent coordinates.
    """
    objective, units, z = _known(system, logs, label)
    best = _likeliest(objective, z, on_grid(units, _LEVELS))
    for count, factors in _ROUNDS:
        tried = [(u, s * float(f)) for u, (_, s) in list(best.items())[:count] for f in factors]
        best = _likeliest(objective, z, tried)
    return next(iter(best)).name


def _known(
    system: System, logs: Sequence[Log], label: Mapping[str, Any]
) -> tuple[Objective, list[Unit], np.ndarray]:
    history = round(_HISTORY / system.control_dt)
    segments = cut(logs, _HORIZON, history=history, burn_in=history, most=_SEGMENTS)
    noise = np.array(label["noise"])[list(system.channel_index)]
    units = units_of([effect(name) for name in CATALOGUE], system.robot)
    units = [unit for unit in units if not unit.effect.random]
    z, theta = np.zeros(1), np.zeros(0)
    if system.prior is not None:
        theta = np.array([label["theta"][name] for name in system.prior.names])
        z = np.append(system.prior.standardize(torch.from_numpy(theta)).double().numpy(), 0.0)
    predictor = with_fewest_steps(Predictor(system, threads=1), segments, units, z=z, noise=noise)
    white = whitening(predictor, segments, theta, noise)
    return Objective(predictor, system.prior, segments, white), units, z


def _likeliest(
    objective: Objective, z: np.ndarray, tried: Sequence[tuple[Unit, float]]
) -> dict[Unit, tuple[float, float]]:
    """Return misfit and strength of each unit at its best, the likeliest unit first."""
    best = best_strengths(objective, z, tried)
    return dict(sorted(best.items(), key=lambda item: item[1][0]))
