"""What to record next: the excitation that would best tell apart what these data cannot.

For two explanations ``e`` and ``f``, an experiment is simulated under ``e``; what of it ``f`` could
not explain, even with its parameters and strengths moved as far as the data so far allow, is::

    D = min_x ‖ŷ_f − ŷ_e + J x‖² + ‖J₀ x‖²

in units of the noise, ``J`` and ``J₀`` the derivatives of ``f`` in the experiment and in the
training data (discrimination with nuisance parameters, Atkinson & Fedorov 1975). With the
dispersion φ of what the best model leaves, one run brings expected log odds of ``D / 2φ``, and
``4 (z₀.₉₅ + z₀.₉)² φ / D`` runs decide. Commands stay within the actuators' limits and motions near
what was recorded.
"""

from __future__ import annotations

__all__ = ["experiments"]

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..logs.log import Log
from .confusion import rivals, stand_in
from .excitation_library import excitations
from .objective import Objective, Point, Unit, strengths_of
from .preparation import Prepared
from .refit import Fit, refit
from .segments import cut
from .selection import Selection

Array = NDArray[np.float64]
_SECONDS, _STEPS = 10.0, 200  # of one run, at most
_AMPLITUDES = (1.0, 1.5)  # of the commands recorded so far
_BEYOND = 0.25  # of the recorded range: how far a joint may leave it
_RUNS = 3  # more are no proposal: what a model leaves out would decide, not the cause
_DECIDED = 34.3  # 4 (1.645 + 1.282)²
_LEVEL = 0.4  # of its range: an effect that could not be tested
_MOST = 3  # proposals
_SURE = 1e3  # odds beyond which what no model has decides
_DELAYS = {"action_delay", "sensor_delay"}


@dataclass(frozen=True)
class _Question:
    """Two explanations, and their names."""

    names: tuple[str, str]
    true: Point
    other: Fit


def experiments(
    prepared: Prepared,
    selection: Selection,
    confused: Sequence[str],
    untested: Sequence[Unit],
    *,
    generator: np.random.Generator,
) -> tuple[dict[str, Any], ...]:
    """Return the best experiments: excitation, what it separates, expected odds, and seconds.

    Args:
        prepared: Logs, noise, horizon.
        selection: What the search found.
        confused: Effects that the data cannot tell apart, the best model's first.
        untested: Effects that the data could not show; asked for where nothing is confused.
        generator: Of the excitations.
    """
    questions = _confusions(selection, confused) or _untested(selection, untested)
    if not questions:
        return ()
    phi = selection.best.dispersion()
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for name, log in _runs(prepared, questions[0].true, generator):
        objective = _observed(prepared, log, questions[0].true)
        if objective is None:
            continue
        duration = len(log) * prepared.predictor.system.control_dt
        fits = {id(q.other): refit(objective, [q.other.point], iterations=0)[0] for q in questions}
        shown = objective([q.true for q in questions])
        for question, seen in zip(questions, shown, strict=True):
            gain = _discrimination(fits[id(question.other)], question.other, seen)
            runs = math.ceil(_DECIDED * phi / max(gain, 1e-9))
            if runs > _RUNS:
                continue
            proposal = {
                "excitation": name,
                "separates": list(question.names),
                "expected_odds": min(math.exp(min(gain * runs / (2 * phi), 30.0)), _SURE),
                "seconds": round(runs * duration, 1),
                "gain": gain,
            }
            known = found.get(question.names)
            if known is None or gain > known["gain"]:
                found[question.names] = proposal
    best = sorted(found.values(), key=lambda p: (p["seconds"], -p["gain"]))[:_MOST]
    return tuple({k: v for k, v in p.items() if k != "gain"} for p in best)


def _confusions(selection: Selection, confused: Sequence[str]) -> list[_Question]:
    if len(confused) < 2:
        return []
    best, questions = selection.best, {}
    for rival in rivals(selection, confused[0]):
        pair = (confused[0], stand_in(selection, rival))
        if set(pair) == _DELAYS and all(_whole(u) for u in (*best.units, *rival.units)):
            continue  # no log can tell late commands from late sensors
        questions.setdefault(pair, _Question(pair, best.fit.point, rival.fit))
    return list(questions.values())


def _whole(unit: Unit) -> bool:
    """Return whether a delay of sensors is one of all of them."""
    return unit.name != "sensor_delay" or unit.where == "all" or len(unit.direction) == 1


