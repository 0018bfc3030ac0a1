"""From logs to a fitted nominal simulator: split, noise floor, horizon, segments, refit.

The data are split by trajectory: fits and screening see the training logs, the choice of effects
the validation logs too, and the test logs are opened once, for the figures that are reported.
"""

from __future__ import annotations

__all__ = ["Prepared", "cut_for_fits", "prepare", "split"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import message
from ..logs.log import Log
from ..logs.system import System
from .objective import Objective, Point, Unit, parameters_at, pushes_of
from .prediction import Predictor
from .refit import Fit, refit
from .segments import Segments, cut
from .time_steps import with_fewest_steps
from .unseen import require_seen
from .whitening import Whitening, innovation_noise, noise_from_differences, whitening

Array = NDArray[np.float64]
_LADDER = (3, 10, 20, 40, 80, 160)
_CHECKS = 10  # compared rows per segment
_SKIP = 5  # control steps: the longest delay
_HISTORY = 0.4  # seconds of commands that delay lines and filters look back at
_ROWS = {"train": 900, "validation": 600, "test": 600}  # control steps simulated per candidate
_FEWEST = 12  # rows of a run
_PROBE = 100  # control steps on which horizons are compared
_STEPS = 20  # over which a joint that nobody measured would be seen
_FEW = 8  # segments on which the parameters are fitted first
_PIECE = 0.25  # of the median log's length, below which it is a piece of one
_AS_LONG = 1.25  # ratio of two lengths that count as one
_DEAL = "train", "test", "validation", "train", "train", "test", "validation", "train"
_WORTH = 0.2  # nats per effect that a longer horizon must bring


@dataclass(frozen=True, eq=False)
class Prepared:
    """What the search for effects starts from.

    Attributes:
        predictor: Simulates.
        sets: Objectives by name of the split: ``train``, ``validation``, ``test``.
        logs: The logs of each split.
        noise: Standard deviation of each channel's noise.
        noise_source: Where it comes from.
        horizon: Control steps per segment.
        nominal: The fit of the parameters alone.
        alarms: What the reader must know.
    """

    predictor: Predictor
    sets: Mapping[str, Objective]
    logs: Mapping[str, Sequence[Log]]
    noise: Array
    noise_source: str
    horizon: int
    nominal: Fit
    alarms: tuple[str, ...]

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Names of the logs of each split."""
        return {name: tuple(log.name for log in part) for name, part in self.logs.items()}


def split(logs: Sequence[Log]) -> dict[str, list[Log]]:
    """Return training, validation and test logs.

    From the longest to the shortest, and among those about as long from the widest motion to the
    least, of every four logs the first and last train, one tests, one validates: what acts in wide
    motion only should act in each split. Pieces that are much shorter than the others train: over
    them no error grows. Fewer than three logs are each divided in time: half, a quarter, a quarter.
    """
    parts: dict[str, list[Log]] = {"train": [], "validation": [], "test": []}
    least = _PIECE * float(np.median([len(log) for log in logs])) if logs else 0.0
    whole = [log for log in logs if len(log) >= least]
    if len(whole) >= 3:
        for i, log in enumerate(_ordered(whole)):
            parts[_DEAL[i % len(_DEAL)]].append(log)
        parts["train"] += [log for log in logs if len(log) < least]
        return parts
    for log in logs:
        length = len(log)
        ends = 0, length // 2, 3 * length // 4, length
        for name, begin, end in zip(parts, ends, ends[1:], strict=False):
            parts[name].append(_rows(log, begin, end))
    return parts


def _ordered(logs: Sequence[Log]) -> list[Log]:
    """Return the longest first; of those about as long, what moves and commands most."""
    peaks = np.array([torch.cat([log.ctrl, log.qvel], 1).abs().amax(0).numpy() for log in logs])
    width = (peaks / np.maximum(peaks.max(0), 1e-12)).mean(1)
    length = np.round(np.log([len(log) for log in logs]) / np.log(_AS_LONG))
    return [logs[at] for at in np.lexsort((-width, -length))]


def _rows(log: Log, begin: int, end: int) -> Log:
    part = slice(begin, end)
    arrays = {n: getattr(log, n)[part] for n in ("time", "qpos", "qvel", "ctrl")}
    return replace(
        log, name=f"{log.name} [{begin}:{end}]", first_row=log.first_row + begin, **arrays
    )


def prepare(
    system: System,
    logs: Sequence[Log],
    units: Sequence[Unit],
    *,
    generator: np.random.Generator,
    horizon: int | None = None,
) -> Prepared:
    """Split the logs, estimate the noise, choose the horizon, and fit the parameters.

    Args:
        system: The robot.
        logs: Its logs.
        units: The effects that will be looked for; the horizon is chosen so that they show.
        generator: Of simulated noise, on which the whitening is checked.
        horizon: Control steps per segment; default chosen.

    Raises:
        ValueError: No log is long enough, or a joint that matters was not logged.
    """
    if not logs:
        raise ValueError(message("logs", "none"))
    predictor = Predictor(system)
    alarms: list[str] = []
    parts = split(logs)
    shortest = min(max(len(log) for log in part) for part in parts.values())
    if shortest <= max(_FEWEST, horizon or 0):
        expected = f"runs of more than {max(_FEWEST, horizon or 0)} rows in every split"
        raise ValueError(message(expected, f"{shortest} rows", hint="record longer"))
    if len(logs) < 3:
        alarms.append(
            f"{len(logs)} trajectories: training, validation and test are stretches of the same "
            "runs, and intervals are too narrow"
        )
    history = min(max(8, round(_HISTORY / system.control_dt)), 100)
    noise, source = _noise(system, predictor, parts["train"], history=history, alarms=alarms)
    some = cut(parts["train"], min(_STEPS, shortest // 2), history=history, most=_FEW)
    require_seen(predictor, some, parameters_at(system.prior, _start(system)), noise)
    predictor = with_fewest_steps(predictor, some, units, z=_start(system), noise=noise)
    if horizon is None:
        horizon = _horizon(
            predictor, system, parts["train"], units=units, noise=noise, history=history
        )
        horizon = min(horizon, shortest // 2)
    pieces = {
        name: cut_for_fits(part, horizon, history=history, most=max(12, _ROWS[name] // horizon))
        for name, part in parts.items()
    }
    nominal, whitenings = _nominal(predictor, system, pieces, noise=noise, generator=generator)
    sets = {n: Objective(predictor, system.prior, pieces[n], whitenings[n]) for n in pieces}
    return Prepared(predictor, sets, parts, noise, source, horizon, nominal, tuple(alarms))


def cut_for_fits(logs: Sequence[Log], horizon: int, *, history: int, most: int) -> Segments:
    """Cut logs into the segments that fits, screens and figures are made on."""
    return cut(
        logs,
        horizon,
        history=history,
        most=most,
        checks=_CHECKS,
        burn_in=history,
        skip=_SKIP,
    )


def _start(system: System) -> Array:
    return np.zeros(1 + (0 if system.prior is None else len(system.prior.names)))


def _coordinates(predictor: Predictor, log: Log) -> Array:
    """Return the measured channels as tangent coordinates seen from the first row, ``(T, C)``."""
    qpos = log.qpos.numpy()
    both = [predictor.tangent.difference(qpos[:1], qpos), log.qvel.numpy()]
    return np.concatenate(both, -1)[:, list(predictor.system.channel_index)]


def _noise(
    system: System,
    predictor: Predictor,
    logs: Sequence[Log],
    *,
    history: int,
    alarms: list[str],
) -> tuple[Array, str]:
    """Return each channel's noise: the differences of innovations, checked by the sensor's spec."""
    values = [_coordinates(predictor, log) for log in logs]
    smooth = noise_from_differences(logs, values)
    channels = system.robot.channels
    given = np.array([system.noise.get(name, np.nan) for name in channels])
    tiny = 1e-6 * system.robot.channel_scale.numpy()
    noise = np.maximum(np.where(np.isnan(given), smooth, given), tiny)
    steps = min(8, min(len(log) for log in logs) // 2)
    pieces = cut(logs, steps, history=history, most=60, burn_in=history)
    pushes = pushes_of(system.robot)
    z = _start(system)
    for _ in range(2):
        white = whitening(predictor, pieces, parameters_at(system.prior, z), noise)
        objective = Objective(predictor, system.prior, pieces, white)
        fit = refit(objective, [Point(z)], iterations=4)[0]
        z = fit.point.z
        points = [Point(z, {unit: 0.1 * unit.high}) for unit in pushes]
        pushed = objective(points) if points else np.zeros((0, *fit.innovations.shape))
        factor = innovation_noise(fit.innovations, pushed - fit.innovations, len(pieces.checked))
        factor = np.clip(factor, 0.2, 5.0)
        noise = np.maximum(noise * factor, tiny)
    apart = [
        f"{name}: {estimate:.3g} against {spec:.3g}"
        for name, estimate, spec in zip(channels, noise, given, strict=True)
        if spec > 0 and not 0.7 < estimate / spec < 1.4
    ]
    if apart:
        alarms.append("noise floor uncertain, estimated against specified: " + ", ".join(apart))
    return noise, "differences of innovations"


def _horizon(
    predictor: Predictor,
    system: System,
    logs: Sequence[Log],
    *,
    units: Sequence[Unit],
    noise: Array,
    history: int,
) -> int:
    """Return the horizon at which the effects would show most, per segment row simulated.

    Chosen on what simulations of the effects would look like, never on the residuals: largest
    ``Σ_e log(1 + λ_e)`` with ``λ_e`` the squared length of the whitened signature at a tenth of the
    range, as long as second differences stay below first ones.
    """
    z = _start(system)
    units = list({unit.name: unit for unit in units}.values())
    typical = float(np.median([len(log) for log in logs]))
    best, choice = -np.inf, _LADDER[0]
    for steps in _LADDER:
        if steps > typical / 5:
            break
        pieces = cut_for_fits(logs, steps, history=history, most=max(4, _PROBE // steps))
        white = whitening(predictor, pieces, parameters_at(system.prior, z), noise)
        if white.curvature > 1.0 and np.isfinite(best):
            break
        objective = Objective(predictor, system.prior, pieces, white)
        points = [Point(z), *(Point(z, {unit: 0.1 * unit.high}) for unit in units)]
        innovations = objective(points)
        change = ((innovations[1:] - innovations[0]) ** 2).sum((1, 2))
        per_row = change * (sum(len(log) for log in logs) / (len(pieces) * steps))
        value = float(np.log1p(per_row).sum())
        if value > best + _WORTH * len(units):
            best, choice = value, steps
    return choice


def _nominal(
    predictor: Predictor,
    system: System,
    pieces: Mapping[str, Segments],
    *,
    noise: Array,
    generator: np.random.Generator,
) -> tuple[Fit, dict[str, Whitening]]:
    """Fit the parameters, with the whitening and the robust weights that belong to the fit."""
    z = _start(system)
    every = max(1, len(pieces["train"]) // _FEW)
    some = pieces["train"].take(np.arange(0, len(pieces["train"]), every))
    for _ in range(2):
        white = whitening(predictor, some, parameters_at(system.prior, z), noise)
        objective = Objective(predictor, system.prior, some, white)
        z = refit(objective, [Point(z)])[0].point.z
    whitenings = {}
    for name, part in pieces.items():
        bare = whitening(
            predictor, part, parameters_at(system.prior, z), noise, generator=generator
        )
        innovations = Objective(predictor, system.prior, part, bare)([Point(z)])[0]
        whitenings[name] = bare.weighted(innovations)
    objective = Objective(predictor, system.prior, pieces["train"], whitenings["train"])
    return refit(objective, [Point(z)])[0], whitenings
