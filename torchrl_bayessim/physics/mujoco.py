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

__all__ = ["DERIVED_FROM", "MujocoPhysics"]

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ..errors import PhysicsError, message
from .geom_bounds import fit_bounds
from .model_fields import Entries, resolve
from .mujoco_models import MujocoModels, models_of

# Fields from which mj_setConst derives others (inverse weights, subtree masses, lengths at qpos0).
DERIVED_FROM = {
    "body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat",
    "dof_armature", "jnt_pos", "jnt_axis", "site_pos", "actuator_gear", "tendon_stiffness",
}  # fmt: skip
_UNITS = {
    "body_mass": "kg", "body_inertia": "kg m²", "body_ipos": "m", "body_pos": "m", "geom_size": "m",
    "dof_damping": "N m s/rad", "dof_frictionloss": "N m", "dof_armature": "kg m²",
    "jnt_stiffness": "N m/rad", "opt.gravity": "m/s²", "opt.timestep": "s", "opt.wind": "m/s",
    "opt.density": "kg/m³", "opt.viscosity": "Pa s",
}  # fmt: skip


class MujocoPhysics:
    """Sets entries of the model; what follows from them follows.

    A body's inertia scales with its mass, a geom's bounds with its size, and what MuJoCo derives
    from masses, inertias, positions and gears is recomputed (``mj_setConst``).

    Args:
        *targets: Entries, each a parameter of that name; `model_fields` says how to write them.
        **aliases: A name for an entry, or for several that are all set to one value.

    Where a parameter's entries hold different values, as they may in the nominal model, `read`
    gives NaN, and writing that NaN restores each to its own nominal value.

    Raises:
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
        groups = [(target, (target,)) for target in targets]
        groups += [(n, (t,) if isinstance(t, str) else tuple(t)) for n, t in aliases.items()]
        self.names = tuple(name for name, _ in groups)
        self._targets = tuple(group for _, group in groups)
        if not groups or len(set(self.names)) != len(groups) or not all(self._targets):
            raise ValueError(message("parameters, each once and with a target", self.names))

    @property
    def units(self) -> tuple[str, ...]:
        """The parameters' SI units, of hinges for joints; empty where they depend on the model."""
        fields = [group[0].lstrip("-").split("[")[0] for group in self._targets]
        return tuple(_UNITS.get(field, "") for field in fields)

    def write(
        self, env: EnvBase, theta: Tensor, *, mask: Tensor, tensordict: TensorDictBase
    ) -> None:
        """Set the entries of the environments in ``mask``, then what is derived from them."""
        del tensordict
        models, entries = self._resolved(env)
        values = theta.reshape(-1, len(self.names)).to(torch.float64).numpy()
        rows = mask.reshape(-1).numpy()
        # Masses first: they scale inertias, which may be parameters themselves.
        todo = [(e, values[:, i]) for i, group in enumerate(entries) for e in group]
        for entry, value in sorted(todo, key=lambda pair: pair[0].field != "body_mass"):
            for indices in entry.indices:
                nominal = models.nominal(entry.field, indices)
                new = np.where(np.isnan(value), nominal, entry.sign * value)
                models.write(entry.field, indices, new, rows)
                if entry.field == "body_mass":
                    _scale_inertia(models, indices[0], new, rows)
                elif entry.field == "geom_size":
                    fit_bounds(models, indices[0], rows)
        if any(entry.field in DERIVED_FROM for entry, _ in todo):
            models.refresh(rows)

    def read(self, env: EnvBase, *, tensordict: TensorDictBase) -> Tensor:
        """Return the entries' values, shape ``(*batch, D)``."""
        del tensordict
        models, entries = self._resolved(env)
        columns = []
        for group in entries:
            held = np.stack([e.sign * models.read(e.field, i) for e in group for i in e.indices])
            # not np.isclose, which takes longer than all else here
            same = (np.abs(held - held[0]) <= 1e-9 * np.abs(held[0])).all(0)
            columns.append(np.where(same, held[0], np.nan))
        return torch.from_numpy(np.stack(columns, -1)).reshape(*getattr(env, "batch_size", ()), -1)

    def _resolved(self, env: EnvBase) -> tuple[Any, list[list[Entries]]]:
        """Return the models and this adapter's entries of them, resolved once per model."""
        models = models_of(env)
        known = models.resolved.get(self._targets)
        if known is None:
            known = [[resolve(models.model, t) for t in group] for group in self._targets]
            models.resolved[self._targets] = known
        return models, known


def _scale_inertia(
    models: MujocoModels, body: int, mass: NDArray[np.float64], rows: NDArray[np.bool_]
) -> None:
    """Keep a body's shape: its inertia is proportional to its mass."""
    nominal = models.nominal("body_mass", (body,))
    if nominal == 0:
        raise PhysicsError(message("a body that has a nominal mass, to scale its inertia", body))
    for axis in range(3):
        inertia = models.nominal("body_inertia", (body, axis))
        models.write("body_inertia", (body, axis), inertia * (mass / nominal), rows)
