"""From logs to a fitted nominal simulator: split, noise floor, horizon, segments, refit."""

from __future__ import annotations

__all__ = ["Prepared", "Started", "prepare"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..effects.transmission import servos
from ..errors import message
from ..logs.log import Log
from ..logs.system import System
from .chance_contacts import left_to_chance
from .contacts import likelier, one_sided, settled
from .fast_motion import FastMotion, fast_motion
from .hidden import Hidden, hidden_joints
from .modes import Mode, Trajectories, shortest
from .noise import assumed_noise
from .objective import Objective, Point, Unit, origin, parameters_at
from .prediction import Predictor
from .refit import Fit, refit, with_width
from .segments import Segments, cut, cut_for_fits
from .splits import dealt_anew, few, split
from .time_steps import with_fewest_steps
from .velocity_errors import with_velocity_errors

Array = NDArray[np.float64]
_HISTORY = 0.4  # seconds of commands that delay lines and filters look back at
_ROWS = {"train": 900, "validation": 600, "test": 600}  # control steps simulated per candidate
_FEWEST = 12  # rows of a run
_STEPS = 20  # over which a joint that nobody measured would be seen
_ROUNDS = 3  # in which what nobody measured and the parameters are fitted in turn
_MANY = 60  # segments on which they are
_FEW = 8  # segments on which the parameters are fitted first


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
        mode: What is predicted and compared.
        beside: The simulator with effects beside which chance was looked for; none if it was not.
        varied: Whether what varies counts as noise in training and validation segments.
    """

    predictor: Predictor
    sets: Mapping[str, Objective]
    logs: Mapping[str, Sequence[Log]]
    noise: Array
    noise_source: str
    horizon: int
    nominal: Fit
    alarms: tuple[str, ...]
    mode: Mode
    beside: Point | None = None
    varied: bool = False

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Names of the logs of each split."""
        return {name: tuple(log.name for log in part) for name, part in self.logs.items()}

    def alarmed(self, *alarms: str) -> Prepared:
        """Return the same with more that the reader must know, each told once."""
        return replace(self, alarms=tuple(dict.fromkeys((*self.alarms, *alarms))))


def prepare(
    system: System,
    logs: Sequence[Log],
    units: Sequence[Unit],
    *,
    generator: np.random.Generator,
    mode: Mode | None = None,
    horizon: int | None = None,
) -> Prepared:
    """Split the logs, estimate the noise, choose the horizon, and fit the parameters.

    Args:
        system: The robot.
        logs: Its logs.
        units: The effects that will be looked for; the horizon is chosen so that they show.
        generator: Of simulated noise, on which the whitening is checked.
        mode: What is predicted and compared; default segments, or trajectories where the motion of
            a joint had to be estimated: where it began is then estimated once, and not with every
            segment again, which a wrong model makes wrong.
        horizon: Control steps per segment; default chosen.

    Raises:
        ValueError: No log is long enough, or a joint that matters was not logged and what was does
            not say what it did.
    """
    if not logs:
        raise ValueError(message("logs", "none"))
    predictor = Predictor(system)
    alarms = list(() if mode is None else mode.alarms)
    parts = split(logs)
    rows = shortest(parts)
    if rows <= max(_FEWEST, horizon or 0):
        expected = f"runs of more than {max(_FEWEST, horizon or 0)} rows in every split"
        raise ValueError(message(expected, f"{rows} rows", hint="record longer"))
    if few(logs):
        alarms.append(
            f"{len(logs)} trajectories: training, validation and test are stretches of the same "
            "runs, and intervals are too narrow"
        )
    history = min(max(8, round(_HISTORY / system.control_dt)), 100)
    theta = parameters_at(system.prior, origin(system.prior))
    parts = {name: with_velocity_errors(predictor, part, theta) for name, part in parts.items()}
    noise = assumed_noise(predictor, parts["train"])
    some = cut(parts["train"], min(_STEPS, rows // 2), history=history, most=_FEW)
    hidden = hidden_joints(predictor, some, theta, noise)
    unseen = hidden or fast_motion(predictor, parts["train"])
    if unseen:
        parts, note = _completed(predictor, parts, unseen, noise=noise, history=history)
        alarms += note
        some = cut(parts["train"], min(_STEPS, rows // 2), history=history, most=_FEW)
    mode = mode or (Trajectories() if hidden else Mode())
    if servos(system.robot):
        # a loop of some milliseconds, which forces that are held for ten would leave open
        predictor.exactly()
    else:
        predictor = with_fewest_steps(predictor, some, units, z=origin(system.prior), noise=noise)
    noise, source = mode.noise(predictor, parts["train"], history=history, alarms=alarms)
    parts = _in_contact(predictor, parts, noise=noise, history=history)
    if horizon is None:
        horizon = mode.horizon(predictor, parts, units=units, noise=noise, history=history)
    started = Started(predictor, mode, history, horizon, noise, source, tuple(alarms))
    prepared = started.fitted(parts, generator)
    if few(logs):
        return prepared
    again = dealt_anew(parts, _by_log(parts, prepared.nominal, prepared.sets))
    return prepared if again is parts else started.fitted(again, generator)


@dataclass(frozen=True, eq=False)
class Started:
    """What is settled before the parameters are fitted."""

    predictor: Predictor
    mode: Mode
    history: int
    horizon: int
    noise: Array
    source: str
    alarms: tuple[str, ...]

    def fitted(
        self, parts: Mapping[str, Sequence[Log]], generator: np.random.Generator
    ) -> Prepared:
        """Cut the logs of each split, and fit the parameters."""
        pieces = {
            name: self.mode.cut(
                part,
                self.horizon,
                history=self.history,
                most=max(12, _ROWS[name] // self.horizon),
            )
            for name, part in parts.items()
        }
        nominal, sets = _nominal(
            self.predictor, pieces, self.mode, noise=self.noise, generator=generator
        )
        return Prepared(
            self.predictor, sets, parts, self.noise, self.source, self.horizon, nominal,
            self.alarms, self.mode,
        )  # fmt: skip


def _by_log(
    parts: Mapping[str, Sequence[Log]], nominal: Fit, sets: Mapping[str, Objective]
) -> dict[str, Array]:
    """Return the mean squared innovation of each log, of every segment; 0 if it has none."""
    found = {}
    for name, objective in sets.items():
        train = name == "train"
        innovations = nominal.innovations if train else objective([nominal.point])[0]
        of, count = objective.segments.log, len(parts[name])
        plain = innovations / objective.whitening.weights[:, None]
        total = np.bincount(of, (plain**2).mean(-1), minlength=count)
        found[name] = total / np.maximum(np.bincount(of, minlength=count), 1)
    return found


def _in_contact(
    predictor: Predictor, parts: Mapping[str, list[Log]], *, noise: Array, history: int
) -> dict[str, list[Log]]:
    """Return the logs with starts that contacts allow, where those make predictions likelier."""
    prior, train = predictor.system.prior, parts["train"]
    theta = parameters_at(prior, origin(prior))
    if not one_sided(predictor, train, theta=theta, noise=noise):
        return dict(parts)
    steps = min(_STEPS, shortest(parts) // 2)
    pieces = cut_for_fits(train, steps, history=history, most=_MANY)
    fit, _ = _nominal(predictor, {"train": pieces}, Mode(), noise=noise)
    theta = parameters_at(prior, fit.point.z)
    found = {n: settled(predictor, part, theta=theta, noise=noise) for n, part in parts.items()}
    better = likelier(predictor, train, found["train"], theta=theta, noise=noise)
    return found if better else dict(parts)


def _completed(
    predictor: Predictor,
    parts: Mapping[str, list[Log]],
    unseen: Hidden | FastMotion,
    *,
    noise: Array,
    history: int,
) -> tuple[dict[str, list[Log]], list[str]]:
    """Return the logs with estimates of what was not measured and matters, and a note of it.

    They and the parameters that they depend on are fitted in turn.
    """
    prior = predictor.system.prior
    theta = parameters_at(prior, origin(prior))
    steps = min(_STEPS, shortest(parts) // 2)
    some = cut(parts["train"], steps, history=history, most=_FEW)
    predictor = with_fewest_steps(predictor, some, (), z=origin(prior), noise=noise)
    curvature = 0.0
    for _ in range(_ROUNDS if prior is not None else 1):
        train = unseen.estimated(predictor, parts["train"], theta=theta, noise=noise)
        pieces = cut_for_fits(train, steps, history=history, most=_MANY)
        fit, sets = _nominal(predictor, {"train": pieces}, Mode(), noise=noise)
        theta = parameters_at(prior, fit.point.z)
        curvature = sets["train"].whitening.curvature
    unseen.require_sure(curvature)
    given = {"theta": theta, "noise": noise}
    train = unseen.estimated(predictor, parts["train"], **given)
    if train[0].uncertainty is None:
        return dict(parts), []
    unseen = unseen.settled(predictor, parts["train"], **given)
    found = {
        name: train if name == "train" else unseen.estimated(predictor, logs, **given)
        for name, logs in parts.items()
    }
    if any(log.uncertainty is None for logs in found.values() for log in logs):
        return dict(parts), []
    return found, [unseen.note(found["train"])]


def _nominal(
    predictor: Predictor,
    pieces: Mapping[str, Segments],
    mode: Mode,
    *,
    noise: Array,
    generator: np.random.Generator | None = None,
) -> tuple[Fit, dict[str, Objective]]:
    """Fit the parameters, with the covariance and the robust weights that belong to the fit."""
    prior = predictor.system.prior
    z = origin(prior)
    every = max(1, len(pieces["train"]) // _FEW)
    some = pieces["train"].take(np.arange(0, len(pieces["train"]), every))
    for _ in range(2):
        objective = mode.objective(predictor, prior, some, z=z, noise=noise)
        z = refit(_differing(objective, Point(z)), [Point(z)])[0].point.z
    sets = {}
    for name, part in pieces.items():
        bare = mode.objective(predictor, prior, part, z=z, noise=noise, generator=generator)
        sets[name] = bare.weighted(Point(z))
    sets["train"] = _differing(sets["train"], Point(z))
    fit = refit(sets["train"], [Point(z)])[0]
    if generator is None or type(mode) is not Mode:
        return fit, sets
    for _ in range(_ROUNDS):
        less = left_to_chance(sets, fit.point, noise=noise, generator=generator)
        if not less:
            break
        sets |= less
        fit = refit(sets["train"], [fit.point])[0]
    return fit, sets


def _differing(objective: Objective, point: Point) -> Objective:
    """Return the objective with wide derivatives if contacts chatter in it."""
    settled_there = objective.segments.touching is not None
    return with_width(objective, point) if settled_there else objective
