"""A robot of one hinge in another engine: PyBullet, of the extra ``pybullet``.

The link is described anew as URDF from the true model's numbers. Bullet has no rotor inertia, which
about one axis is the link's; of several joints it would not be, so there is one. Damping and
commands are applied as torques. Bullet integrates by semi-implicit Euler steps.
"""

from __future__ import annotations

__all__ = ["BulletPlant", "urdf"]

import tempfile
from pathlib import Path

import mujoco
import numpy as np

from .plant import Array, Plant

URDF = """<robot name="robot"><link name="base"/>
<link name="link"><inertial><origin xyz="{x} {y} {z}"/><mass value="{mass}"/>
<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base"/><child link="link"/>
<axis xyz="0 1 0"/></joint></robot>
"""


def urdf(model: mujoco.MjModel) -> str:
    """Return the description of a link on a hinge about the second axis.

    Raises:
        ValueError: The robot is another.
    """
    if model.nv != 1 or not np.array_equal(model.jnt_axis[0], [0, 1, 0]):
        raise ValueError(f"expected one hinge about the second axis, got {model.njnt} joints")
    body = int(model.jnt_bodyid[0])
    x, y, z = model.body_ipos[body]
    # about the other axes nothing turns, and Bullet refuses moments that no body could have
    inertia = model.body_inertia[body, 1] + model.dof_armature[0]
    return URDF.format(x=x, y=y, z=z, mass=model.body_mass[body], i=inertia)


class BulletPlant(Plant):
    """A plant that PyBullet moves; causes see the same positions, velocities and times."""

    def __post_init__(self) -> None:
        """Load the link, after the causes have altered the model."""
        try:
            from pybullet_utils.bullet_client import BulletClient
        except ImportError:
            expected = "expected PyBullet for tier T6B, got none"
            raise ImportError(f"{expected}; try pip install 'torchrl_bayessim[pybullet]'") from None
        super().__post_init__()
        self._state, self._time = np.zeros((2, 1)), 0.0
        self._bullet = BulletClient()
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "robot.urdf")
            file.write_text(urdf(self.model))
            flags = self._bullet.URDF_USE_INERTIA_FROM_FILE
            self._robot = self._bullet.loadURDF(str(file), useFixedBase=True, flags=flags)
        self._bullet.changeDynamics(
            self._robot, 0, linearDamping=0, angularDamping=0, jointDamping=0, maxJointVelocity=1e3
        )
        self._bullet.setGravity(*self.model.opt.gravity)
        self._bullet.setTimeStep(self.dt)
        torque = self._bullet.VELOCITY_CONTROL  # of the motor that every joint has, switched off
        self._bullet.setJointMotorControl2(self._robot, 0, torque, force=0)

    @property
    def time(self) -> float:
        """Seconds since the start."""
        return self._time

    @property
    def q(self) -> Array:
        """Positions."""
        return self._state[0]

    @property
    def v(self) -> Array:
        """Velocities."""
        return self._state[1]

    def _reset(self, q: Array, v: Array) -> None:
        self._bullet.resetJointState(self._robot, 0, float(q[0]), float(v[0]))
        self._state, self._time = np.array([q, v], dtype=np.float64), 0.0

    def _advance(self, u: Array, force: Array) -> None:
        limit = self.model.actuator_ctrlrange[0]
        torque = self.model.actuator_gear[0, 0] * np.clip(u[0], *limit) + force[0]
        torque -= self.model.dof_damping[0] * self.v[0]
        mode = self._bullet.TORQUE_CONTROL
        self._bullet.setJointMotorControl2(self._robot, 0, mode, force=float(torque))
        self._bullet.stepSimulation()
        self._state = np.array(self._bullet.getJointState(self._robot, 0)[:2])[:, None]
        self._time += self.dt
