"""Gymnasium-Robotics' FetchPush-v4: its model, and where its arm begins."""

from __future__ import annotations

__all__ = [
    "ARM",
    "COMMANDS",
    "EFFECTS",
    "HAND",
    "NOISE",
    "OBJECT",
    "SIMULATOR",
    "fetch_push_model",
    "start",
]

from copy import deepcopy
from functools import cache

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SIMULATOR = "gymnasium:FetchPush-v4"
COMMANDS = tuple(f"action{i}" for i in range(4))  # of the hand along x, y, z; the fingers' is idle
HAND = "robot0:gripper_link"  # the body that the mocap body drags
ARM = tuple(range(6, 13))  # degrees of freedom from the shoulder to the wrist
OBJECT = 15  # the first degree of freedom of the object, which are its last six
# Times that of a rotation of the object: base and torso stand still, held by dampers so strong that
# a simulation which began from their noise would fly apart; then head, arm and fingers; the object
NOISE = *(0.0,) * 4, *(0.1,) * 11, *(0.3,) * 3, *(1.0,) * 3
# What acts on commands, bodies, gravity, contacts and sensors. An arm that is dragged by its hand
# shows nothing of what acts in its joints, and to try that at each of them would take far longer
EFFECTS = (
    *("action_delay", "action_lag", "dead_band", "saturation", "action_gain", "action_bias"),
    *("battery_sag", "packet_drop", "action_jitter", "action_quantization"),
    *("gravity_tilt", "payload", "com_shift", "link_length", "time_scale"),
    *("contact_friction", "contact_softness"),
    *("sensor_delay", "sensor_bias", "sensor_gain", "sensor_noise", "sensor_quantization"),
    *("sensor_lag", "sensor_drift", "sensor_dropout"),
)


def fetch_push_model() -> mujoco.MjModel:
    """Return the model, with the offsets of its weld that the environment sets."""
    return deepcopy(_made()[0])


def start() -> tuple[Array, Array]:
    """Return positions and velocities after a reset, ``(nq,)`` and ``(nv,)``."""
    _, qpos, qvel = _made()
    return qpos.copy(), qvel.copy()


@cache
def _made() -> tuple[mujoco.MjModel, Array, Array]:
    import gymnasium_robotics  # only where this robot is asked for: the others do without

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make("FetchPush-v4").unwrapped
    env.reset(seed=0)
    return deepcopy(env.model), env.data.qpos.copy(), env.data.qvel.copy()
