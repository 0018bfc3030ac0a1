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

from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ..errors import PhysicsError, message
from .geom_bounds import fit_bounds
from .model_fields import Entries, resolve

# Fields from which mj_setConst derives others (inverse weights, subtree masses, lengths at qpos0).
_DERIVED_FROM = {
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
        if any(entry.field in _DERIVED_FROM for entry, _ in todo):
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
        models = _models(env)
        known = models.resolved.get(self._targets)
        if known is None:
            known = [[resolve(models.model, t) for t in group] for group in self._targets]
            models.resolved[self._targets] = known
        return models, known


class _Models:
    """One interface to the model of one environment, and to those of a batched one."""

    def __init__(self, model: mujoco.MjModel, batch: Any = None) -> None:
        self.model, self._batch = model, batch
        self.resolved: dict[tuple[tuple[str, ...], ...], list[list[Entries]]] = {}
        self._nominal: dict[str, NDArray[np.float64]] = {}
        self._scratch: mujoco.MjData | None = None

    def nominal(self, field: str, indices: tuple[int, ...]) -> float:
        if field not in self._nominal:  # nobody but us writes, and every write asks first
            self._nominal[field] = _array(self.model, field).copy()
        return float(self._nominal[field][indices])

    def read(self, field: str, indices: tuple[int, ...]) -> NDArray[np.float64]:
        if self._batch is not None:
            return self._batch.read(field, indices)
        return np.array([_array(self.model, field)[indices]])

    def write(
        self,
        field: str,
        indices: tuple[int, ...],
        values: NDArray[np.float64],
        rows: NDArray[np.bool_],
    ) -> None:
        if self._batch is not None:
            self._batch.write(field, indices, values, rows)
        elif rows.all():
            self.nominal(field, indices)
            if indices:
                _array(self.model, field)[indices] = values[0]
            else:
                setattr(self.model.opt, field.removeprefix("opt."), float(values[0]))

    def refresh(self, rows: NDArray[np.bool_]) -> None:
        if self._batch is not None:
            self._batch.refresh(rows)
        elif rows.all():
            if self._scratch is None:  # mj_setConst leaves its data at qpos0: not the simulator's
                self._scratch = mujoco.MjData(self.model)
            view = ("center", "extent", "meansize", "meanmass")  # may be set in the XML
            stat = self.model.stat
            before = {name: np.copy(getattr(stat, name)) for name in view}
            mujoco.mj_setConst(self.model, self._scratch)
            for name, value in before.items():
                setattr(stat, name, value if value.ndim else float(value))


def _array(model: mujoco.MjModel, field: str) -> NDArray[np.float64]:
    owner = model.opt if field.startswith("opt.") else model
    return np.asarray(getattr(owner, field.removeprefix("opt.")))


def _models(env: Any) -> _Models:
    """Return the environment's models, noted on the environment itself."""
    # not getattr: TorchRL's looks through hundreds of names for what is missing
    batch = env.models if hasattr(type(env), "models") else None
    model = _model(env) if batch is None else batch.model
    known = env.__dict__.get("_mujoco_models")
    if known is None or known.model is not model:
        known = env.__dict__["_mujoco_models"] = _Models(model, batch)
    return known


def _model(env: Any) -> mujoco.MjModel:
    inner = env.__dict__.get("_env", env)  # inside GymEnv, DMControlEnv
    inner = getattr(inner, "unwrapped", inner)
    inner = getattr(inner, "physics", inner)  # of dm_control
    backend = env.__dict__.get("_backend")  # of TorchRL's MujocoEnv
    if backend is not None and isinstance(getattr(backend, "_d", None), mujoco.MjData):
        model = backend.mj_model  # other backends only keep the model that they compiled
    else:
        model = getattr(inner, "model", None)
    model = getattr(model, "ptr", model)
    if not isinstance(model, mujoco.MjModel):
        raise PhysicsError(message("an environment with an MjModel", type(inner).__name__))
    return model


def _scale_inertia(
    models: _Models, body: int, mass: NDArray[np.float64], rows: NDArray[np.bool_]
) -> None:
    """Keep a body's shape: its inertia is proportional to its mass."""
    nominal = models.nominal("body_mass", (body,))
    if nominal == 0:
        raise PhysicsError(message("a body that has a nominal mass, to scale its inertia", body))
    for axis in range(3):
        inertia = models.nominal("body_inertia", (body, axis))
        models.write("body_inertia", (body, axis), inertia * (mass / nominal), rows)
