"""Contact parameters of PyBullet's gymnasium environments, such as ``HopperBulletEnv-v0``.

Needs the extra ``pybullet``, and ``import pybullet_envs_gymnasium`` before the environment is
made. Bullet **multiplies** the lateral frictions of the two bodies in contact (measured: a box
decelerates at ``μ₁ μ₂ g``), so 0.4 on the floor under a foot of 0.8 acts as 0.32.
"""

from __future__ import annotations

__all__ = ["PyBulletPhysics"]

import math
import re
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ..errors import PhysicsError, message
from .protocol import simulator_of

# the keyword of changeDynamics, and its place in getDynamicsInfo
_FIELDS = {"lateralFriction": 1, "restitution": 5, "rollingFriction": 6, "spinningFriction": 7}


class PyBulletPhysics:
    """Sets ``field[part]``: lateralFriction, rollingFriction, spinningFriction or restitution.

    Args:
        *targets: Such as ``"lateralFriction[floor]"``, each a parameter of that name.
        **aliases: A name for a target, or for several that are all set to one value.

    Raises:
        ValueError: There is no parameter, or two have the same name.
        PhysicsError: There is no such field or part.

    Example:
        >>> PyBulletPhysics("restitution[floor]", friction="lateralFriction[foot]").names
        ('restitution[floor]', 'friction')
    """

    def __init__(self, *targets: str, **aliases: str | tuple[str, ...]) -> None:
        groups = [(target, (target,)) for target in targets]
        groups += [(n, (t,) if isinstance(t, str) else tuple(t)) for n, t in aliases.items()]
        self.names = tuple(name for name, _ in groups)
        self._targets = [[_parse(target) for target in group] for _, group in groups]
        if not groups or len(set(self.names)) != len(groups) or not all(self._targets):
            raise ValueError(message("parameters, each once and with a target", self.names))

    def write(
        self, env: EnvBase, theta: Tensor, *, mask: Tensor, tensordict: TensorDictBase
    ) -> None:
        """Set the parts' contact parameters."""
        del tensordict
        nominal = env.__dict__.setdefault("_nominal_contact", {})
        if mask.all():
            for group, value in zip(self._targets, theta.tolist(), strict=True):
                for field, part in group:
                    nominal.setdefault((field, part), _get(env, field, part))
                    own = nominal[field, part] if math.isnan(value) else value
                    bullet, where = _locate(env, part)
                    bullet.changeDynamics(*where, **{field: own})

    def read(self, env: EnvBase, *, tensordict: TensorDictBase) -> Tensor:
        """Return the parts' values, shape ``(D,)``.

        NaN stands for parts of one parameter that differ; writing it restores them.
        """
        del tensordict
        values = []
        for group in self._targets:
            held = [_get(env, field, part) for field, part in group]
            same = all(math.isclose(value, held[0], rel_tol=1e-6) for value in held)
            values.append(held[0] if same else math.nan)
        return torch.tensor(values, dtype=torch.float64)


def _parse(target: str) -> tuple[str, str]:
    match = re.fullmatch(r"(\w+)\[(.+)\]", target)
    if match is None or match[1] not in _FIELDS:
        raise PhysicsError(message("field[part]", target, available=_FIELDS))
    return match[1], match[2]


def _get(env: EnvBase, field: str, part: str) -> float:
    bullet, where = _locate(env, part)
    return bullet.getDynamicsInfo(*where)[_FIELDS[field]]


def _locate(env: EnvBase, part: str) -> tuple[Any, tuple[int, int]]:
    """Return the client, and the part's body and link; the first reset builds the world."""
    inside = simulator_of(env)
    if not hasattr(inside, "parts"):
        inside.reset()
    if part not in inside.parts:
        raise PhysicsError(message("a part of the scene", part, available=sorted(inside.parts)))
    found = inside.parts[part]
    return inside._p, (found.bodies[found.bodyIndex], found.bodyPartIndex)