def _untested(selection: Selection, units: Sequence[Unit]) -> list[_Question]:
    fit, questions = selection.best.fit, {}
    for unit in units:
        point = fit.point.beside({unit: _LEVEL * unit.high})
        pair = (unit.name, "nothing")
        questions.setdefault(pair, _Question(pair, point, fit))
    return list(questions.values())


def _runs(
    prepared: Prepared, point: Point, generator: np.random.Generator
) -> list[tuple[str, Log]]:
    """Return experiments that keep within limits, as their logs would look without noise."""
    logs = prepared.logs["train"]
    dt = prepared.predictor.system.control_dt
    steps = min(_STEPS, round(_SECONDS / dt))
    commands = torch.cat([log.ctrl for log in logs]).numpy()
    low, high = commands.min(0), commands.max(0)
    least, most = prepared.predictor.system.task.action_bounds
    names, waves = [], []
    for amplitude in _AMPLITUDES:
        middle, half = (low + high) / 2, amplitude * (high - low) / 2
        library = excitations(
            np.maximum(middle - half, least),
            np.minimum(middle + half, most),
            steps=steps + 1,
            dt=dt,
            generator=generator,
        )
        names += [
            f"{name}, {amplitude:.0%} of the recorded commands".replace("%", " %")
            for name in library
        ]
        waves += library.values()
    return [
        (name, log)
        for name, log in zip(names, _played(prepared, waves, point), strict=True)
        if not _leaves(prepared, log.qpos.numpy())
    ]


def _usual(covariances: torch.Tensor) -> torch.Tensor:
    """Return the covariance of median size, ``(1, 2 nv, 2 nv)``; a mean is that of a few rows."""
    sizes = covariances.diagonal(dim1=1, dim2=2).sum(-1)
    return covariances[sizes.median(0).indices][None]


def _played(prepared: Prepared, waves: Sequence[Array], point: Point) -> list[Log]:
    """Return the runs of commands from where the first log began, all simulated at once."""
    first = prepared.logs["train"][0]
    count = len(waves[0])
    robot, predictor = prepared.predictor.system.robot, prepared.predictor
    known = first.uncertainty
    rest = replace(
        first,
        name="experiment",
        time=torch.arange(count, dtype=torch.float64) * predictor.system.control_dt,
        qpos=first.qpos[:1].repeat(count, 1),
        qvel=torch.zeros(count, first.qvel.shape[1], dtype=torch.float64),
        first_row=0,
        uncertainty=None if known is None else _usual(known).expand(count, -1, -1),
        touching=None,
    )
    logs = [replace(rest, ctrl=torch.from_numpy(wave)) for wave in waves]
    whole = cut(logs, count - 1, history=prepared.sets["train"].segments.history)
    theta = prepared.sets["train"].theta(point.z[None])
    qpos, qvel = predictor.states(whole, theta, strengths_of([point], robot))
    return [
        replace(
            log,
            qpos=torch.cat([rest.qpos[:1], torch.from_numpy(positions)]),
            qvel=torch.cat([rest.qvel[:1], torch.from_numpy(velocities)]),
        )
        for log, positions, velocities in zip(logs, qpos[0], qvel[0], strict=True)
    ]


def _leaves(prepared: Prepared, positions: Array) -> bool:
    """Return whether a run diverges, or a hinge or slide goes far beyond where it has been."""
    if not np.isfinite(positions).all():
        return True
    joints = list(prepared.predictor.system.robot.qpos_index)
    seen = torch.cat([log.qpos for log in prepared.logs["train"]]).numpy()[:, joints]
    low, high = seen.min(0), seen.max(0)
    margin = _BEYOND * (high - low)
    moved = positions[:, joints]
    return bool(((moved < low - margin) | (moved > high + margin)).any())


def _observed(prepared: Prepared, log: Log, point: Point) -> Objective | None:
    """Return the objective on the segments of an experiment."""
    train, predictor = prepared.sets["train"], prepared.predictor
    history = train.segments.history
    if len(log) <= prepared.horizon + history:
        return None
    mode = prepared.mode
    pieces = mode.cut([log], prepared.horizon, history=history, most=_STEPS)
    return mode.objective(predictor, train.prior, pieces, z=point.z, noise=prepared.noise)


def _discrimination(there: Fit, before: Fit, seen: Array) -> float:
    """Return ``D``: what another explanation cannot imitate of what would be seen."""
    apart = np.r_[(there.innovations - seen).ravel(), np.zeros(len(before.jacobian))]
    derivatives = np.r_[there.jacobian, before.jacobian]
    change = np.linalg.lstsq(derivatives, -apart, rcond=None)[0]
    return float(((apart + derivatives @ change) ** 2).sum())
