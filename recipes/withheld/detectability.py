"""How visible a cause is to one who knows everything but the cause: ``lambda``.

The nominal simulator, with the true parameters, predicts ``H`` control steps from every ``H``-th
noise-free measurement. What it misses, ``r``, is whitened by the true noise, of the measurements
and of the initial state, ``C = R + J P J'``; what changed parameters could account for is projected
out::

    lambda = || (I - Q Q') L^-1 r ||²,    C = L L',    Q = orth(L^-1 dr/dtheta)

It is the non-centrality of the best test between the cause and none, in all trajectories together.
About contacts the covariance by derivatives is too small: there ``C`` of a segment is as many times
larger as draws of the noise, of measurements and initial state, exceed it without any cause.

Of two causes, each has a ``lambda`` beside the other: ``r`` then is what the robot misses that has
the other one only, put into the measured states as often, and what the other one does, ``g``, at
another strength could account for is projected out, too.
"""

from __future__ import annotations

__all__ = ["beside", "detectability"]

from collections.abc import Callable, Sequence
from copy import deepcopy

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

from .plant import Motion, Plant
from .robots import entry_value, write_entry

Array = NDArray[np.float64]
# of a model, states (segments, 2 nv), commands (segments, horizon, nu) and time steps per command
Simulate = Callable[[mujoco.MjModel, Array, Array, int], Array]
_DRAWS = 16  # of the noise
_HORIZON = 20  # H
_FIRST = 6  # row that is predicted from: before it causes have nothing to remember
_UNKNOWN = 100.0  # 1/s, noise of a velocity that is not measured per noise of its position


def detectability(
    model: mujoco.MjModel,
    motions: Sequence[Motion],
    *,
    substeps: int,
    noise: Array,
    measured: Array,
    parameters: Sequence[str],
    known: Sequence[Array] | None = None,
    simulate: Simulate | None = None,
) -> float:
    """Return ``lambda``.

    Args:
        model: Nominal time step, true parameters, no cause.
        motions: Of the robot with the cause.
        substeps: Time steps per control step.
        noise: Standard deviations of the tangent coordinates, ``(2 nv,)``.
        measured: Which of them the diagnosis sees, boolean.
        parameters: Entries of the model that the diagnosis may refit.
        known: What another cause alone would show of each motion, in pieces, as `beside` gives.
        simulate: Where commands are not the actuators': what follows from states and commands.
    """
    horizon, simulate = _HORIZON, simulate or _rollout
    measured = measured & (noise > 0)  # what stands still without noise tells nothing
    start, commands, after, shown = [], [], [], []
    for i, motion in enumerate(motions):
        for k in _starts(len(motion.clean)):
            start.append(motion.clean[k])
            commands.append(motion.ctrl[k : k + horizon])
            after.append(motion.clean[k + 1 : k + horizon + 1])
            if known is not None:
                shown.append(known[i][k + 1 : k + horizon + 1])
    x, u, y = np.array(start), np.array(commands), np.array(after)
    width = len(noise)

    def predict(first: Array) -> Array:
        """Return the measured channels, ``(segments, horizon, channels)``."""
        return simulate(model, first, u, substeps)[..., measured]

    base = predict(x)
    first_noise = np.where(measured, noise, _UNKNOWN * np.resize(noise[: width // 2], width))
    columns = []
    for i in np.flatnonzero(first_noise):
        step = first_noise[i] * np.eye(width)[i]
        columns.append((predict(x + step) - predict(x - step)) / 2)
    spread = np.stack([c.reshape(len(x), -1) for c in columns], -1)
    floor = np.tile(noise[measured], horizon) ** 2
    factor = np.linalg.cholesky(np.eye(len(floor)) * floor + spread @ spread.transpose(0, 2, 1))

    def whiten(residual: Array) -> Array:
        flat = residual.reshape(len(x), -1, 1)
        return np.linalg.solve(factor, flat).reshape(-1)

    scale = np.repeat(_excess(predict, whiten, x, noise=(first_noise, noise[measured])), len(floor))

    r, tangents = whiten(y[..., measured] - base) / scale, []
    if shown:
        other = whiten(np.array(shown)[..., measured] - base) / scale
        r, tangents = r - other, [other]
    for entry in parameters:
        value = entry_value(model, entry)
        write_entry(model, entry, 1.01 * value)
        tangents.append(whiten(predict(x) - base) / scale)
        write_entry(model, entry, value)
    if tangents:
        q, _ = np.linalg.qr(np.stack(tangents, 1))
        r = r - q @ (q.T @ r)
    return float(r @ r)


def beside(plant: Plant, motions: Sequence[Motion], cause: int) -> list[Array] | None:
    """Return what a robot with one cause shows of the motions of one with several.

    Nothing if that cause is left to chance, of which nobody knows what it would have been.

    Args:
        plant: With that cause alone.
        motions: Of the robot with all.
        cause: The number of that cause there.
    """
    before = deepcopy(plant.rng.bit_generator.state)
    shown = []
    for motion in motions:
        # as measured, but for what the cause itself adds: another sensor's error stays in it
        states = motion.clean - motion.sensed[:, cause]
        shown.append(plant.follow(states, motion.ctrl, _starts(len(states))))
    return shown if plant.rng.bit_generator.state == before else None


def _starts(rows: int) -> range:
    """Return the rows from which so many are predicted."""
    return range(_FIRST, rows - _HORIZON, _HORIZON)


def _excess(
    predict: Callable[[Array], Array],
    whiten: Callable[[Array], Array],
    x: Array,
    *,
    noise: tuple[Array, Array],
) -> Array:
    """Return the root mean square of what whitened noise leaves in each segment, at least 1.

    Args:
        predict: From initial states.
        whiten: By derivatives.
        x: Initial states.
        noise: Standard deviations of these, and of what is measured.
    """
    rng, squares, base = np.random.default_rng(0), np.zeros(len(x)), predict(x)
    for _ in range(_DRAWS):
        begun = predict(x + rng.normal(size=x.shape) * noise[0])
        drawn = begun - base + rng.normal(size=base.shape) * noise[1]
        squares += (whiten(drawn).reshape(len(x), -1) ** 2).mean(1)
    return np.sqrt(np.maximum(squares / _DRAWS, 1.0))


def _rollout(model: mujoco.MjModel, x: Array, u: Array, substeps: int) -> Array:
    nq, count = model.nq, len(x)
    state = np.zeros((count, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    state[:, 1 : 1 + x.shape[1]] = x
    control = np.repeat(u, substeps, axis=1)
    data = mujoco.MjData(model)
    full, _ = rollout.rollout(model, data, state, control)
    return full[:, substeps - 1 :: substeps, 1 : 1 + nq + model.nv]
