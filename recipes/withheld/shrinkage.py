"""How far the gap truly shrinks: the simulator that was found, on noise-free motions it never saw.

``1 - E_effects / E_refit``, where ``E`` is the mean squared innovation of the fitted simulator
without and with the effects that were named. There is no noise, so there is no floor. This runs
after the labels are opened, and uses the package: the fitted simulator is the package's.

Methods are compared by ``1 - E_method / E_prior``: what parameters and effects remove together of
the error at the prior's mean.
"""

from __future__ import annotations

__all__ = ["gaps_removed", "true_shrinkage"]

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_bayessim.diagnosis.objective import (
    Point,
    Unit,
    origin,
    parameters_at,
    strengths_of,
    units_of,
)
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.diagnosis.whitening import whitening
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

from .coordinates import positions
from .scoring import NAMING

Array = NDArray[np.float64]
_HISTORY = 0.4  # s of commands before a segment


def true_shrinkage(
    system: System, logs: Sequence[Log], unseen: Path, report: Mapping[str, Any]
) -> float | None:
    """Return the share of the gap that the named effects remove.

    ``None`` where none was named, or one of chance: no simulation repeats what chance did.

    Args:
        system: The nominal system of the case.
        logs: What the diagnosis saw, for what was measured.
        unseen: File with the motions.
        report: Of the diagnosis.
    """
    if not report.get("effects") or any(effect(e["name"]).random for e in report["effects"]):
        return None
    theta = np.array([_theta(report, kind) for kind in ("without_effects", "with_effects")])
    strengths = [{}, _named(system, report, logs)]
    horizon = report["gap"]["horizon_steps"]
    noise = np.array([report["audit"]["noise"][name] for name in system.robot.channels])
    seen = _logs(unseen, logs[0], system)
    refit, after = _errors(system, seen, theta, strengths, horizon=horizon, noise=noise)
    return float(1 - after / refit)


def gaps_removed(
    system: System, logs: Sequence[Log], unseen: Path, reports: Mapping[str, Mapping[str, Any]]
) -> dict[str, float | None]:
    """Return the share of the error at the prior's mean that every method removes, -1 at least.

    Where a verdict names nothing, the parameters were fitted alone. The noise and the horizon, in
    whose units errors count, are those of the first report.

    Args:
        system: The nominal system of the case.
        logs: What the methods saw, for what was measured.
        unseen: File with the motions.
        reports: Of the methods; those without parameters have no share.
    """
    able = {name: r for name, r in reports.items() if "parameters" in r}
    found: dict[str, float | None] = dict.fromkeys(reports)
    if not able:
        return found
    first = next(iter(able.values()))
    naming = {name: r["verdict"] in NAMING for name, r in able.items()}
    kinds = {n: "with_effects" if named else "without_effects" for n, named in naming.items()}
    prior = parameters_at(system.prior, origin(system.prior))
    errors = _errors(
        system,
        _logs(unseen, logs[0], system),
        np.array([prior, *(_theta(r, kinds[name]) for name, r in able.items())]),
        [{}, *(_named(system, r, logs) if naming[name] else {} for name, r in able.items())],
        horizon=first["gap"]["horizon_steps"],
        noise=np.array([first["audit"]["noise"][name] for name in system.robot.channels]),
    )
    shares = np.maximum(1 - errors[1:] / errors[0], -1.0)
    return found | dict(zip(able, shares.tolist(), strict=True))


def _theta(report: Mapping[str, Any], kind: str) -> list[float]:
    return [parameter[kind] for parameter in report["parameters"]]


def _named(system: System, report: Mapping[str, Any], logs: Sequence[Log]) -> dict[Unit, float]:
    """Return the strengths that a report names, at single targets; none of chance.

    Of an effect's forms that with the options that a report has, such as a frequency; else the
    first, in the length of the runs that the report is on, and of places that it does not have the
    one that has them: two forms of an effect may be named together.
    """
    seconds, options = max(len(log) for log in logs) * system.control_dt, report.get("options", {})
    lasting = [found for found in report["effects"] if not effect(found["name"]).random]
    names = dict.fromkeys(found["name"] for found in lasting)
    kinds = [effect(name, **options[name]) for name in names if name in options]
    kinds += [form for name in names for form in effect(name).forms(seconds)]
    by_place: dict[tuple[str, str], Unit] = {}
    for unit in units_of(kinds, system.robot):
        by_place.setdefault((unit.name, unit.where), unit)
    return {
        by_place[found["name"], where]: strength
        for found in lasting
        for where, strength in found["strengths"].items()
    }


def _errors(
    system: System,
    seen: Sequence[Log],
    theta: Array,
    strengths: Sequence[Mapping[Unit, float]],
    *,
    horizon: int,
    noise: Array,
) -> Array:
    """Return the mean squared innovation of simulators on noise-free logs, shape ``(P,)``."""
    place = np.zeros(1)
    on = strengths_of([Point(place, some) for some in strengths], system.robot)
    history = math.ceil(_HISTORY / system.control_dt)
    segments = cut(seen, horizon, history=history, burn_in=history)
    predictor = Predictor(system, threads=1)
    white = whitening(predictor, segments, theta[0], noise)
    errors = (white(predictor.residuals(segments, theta, on)) ** 2).reshape(len(theta), -1)
    return np.nan_to_num(errors, nan=1e6).mean(1)


def _logs(unseen: Path, like: Log, system: System) -> list[Log]:
    """Return the noise-free motions as logs of which as much was measured as of ``like``."""
    made = []
    with np.load(unseen) as arrays:
        for i in range(sum(name.startswith("clean") for name in arrays.files)):
            clean, ctrl = arrays[f"clean{i}"], torch.from_numpy(arrays[f"ctrl{i}"])
            q, v = np.split(clean, 2, axis=1)
            qpos = np.array([positions(system.task.model, row) for row in q])
            made.append(
                Log(
                    name=f"unseen{i}",
                    time=system.control_dt * torch.arange(len(clean), dtype=torch.float64),
                    qpos=torch.from_numpy(qpos),
                    qvel=torch.from_numpy(v),
                    ctrl=ctrl,
                    velocity_gain=like.velocity_gain,
                    measured=like.measured,
                )
            )
    return made
