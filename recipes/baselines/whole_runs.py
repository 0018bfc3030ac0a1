"""What every baseline is given: the folder of a case, its runs simulated whole, and no label."""

from __future__ import annotations

__all__ = ["Runs", "mean_square", "whole_runs"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrl_bayessim.diagnosis.noise import assumed_noise
from torchrl_bayessim.diagnosis.objective import Objective, Unit, origin, units_of
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.segments import Segments, cut
from torchrl_bayessim.diagnosis.splits import split
from torchrl_bayessim.diagnosis.time_steps import with_fewest_steps
from torchrl_bayessim.diagnosis.whitening import Whitening
from torchrl_bayessim.effects.catalogue import CATALOGUE, effect
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

Array = NDArray[np.float64]
_CHECKS = 50  # compared rows of a run
_HISTORY = 0.4  # s of commands that delays look back at


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs that are simulated from their first row to their last, with the recorded commands.

    Attributes:
        system: The nominal system.
        logs: Of each split, ``train``, ``validation`` and ``test``: those of the diagnosis.
        noise: Standard deviation of each channel's noise.
        sets: Objectives of each split; their innovations are residuals over ``noise``.
        units: The effects that may be named in all their forms, random ones left out.
    """

    system: System
    logs: Mapping[str, Sequence[Log]]
    noise: Array
    sets: Mapping[str, Objective]
    units: tuple[Unit, ...]

    @property
    def predictor(self) -> Predictor:
        """Simulates."""
        return self.sets["train"].predictor


def whole_runs(
    system: System, logs: Sequence[Log], *, noise: Mapping[str, float] | None = None
) -> Runs:
    """Return the runs of a case, ready to be simulated under any parameters and effects.

    Args:
        system: The nominal system.
        logs: Of the robot.
        noise: Standard deviation of each channel's noise, as the diagnosis estimated it; default
            what is told, or what differences say.
    """
    predictor = Predictor(system, threads=1)
    parts = split(logs)
    if noise is None:
        sd = assumed_noise(predictor, logs)
    else:
        sd = np.array([noise[channel] for channel in system.robot.channels])
    steps = min(len(log) for log in logs) - 1
    history = round(_HISTORY / system.control_dt)
    runs = {n: cut(part, steps, history=history, checks=_CHECKS) for n, part in parts.items()}
    names = list(CATALOGUE) if system.effects is None else system.effects
    seconds = max(len(log) for log in logs) * system.control_dt
    forms = [form for name in names for form in effect(name).forms(seconds)]
    every = units_of(forms, system.robot)
    units = tuple(unit for unit in every if not unit.effect.random)
    predictor = with_fewest_steps(predictor, runs["train"], units, z=origin(system.prior), noise=sd)
    sets = {
        name: Objective(predictor, system.prior, some, _divided_by(sd, some))
        for name, some in runs.items()
    }
    return Runs(system, parts, sd, sets, units)


def mean_square(innovations: Array) -> float:
    """Return the mean squared residual in units of the noise: 1 for a perfect simulator."""
    return float(np.mean(innovations**2))


def _divided_by(noise: Array, runs: Segments) -> Whitening:
    """Return no whitening but a division: what whole-run fits in the literature do."""
    count, size = len(runs), len(runs.checked) * len(noise)
    scale = np.tile(noise, len(runs.checked))
    return Whitening(
        inverse=np.broadcast_to(np.diag(1 / scale), (count, size, size)),
        weights=np.ones(count),
        spread=np.broadcast_to(noise, (count, len(runs.checked), len(noise))),
        drift=np.zeros((count, size)),
        curvature=0.0,
    )
