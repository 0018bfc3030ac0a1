"""Parameters that are entries of a MuJoCo model, by name.

Works wherever an ``MjModel`` can be reached: gymnasium and gymnasium-robotics through ``GymEnv``,
``DMControlEnv``, TorchRL's own ``MujocoEnv`` with ``backend="mujoco"``, any environment with
``model`` and ``data``, and this package's batched environments.

MuJoCo takes the friction of a contact as the element-wise **maximum** of the two geoms' unless
their priorities differ (https://mujoco.readthedocs.io/en/stable/modeling.html#contact-parameters):
set both geoms, under one name::

    MujocoPhysics(friction=("geom_friction[body:table0,0]", "geom_friction[object0,0]"))
"""

from __future__ import annotations

__all__ = ["MujocoPhysics"]

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ..errors import message
from .assignments import Assignments, assignments
from .consequences import DERIVED_FROM
from .model_fields import Entries, resolve
from .mujoco_models import MujocoModels, models_of

_UNITS = {
    "body_mass": "kg", "body_inertia": "kg m²", "body_ipos": "m", "body_pos": "m", "geom_size": "m",
    "dof_damping": "N m s/rad", "dof_frictionloss": "N m", "dof_armature": "kg m²",
    "jnt_stiffness": "N m/rad", "opt.gravity": "m/s²", "opt.timestep": "s", "opt.wind": "m/s",
    "opt.density": "kg/m³", "opt.viscosity": "Pa s",
}  # fmt: skip


class MujocoPhysics:
    """Sets entries of the model; what follows from them follows.

    A body's inertia scales with its mass, the bounds of geoms follow their sizes and places, and
    what MuJoCo derives from masses, inertias, positions and gears is recomputed; entries that
    cannot be set, or to no effect, are refused (see `consequences`).

    Args:
        *targets: Entries, each a parameter of that name; `model_fields` says how to write them.
        **aliases: A name for an entry, or for several that are all set to one value.

    Where a parameter's entries hold different values, as they may in the nominal model, `read`
    gives NaN, and writing NaN restores each to its own nominal value: to this class NaN means
    nominal, wherever it comes from. `Replay` refuses it.

    Raises:
        TypeError: A target is not a string.
        ValueError: There is no parameter, or two have the same name.
        PhysicsError: The model has no such entry. (Environments are checked when wrapped.)

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_bayessim.transforms import ApplyPhysics
        >>> foot = ("geom_friction[floor,0]", "geom_friction[foot_geom,0]")
        >>> physics = MujocoPhysics("body_mass[torso]", friction=foot)
        >>> env = TransformedEnv(GymEnv("Hopper-v5"), ApplyPhysics(physics))
        >>> theta = torch.tensor([4.0, 0.7])
        >>> env.reset(env.full_state_spec.zero().set("theta", theta))["theta"]
        tensor([4.0000, 0.7000])
    """

    def __init__(self, *targets: str, **aliases: str | tuple[str, ...]) -> None:
        groups: list[tuple[str, tuple[str, ...]]] = [(target, (target,)) for target in targets]
        for name, given in aliases.items():
            groups.append((name, tuple(given) if isinstance(given, tuple | list) else (given,)))
        for target in (target for _, group in groups for target in group):
            if not isinstance(target, str):
                hint = "body_mass[torso]"
                raise TypeError(message("the name of an entry of a model", target, hint=hint))
        self.names = tuple(name for name, _ in groups)
        self._targets = tuple(group for _, group in groups)
        if not groups or len(set(self.names)) != len(groups) or not all(self._targets):
            raise ValueError(message("parameters, each once and with a target", self.names))

    @property
    def fields(self) -> frozenset[str]:
        """The fields of the model whose entries are set, such as ``body_mass``."""
        return frozenset(_field(target) for group in self._targets for target in group)

    def entries(self, model: mujoco.MjModel) -> list[list[Entries]]:
        """Return the entries of a model that each parameter sets.

        Raises:
            PhysicsError: The model has no such entry.
        """
        return [[resolve(model, target) for target in group] for group in self._targets]

    @property
    def units(self) -> tuple[str, ...]:
        """The parameters' SI units, of hinges for joints; empty where they depend on the model."""
        return tuple(_UNITS.get(_field(group[0]), "") for group in self._targets)

    def write(
        self, env: EnvBase, theta: Tensor, *, mask: Tensor, tensordict: TensorDictBase
    ) -> None:
        """Set the entries of the environments in ``mask``, then what is derived from them."""
        del tensordict
        models, entries = self._resolved(env)
        values = theta.numpy().astype(np.float64, copy=False).reshape(-1, len(self.names))
        rows = mask.numpy().reshape(-1)
        models.assign(entries, values, rows)
        if not DERIVED_FROM.isdisjoint(entries.fields):
            models.refresh(rows)

    def read(self, env: EnvBase, *, tensordict: TensorDictBase) -> Tensor:
        """Return the entries' values, shape ``(*batch, D)``."""
        del tensordict
        models, entries = self._resolved(env)
        held = models.held(entries)
        columns = []
        for group in entries.groups:
            first = held[:, group[0]]
            if len(group) > 1:
                others = held[:, group]
                # not np.isclose, which takes longer than all else here
                same = np.abs(others - first[:, None]) <= 1e-9 * np.abs(first)[:, None]
                first = np.where(same.all(1), first, np.nan)
            columns.append(first)
        return torch.from_numpy(np.stack(columns, -1)).reshape(*getattr(env, "batch_size", ()), -1)

    def _resolved(self, env: EnvBase) -> tuple[MujocoModels, Assignments]:
        """Return the models and this adapter's entries of them, resolved once per model."""
        models = models_of(env)
        known = models.resolved.get(self._targets)
        if known is None:
            groups = self.entries(models.model)
            known = models.resolved[self._targets] = assignments(models, groups)
        return models, known


def _field(target: str) -> str:
    return target.lstrip("-").split("[")[0]
