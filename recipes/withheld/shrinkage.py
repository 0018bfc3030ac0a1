"""How far the gap truly shrinks: the simulator that was found, on noise-free motions it never saw.

``1 - E_effects / E_refit``, where ``E`` is the mean squared innovation of the fitted simulator
without and with the effects that were named. There is no noise, so there is no floor. This runs
after the labels are opened, and uses the package: the fitted simulator is the package's.
"""

from __future__ import annotations

__all__ = ["true_shrinkage"]

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_bayessim.diagnosis.objective import Point, strengths_of, units_of
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.diagnosis.whitening import whitening
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

Array = NDArray[np.float64]
_HISTORY = 0.4  # s of commands before a segment


def true_shrinkage(
    system: System, logs: Sequence[Log], unseen: Path, report: Mapping[str, Any]
) -> float | None:
    """Return the share of the gap that the named effects remove; ``None`` where none was named.

    Args:
        system: The nominal system of the case.
        logs: What the diagnosis saw, for what was measured.
        unseen: File with the motions.
        report: Of the diagnosis.
    """
    if not report.get("effects"):
        return None
    robot = system.robot
    names = [found["name"] for found in report["effects"]]
    units = {(u.name, u.where): u for u in units_of([effect(name) for name in names], robot)}
    on = {
        units[found["name"], where]: strength
        for found in report["effects"]
        for where, strength in found["strengths"].items()
    }
    place = np.zeros(1)
    strengths = strengths_of([Point(place), Point(place, on)], robot)
    theta = np.array(
        [[p[kind] for p in report["parameters"]] for kind in ("without_effects", "with_effects")]
    )
    horizon = report["gap"]["horizon_steps"]
    history = math.ceil(_HISTORY / system.control_dt)
    segments = cut(_logs(unseen, logs[0], system), horizon, history=history, burn_in=history)
    predictor = Predictor(system, threads=1)
    noise = np.array([report["audit"]["noise"][name] for name in robot.channels])
    white = whitening(predictor, segments, theta[0], noise)
    errors = (white(predictor.residuals(segments, theta, strengths)) ** 2).reshape(2, -1)
    refit, after = np.nan_to_num(errors, nan=1e6).mean(1)
    return float(1 - after / refit)


def _logs(unseen: Path, like: Log, system: System) -> list[Log]:
    """Return the noise-free motions as logs of which as much was measured as of ``like``."""
    made = []
    with np.load(unseen) as arrays:
        for i in range(len(arrays.files) // 2):
            clean, ctrl = (torch.from_numpy(arrays[f"{kind}{i}"]) for kind in ("clean", "ctrl"))
            nv = clean.shape[1] // 2
            made.append(
                Log(
                    name=f"unseen{i}",
                    time=system.control_dt * torch.arange(len(clean), dtype=torch.float64),
                    qpos=clean[:, :nv],
                    qvel=clean[:, nv:],
                    ctrl=ctrl,
                    velocity_gain=like.velocity_gain,
                    measured=like.measured,
                )
            )
    return made
