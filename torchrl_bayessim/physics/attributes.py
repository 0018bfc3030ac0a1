"""Parameters that are attributes of a Python object, such as gymnasium's classic control.

============================  =================================================================
environment                   parameters (SI units)
============================  =================================================================
``CartPole``                  masspole, masscart (kg), length (m, **half** the pole), gravity,
                              force_mag (N), tau (s)
``Pendulum``                  m (kg), l (m), g (m/s²), dt (s), max_torque (N m), max_speed (rad/s)
``MountainCarContinuous``     power (per step)
``MountainCar``               force, gravity (per step)
``Acrobot``                   LINK_MASS_1/2 (kg), LINK_LENGTH_1/2, LINK_COM_POS_1/2 (m),
                              LINK_MOI (kg m²)
============================  =================================================================

Gymnasium's CartPole keeps ``total_mass`` and ``polemass_length`` beside the values they come
from; both follow here. Its Acrobot keeps centres of mass and inertia as constants of their own, so
that there ``LINK_LENGTH_2`` enters nothing at all; ``coupled=True`` makes the links uniform rods.
"""

from __future__ import annotations

__all__ = ["AttributePhysics"]

from types import MethodType
from typing import Any

import numpy as np
import torch
from gymnasium.envs.classic_control.acrobot import AcrobotEnv
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ..errors import PhysicsError, message
from ..kinds import check_names
from .protocol import simulator_of

_UNITS = {
    "masspole": "kg", "masscart": "kg", "length": "m", "gravity": "m/s²", "force_mag": "N",
    "tau": "s", "m": "kg", "l": "m", "g": "m/s²", "dt": "s", "max_torque": "N m",
    "max_speed": "rad/s", "LINK_MASS_1": "kg", "LINK_MASS_2": "kg", "LINK_LENGTH_1": "m",
    "LINK_LENGTH_2": "m", "LINK_COM_POS_1": "m", "LINK_COM_POS_2": "m", "LINK_MOI": "kg m²",
}  # fmt: skip


_POSITIVE = {
    "masspole", "masscart", "length", "tau", "m", "l", "dt", "max_torque", "max_speed",
    "LINK_MASS_1", "LINK_MASS_2", "LINK_LENGTH_1", "LINK_LENGTH_2", "LINK_MOI",
}  # fmt: skip


