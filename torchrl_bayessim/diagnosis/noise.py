"""How noisy each channel is: from what no model can explain, the differences of innovations."""

from __future__ import annotations

__all__ = ["UNCERTAIN", "assumed_noise", "measured_noise"]

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..effects.robot import Robot
from ..logs.log import Log
from .objective import Objective, Point, Unit, origin, parameters_at, pushes_of
from .prediction import Predictor
from .refit import refit
from .segments import Segments, cut
from .whitening import ENOUGH, innovation_noise, noise_from_differences, whitening

Array = NDArray[np.float64]
UNCERTAIN = "noise floor uncertain"  # how that alarm begins
_ROUNDS, _CORRECTIONS = 8, 4  # third differences of fast motion start a hundred times too high
_AT_ONCE = 5.0  # the most that a round trusts: too large a noise hides how far it is too large
_SETTLED = 0.1  # logarithm of a factor that is not worth another round
_STEPS, _FEWER = 8, 4  # control steps of a segment; where that makes few segments, half of them
_BEYOND = 3.0  # times its spec, or its like, that a sensor is not noisier than
_ROUGHLY = 2.0  # times what third differences say
_LIKE = 3  # sensors of one kind
_DRAWS = 8  # simulated robots whose noise is known
_HARDLY = 0.15  # of the noise: a correction that is hardly known
_MOST_MISSED = 1.6  # the most by which contacts make it seem larger than it is


class _Known(NamedTuple):
    """What is known of each channel's noise before any fit, shape ``(C,)`` each.

    Attributes:
        given: By the sensor's spec, NaN where it says nothing, or less than any sensor's.
        rough: By third differences.
        tiny: Less than any sensor's.
    """

    given: Array
    rough: Array
    tiny: Array

    @classmethod
    def of(cls, predictor: Predictor, logs: Sequence[Log]) -> _Known:
        robot, specified = predictor.system.robot, predictor.system.noise
        rough = noise_from_differences(logs, [_coordinates(predictor, log) for log in logs])
        given = np.array([specified.get(name, np.nan) for name in robot.channels])
        tiny = 1e-6 * robot.channel_scale.numpy()
        return cls(np.where(given > tiny, given, np.nan), rough, tiny)

    @property
    def assumed(self) -> Array:
        return np.maximum(np.where(np.isnan(self.given), self.rough, self.given), self.tiny)


def assumed_noise(predictor: Predictor, logs: Sequence[Log]) -> Array:
    """Return what the sensor's spec says, or else third differences, shape ``(C,)``."""
    return _Known.of(predictor, logs).assumed


def measured_noise(
    predictor: Predictor,
    logs: Sequence[Log],
    *,
    history: int,
    alarms: list[str],
    beside: tuple[Point, Array] | None = None,
) -> tuple[Array, str]:
    """Return each channel's noise: the differences of innovations, checked by the sensor's spec.

    Args:
        predictor: Simulates.
        logs: For training.
        history: Rows before a segment that effects look back at.
        alarms: To which is added what the reader must know.
        beside: The simulator that leaves noise, default none of the effects; and the noise that
            was measured without them, shape ``(C,)``.
    """
    system, known = predictor.system, _Known.of(predictor, logs)
    pieces = _pieces(logs, history=history)
    at, noise = beside or (Point(origin(system.prior)), known.assumed)
    estimate = noise
    for _ in range(_ROUNDS):
        at, factor = _round(predictor, pieces, at, noise)
        noise = np.maximum(noise * np.clip(factor, 1 / _AT_ONCE, _AT_ONCE), known.tiny)
        estimate, noise = noise, np.minimum(noise, _most(noise, known, system.robot))
        if _settled(factor):
            break
    # a guessed start is surer than its covariance says: draws from that would make noise look small
    if predictor.colliding and pieces.uncertainty is None:
        linear, noise = noise, _corrected(predictor, pieces, at, linear=noise, known=known)
        estimate = estimate * noise / linear
    apart = [
        f"{name}: {estimate:.3g} against {spec:.3g}"
        for name, estimate, spec in zip(system.robot.channels, estimate, known.given, strict=True)
        if spec > 0 and not 0.7 < estimate / spec < 1.4
    ]
    if apart:
        alarms.append(UNCERTAIN + ", estimated against specified: " + ", ".join(apart))
    source = "differences of innovations"
    return noise, source if beside is None else f"{source} beside the effects found first"


def _corrected(
    predictor: Predictor, pieces: Segments, at: Point, *, linear: Array, known: _Known
) -> Array:
    """Return noise as robots have it that are simulated with it, shape ``(C,)``.

    Args:
        predictor: Simulates.
        pieces: Segments.
        at: Where fits start.
        linear: Noise by the linear view of what contacts make of it, ``(C,)``.
        known: From before any fit.
    """
    noise = linear
    for _ in range(_CORRECTIONS):
        at, factor = _round(predictor, pieces, at, noise, drawn=True)
        # no more than before: where little is calm, what a missing effect does would count as noise
        noise = np.clip(noise * factor, _least(linear, known), linear)
        noise = np.minimum(noise, _most(noise, known, predictor.system.robot))
        if _settled(factor):
            break
    return np.where(noise < (1 - _HARDLY) * linear, noise, linear)


