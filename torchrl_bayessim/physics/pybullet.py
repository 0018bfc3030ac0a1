"""Contact parameters of PyBullet's gymnasium environments, such as ``HopperBulletEnv-v0``.

Needs the extra ``pybullet``, and ``import pybullet_envs_gymnasium`` before the environment is
made. Bullet **multiplies** the lateral frictions of the two bodies in contact (measured: a box
decelerates at ``μ₁ μ₂ g``), so 0.4 on the floor under a foot of 0.8 acts as 0.32. An
environment that steps several at once has them in a list ``simulators``.
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
        """Set the parts' contact parameters in the simulators of ``mask``."""
        del tensordict
        nominal = env.__dict__.setdefault("_nominal_contact", {})
        for i, simulator in enumerate(_simulators(env)):
            if mask.reshape(-1)[i]:
                values = theta.reshape(-1, len(self.names))[i].tolist()
                for group, value in zip(self._targets, values, strict=True):
                    for field, part in group:
                        nominal.setdefault((i, field, part), _get(simulator, field, part))
                        own = nominal[i, field, part] if math.isnan(value) else value
                        bullet, where = _locate(simulator, part)
                        bullet.changeDynamics(*where, **{field: own})

    def read(self, env: EnvBase, *, tensordict: TensorDictBase) -> Tensor:
        """Return the parts' values, shape ``(*batch, D)``.

        NaN stands for parts of one parameter that differ; writing it restores them.
        """
        del tensordict
        values = [[_held(one, group) for group in self._targets] for one in _simulators(env)]
        return torch.tensor(values, dtype=torch.float64).reshape(*env.batch_size, -1)


def _parse(target: str) -> tuple[str, str]:
    match = re.fullmatch(r"(\w+)\[(.+)\]", target)
    if match is None or match[1] not in _FIELDS:
        raise PhysicsError(message("field[part]", target, available=_FIELDS))
    return match[1], match[2]


def _simulators(env: EnvBase) -> list[Any]:
    """Return the simulators inside: those of an environment of many, or the one."""
    inside = simulator_of(env)
    return vars(inside).get("simulators", [inside])


def _held(simulator: Any, group: list[tuple[str, str]]) -> float:
    """Return the value that all parts of a group have; NaN if they differ."""
    held = [_get(simulator, field, part) for field, part in group]
    same = all(math.isclose(value, held[0], rel_tol=1e-6) for value in held)
    return held[0] if same else math.nan


def _get(simulator: Any, field: str, part: str) -> float:
    bullet, where = _locate(simulator, part)
    return bullet.getDynamicsInfo(*where)[_FIELDS[field]]


def _locate(simulator: Any, part: str) -> tuple[Any, tuple[int, int]]:
    """Return the client, and the part's body and link; the first reset builds the world."""
    if not hasattr(simulator, "parts"):
        simulator.reset()
    if part not in simulator.parts:
        available = sorted(simulator.parts)
        raise PhysicsError(message("a part of the scene", part, available=available))
    found = simulator.parts[part]
    return simulator._p, (found.bodies[found.bodyIndex], found.bodyPartIndex)
