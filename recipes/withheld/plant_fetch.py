"""Fetch's arm, whose hand a mocap body drags: a command says where that goes from the hand.

After Gymnasium-Robotics: in each control step the mocap body is put where the hand was at the
step's beginning, moved by 5 cm per unit, its quaternion turned towards pointing down; afterwards
the fingers are closed again. Commands may change within a control step, as of a filter.
"""

from __future__ import annotations

__all__ = ["FetchPlant", "dragged"]

import mujoco
import numpy as np

from .coordinates import coordinates
from .fetch_push import HAND, OBJECT
from .plant import Array, Motion, Plant, Policy

_REACH = 0.05  # m per unit of a command
_TURN = (1.0, 0.0, 1.0, 0.0)  # added to the hand's quaternion; MuJoCo normalises the sum
_TABLE = 0.4  # m, its height
_TURNED_OVER = 2.5  # rad
_FINGERS = "robot0:l_gripper_finger_joint", "robot0:r_gripper_finger_joint"


class FetchPlant(Plant):
    """A plant of which the first three commands drag the hand, and others do nothing."""

    def __post_init__(self) -> None:
        """Find hand and fingers."""
        super().__post_init__()
        self._hand = self.model.body(HAND).id
        self._fingers = [int(self.model.joint(name).qposadr[0]) for name in _FINGERS]
        self._begun = np.zeros(3), np.zeros(4)

    def run(self, q: Array, v: Array, policy: Policy, *, steps: int) -> Motion:
        """Return a trajectory, as `Plant.run`.

        Raises:
            FloatingPointError: It diverged; or the object fell off the table or was turned over:
                rotation vectors leap at half a turn.
        """
        motion = super().run(q, v, policy, steps=steps)
        heights, turns = motion.clean[:, OBJECT + 2], motion.clean[:, OBJECT + 3 : OBJECT + 6]
        if heights.min() < _TABLE or np.linalg.norm(turns, axis=1).max() > _TURNED_OVER:
            raise FloatingPointError("the object fell or was turned over")
        return motion

    def go(self) -> None:
        """Go on by a control step, from where the hand is, and close the fingers."""
        self._begun = self.data.xpos[self._hand].copy(), self.data.xquat[self._hand].copy()
        super().go()
        self.data.qpos[self._fingers] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def _advance(self, u: Array, force: Array) -> None:
        place, turn = self._begun
        self.data.mocap_pos[0] = place + _REACH * np.clip(u[:3], -1.0, 1.0)
        self.data.mocap_quat[0] = turn + _TURN
        self.data.qfrc_applied[:] = force
        mujoco.mj_step(self.model, self.data)


def dragged(model: mujoco.MjModel, x: Array, u: Array, substeps: int) -> Array:
    """Return what follows from states, as `detectability` asks, shape ``(segments, T, 2 nv)``.

    Args:
        model: Without causes.
        x: Tangent coordinates, ``(segments, 2 nv)``.
        u: Commands, ``(segments, T, nu)``.
        substeps: Time steps per control step.
    """
    noise, rng = np.zeros(2 * model.nv), np.random.default_rng(0)
    plant = FetchPlant(model, substeps * model.opt.timestep, [], noise, rng)
    found = np.empty((*u.shape[:2], x.shape[1]))
    for state, commands, rows in zip(x, u, found, strict=True):
        plant.begin(state)
        for k, command in enumerate(commands):
            plant.commands.append(command)
            plant.go()
            rows[k] = np.concatenate([coordinates(model, plant.q), plant.v])
    return found