def _settled(factor: Array) -> bool:
    return bool(np.abs(np.log(np.maximum(factor, 1e-9))).max() < _SETTLED)


def _round(
    predictor: Predictor, pieces: Segments, at: Point, noise: Array, *, drawn: bool = False
) -> tuple[Point, Array]:
    """Fit the parameters, and return them and by which factor each channel's noise differs.

    Args:
        predictor: Simulates.
        pieces: Segments.
        at: Where the fit starts.
        noise: That is assumed, shape ``(C,)``.
        drawn: Whether it is compared with robots that are simulated with it.
    """
    prior, pushes = predictor.system.prior, pushes_of(predictor.system.robot)
    white = whitening(predictor, pieces, parameters_at(prior, at.z), noise)
    objective = Objective(predictor, prior, pieces, white)
    fit = refit(objective, [at], iterations=4)[0]
    points = [_pushed(fit.point, unit) for unit in pushes]
    pushed = objective(points) if points else np.zeros((0, *fit.innovations.shape))
    made = _drawn(objective, fit.point, noise) if drawn else None
    changes = pushed - fit.innovations
    return fit.point, innovation_noise(fit.innovations, changes, len(pieces.checked), drawn=made)


def _drawn(objective: Objective, point: Point, noise: Array) -> Array:
    """Return innovations that noise alone leaves, unit noise where one diverged, ``(N, S, KC)``."""
    generator = np.random.default_rng(0)
    unit = generator.standard_normal((_DRAWS, *objective.whitening.drift.shape))
    made = objective.made_by_noise(point, noise, draws=_DRAWS, generator=generator)
    finite = np.isfinite(made.reshape(*unit.shape)).all(-1, keepdims=True)
    return np.where(finite, objective.whitening(made), unit)


def _least(linear: Array, known: _Known) -> Array:
    """Return what noise is at least, of which the linear view says so much, shape ``(C,)``.

    A sensor is no better than its spec, if there is one. And what contacts make of noise is not
    believed beyond reason: a robot that is simulated from a measured start has twice its noise, so
    that a foot is deeper in the ground, and more of it is missed. Without a bound all noise could
    be taken for what contacts make of less and less.
    """
    least = linear / _MOST_MISSED
    return np.where(known.given > 0, np.maximum(least, np.minimum(linear, known.given)), least)


def _pushed(point: Point, push: Unit) -> Point:
    """Return a point with a tenth of the largest force at a joint beside what it has there."""
    return point.more(push, 0.1 * push.high)


def _pieces(logs: Sequence[Log], *, history: int) -> Segments:
    """Return the segments that noise is estimated on: enough to tell the calm ones, if possible."""
    half = max(len(log) for log in logs) // 2  # what an impact has cut off may be a few rows
    for steps in (_STEPS, _FEWER):
        pieces = cut(logs, min(steps, half), history=history, most=60, burn_in=history)
        if len(pieces) >= ENOUGH:
            break
    return pieces


def _most(noise: Array, known: _Known, robot: Robot) -> Array:
    """Return what each channel's noise cannot exceed, shape ``(C,)``.

    Where a missing effect never rests, all that its joint does looks like noise, a hundred times
    what its sensor has. A sensor is some times worse than its spec, if there is one, or than most
    of its like, the same readings of the other hinges that motors move. Nor is it noisier than
    third differences say, which hold the motion's as well, unless sensors are so coarse, or rest so
    much, that most of them are zero.
    """
    most = np.where(known.given > 0, _BEYOND * known.given, np.inf)
    most = np.minimum(most, np.where(known.rough > 0, _ROUGHLY * known.rough, np.inf))
    if robot.model is None:
        return most
    moved = {joint for joint in robot.joint_of_actuator if joint >= 0}
    for kind in ("position", "velocity"):
        peers = [
            c
            for c, joint in enumerate(robot.channel_joint)
            if robot.channel_kind[c] == kind and joint in moved and _hinge(robot, joint)
        ]
        if len(peers) >= _LIKE:
            usual = float(np.quantile(noise[peers], 0.25))
            most[peers] = np.minimum(most[peers], _BEYOND * usual)
    return most


def _hinge(robot: Robot, joint: int) -> bool:
    model = robot.require_model()
    kind = model.jnt_type[model.dof_jntid[robot.dof_index[joint]]]
    return bool(kind == mujoco.mjtJoint.mjJNT_HINGE)


def _coordinates(predictor: Predictor, log: Log) -> Array:
    """Return the measured channels as tangent coordinates seen from the first row, ``(T, C)``."""
    qpos = log.qpos.numpy()
    both = [predictor.tangent.difference(qpos[:1], qpos), log.qvel.numpy()]
    return np.concatenate(both, -1)[:, list(predictor.system.channel_index)]