class AttributePhysics:
    """Sets numeric attributes of the simulator, and what gymnasium derives from them.

    The simulator is the gymnasium environment inside a ``GymEnv``, or else the TorchRL environment
    itself. One with ``set_parameters(theta, mask)`` and ``parameters`` (dictionaries from a name to
    values of the batch's shape) is written through those: many environments in one call.

    Args:
        *names: The attributes, in the order of the columns of θ.
        coupled: Make Acrobot's links uniform rods: centre of mass at half the length and inertia
            ``m l² / 12`` about it, for each link. By default they stay gymnasium's constants.

    Raises:
        TypeError: A name is no string.
        ValueError: There is no name, or one twice.
        PhysicsError: The simulator has no such number (environments are checked when wrapped); in a
            write, a mass, length, time or limit of the table above that is not positive.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_bayessim.transforms import ApplyPhysics
        >>> env = GymEnv("CartPole-v1")
        >>> env = TransformedEnv(env, ApplyPhysics(AttributePhysics("masspole", "length")))
        >>> _ = env.reset(env.full_state_spec.zero().set("theta", torch.tensor([0.3, 0.7])))
        >>> round(env.unwrapped.total_mass, 6)
        1.3
    """

    def __init__(self, *names: str, coupled: bool = False) -> None:
        check_names("attribute names, each once", names)
        self.names, self.coupled = names, coupled

    @property
    def units(self) -> tuple[str, ...]:
        """The parameters' SI units; empty where they are not known."""
        return tuple(_UNITS.get(name, "") for name in self.names)

    def write(
        self, env: EnvBase, theta: Tensor, *, mask: Tensor, tensordict: TensorDictBase
    ) -> None:
        """Set the attributes of the environments in ``mask``, then what is derived from them."""
        del tensordict
        target = _target(env)
        self._check(target)
        self._check_values(theta, mask)
        if _is_batched(target):
            target.set_parameters(dict(zip(self.names, theta.unbind(-1), strict=True)), mask)
        elif mask.all():
            for name, value in zip(self.names, theta.tolist(), strict=True):
                setattr(target, name, value)
            self._couple(target)

    def read(self, env: EnvBase, *, tensordict: TensorDictBase) -> Tensor:
        """Return the attributes' values, shape ``(*batch, D)``."""
        del tensordict
        target = _target(env)
        self._check(target)
        if _is_batched(target):
            values = target.parameters
            return torch.stack([values[name].to(torch.float64) for name in self.names], -1)
        return torch.tensor([getattr(target, name) for name in self.names], dtype=torch.float64)

    def _check(self, target: Any) -> None:
        numbers = target.parameters if _is_batched(target) else _numbers(target)
        for name in self.names:
            if name not in numbers:
                what = f"a numeric attribute of {type(target).__name__}"
                raise PhysicsError(message(what, name, available=sorted(numbers)))

    def _check_values(self, theta: Tensor, mask: Tensor) -> None:
        for name, values in zip(self.names, theta.unbind(-1), strict=True):
            wrong = mask.reshape(values.shape) & ~(values > 0)
            if name in _POSITIVE and wrong.any():
                raise PhysicsError(message(f"{name} to be positive", values[wrong][0].item()))

    def _couple(self, target: Any) -> None:
        if isinstance(target, CartPoleEnv):
            target.total_mass = target.masspole + target.masscart
            target.polemass_length = target.masspole * target.length
        elif isinstance(target, AcrobotEnv) and self.coupled:
            target.LINK_COM_POS_1 = target.LINK_LENGTH_1 / 2
            target.LINK_COM_POS_2 = target.LINK_LENGTH_2 / 2
            # Gymnasium has one moment of inertia for both links; two rods have two.
            target._dsdt = MethodType(_rods, target)


def _target(env: EnvBase) -> Any:
    return env if _is_batched(env) else simulator_of(env)


def _is_batched(target: Any) -> bool:
    return hasattr(type(target), "set_parameters")


def _numbers(target: Any) -> set[str]:
    """Return the names of the object's own and its class's numeric attributes."""
    found = {n for c in type(target).__mro__ for n, v in vars(c).items() if _is_number(v)}
    return {n for n in found | {n for n, v in vars(target).items() if _is_number(v)} if n[0] != "_"}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _rods(acrobot: Any, augmented: Any) -> tuple[float, ...]:
    """Return the time derivative of Acrobot's state and torque with uniform rods as links.

    ``M(q) q̈ = (0, τ) − c(q, q̇) − g(q)``, of two links hinged at a fixed point, angles from the
    vertical; Sutton & Barto (1998), chapter 11.3, with an inertia for each link.
    """
    q1, q2, v1, v2, torque = augmented
    m1, m2 = acrobot.LINK_MASS_1, acrobot.LINK_MASS_2
    l1, c1, c2 = acrobot.LINK_LENGTH_1, acrobot.LINK_COM_POS_1, acrobot.LINK_COM_POS_2
    i1, i2 = (m * (2 * c) ** 2 / 12 for m, c in ((m1, c1), (m2, c2)))
    a, b, d = i1 + m1 * c1**2 + m2 * l1**2, m2 * l1 * c2, i2 + m2 * c2**2
    m11, m12, m22 = a + d + 2 * b * np.cos(q2), d + b * np.cos(q2), d
    gravity2 = 9.8 * m2 * c2 * np.sin(q1 + q2)
    gravity1 = 9.8 * (m1 * c1 + m2 * l1) * np.sin(q1) + gravity2
    force1 = b * np.sin(q2) * (v2**2 + 2 * v1 * v2) - gravity1
    centrifugal = 0.0 if acrobot.book_or_nips == "nips" else b * np.sin(q2) * v1**2
    force2 = torque - centrifugal - gravity2
    determinant = m11 * m22 - m12**2
    a1 = (m22 * force1 - m12 * force2) / determinant
    a2 = (m11 * force2 - m12 * force1) / determinant
    return v1, v2, a1, a2, 0.0
