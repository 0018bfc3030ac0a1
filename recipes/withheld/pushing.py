"""How Fetch's hand is moved: it pushes an object, goes over it, and pushes it from another side.

In closed loop it goes by what it measures. In open loop it goes by actions that the same policy
gave beforehand, on the nominal robot without causes.
"""

from __future__ import annotations

__all__ = ["pushes", "pushing"]

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from .coordinates import coordinates, positions
from .fetch_push import OBJECT, start
from .plant import Motion, Plant, Policy
from .plant_fetch import FetchPlant

Array = NDArray[np.float64]
_BEHIND = 0.065  # m, where a push begins
_NEAR = 0.015  # m, that near to where it begins it does
_CLEAR = 0.055  # m, from where the hand does not rub against the object as it goes up
_OVER = 0.095  # m, how high the hand goes over the object
_PAST = 0.05  # m, how far past the middle the object is pushed
_EDGE = 1.43, 1.0  # m, as far along x and y the middle may be: 12 cm from the table's edge
_LONGEST = 25  # control steps until it is pushed from another side in any case
_GAIN = 20.0  # of the command per m
_WOBBLE = 0.12  # of the command, in every control step


def pushes(
    plant: Plant,
    nominal: mujoco.MjModel,
    closed: Sequence[bool],
    *,
    steps: int,
    rng: np.random.Generator,
) -> list[Motion]:
    """Return trajectories.

    Args:
        plant: What is moved.
        nominal: The model that the policy knows.
        closed: Of each, whether in closed loop.
        steps: Control steps of each.
        rng: Of where the object is and of how it is pushed.
    """
    quiet, any_rng = 0.0 * plant.noise, np.random.default_rng(0)
    rehearsal = FetchPlant(nominal, plant.control_dt, [], quiet, any_rng)
    motions = []
    for loop in closed:
        q, v = _beginning(nominal, rng)
        policy = pushing(nominal, steps=steps, rng=rng)
        if not loop:
            planned = rehearsal.run(q, v, policy, steps=steps).ctrl
            policy = lambda k, _, planned=planned: planned[k]
        motions.append(plant.run(q, v, policy, steps=steps))
    return motions


def _beginning(model: mujoco.MjModel, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return tangent coordinates and velocities: the object at rest, 7 to 11 cm from the hand."""
    qpos, v = start()
    angle, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.07, 0.11)
    hand = _Hand(model).at(coordinates(model, qpos))
    qpos[OBJECT : OBJECT + 2] = hand[:2] + away * np.array([np.cos(angle), np.sin(angle)])
    return coordinates(model, qpos), v


def pushing(model: mujoco.MjModel, *, steps: int, rng: np.random.Generator) -> Policy:
    """Return a policy that pushes the object to and fro about where it first measures it."""
    hand = _Hand(model)
    speeds, angles = rng.uniform(0.2, 0.5, steps), rng.uniform(-0.7, 0.7, steps)
    wobble = _WOBBLE * rng.standard_normal((steps, 3))
    idle = rng.uniform(-1.0, 1.0, steps)  # of the fingers, which do not move
    middle, along, behind, since = np.zeros(2), np.zeros(2), True, 0

    def policy(k: int, y: Array) -> Array:
        nonlocal middle, along, behind, since
        at, box = hand.at(y[: model.nv]), y[OBJECT : OBJECT + 3]
        if k == 0:
            middle = np.minimum(box[:2], _EDGE)
            along, behind, since = _turned(box[:2] - at[:2], angles[0] / 4), True, 0
        left = _PAST - along @ (box[:2] - middle)
        if left < 0.005 or k - since >= _LONGEST:
            along, behind, since = _turned(middle - box[:2], angles[k]), False, k
        error = np.append(box[:2] - _BEHIND * along, box[2]) - at
        if not behind and np.linalg.norm(error[:2]) > _NEAR:
            error = _over(error, at - box)
        else:
            behind = behind or error[2] > -_NEAR
        u = _GAIN * error
        if behind:
            u[:2] += (min(speeds[since], _GAIN * left) - along @ u[:2]) * along
        return np.clip(np.append(u + wobble[k], idle[k]), -1.0, 1.0)

    return policy


def _over(error: Array, apart: Array) -> Array:
    """Return where to go instead of straight on: back off, then up, then over the object.

    Args:
        error: Where a push begins, from the hand.
        apart: The hand, from the object.
    """
    error = error + np.array([0.0, 0.0, _OVER])
    distance = float(np.linalg.norm(apart[:2]))
    if error[2] < 0.3 * _OVER:
        return error
    if distance > _CLEAR:
        return np.array([0.0, 0.0, error[2]])
    return np.append(apart[:2] / max(distance, 1e-9) * (_BEHIND - distance), 0.0)


def _turned(to: Array, angle: float) -> Array:
    """Return a unit vector that makes an angle with another vector, in the plane."""
    heading = np.arctan2(to[1], to[0]) + angle
    return np.array([np.cos(heading), np.sin(heading)])


class _Hand:
    """Tells where the hand is from what joints measure."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._grip = model.site("robot0:grip").id

    def at(self, y: Array) -> Array:
        """Return the place of the grip, between the fingertips, in m."""
        self._data.qpos[:] = positions(self._model, y)
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.site_xpos[self._grip].copy()
