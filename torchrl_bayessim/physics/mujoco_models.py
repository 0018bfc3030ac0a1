"""Where the MuJoCo models of an environment are, and how to read and write their entries."""

from __future__ import annotations

__all__ = ["MujocoModels", "models_of"]

from collections.abc import Set
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import PhysicsError, message
from .assignments import Assignments
from .consequences import bad_value, check_settable, check_values
from .derived import derive
from .frames import separate
from .geom_bounds import fit_bounds
from .idle import Place
from .protocol import simulator_of


class MujocoModels:
    """One interface to the model of one environment, and to those of a batched one.

    Attributes:
        model: The one model, or the batched environment's nominal one.
        resolved: What to set, by the targets that it was resolved from.
    """

    def __init__(self, model: mujoco.MjModel, batch: Any = None) -> None:
        self.model, self._batch = model, batch
        self.resolved: dict[tuple[tuple[str, ...], ...], Assignments] = {}
        self._nominal: dict[str, NDArray[np.float64]] = {}
        self._scratch: mujoco.MjData | None = None
        self._written: dict[tuple[str, tuple[int, ...]], None] = {}

    def nominal(self, field: str, indices: tuple[int, ...]) -> float:
        """Return the value of an entry before anything was written."""
        if field not in self._nominal:  # nobody but us writes, and every write asks first
            self._nominal[field] = _array(self.model, field).copy()
        return float(self._nominal[field][indices])

    @property
    def places(self) -> Set[Place]:
        """The entries that have been written."""
        return self._written.keys() if self._batch is None else self._batch.places

    def read(self, field: str, indices: tuple[int, ...]) -> NDArray[np.float64]:
        """Return an entry, one number per environment."""
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
        """Set an entry in the environments ``rows``; see `consequences` for which may be set.

        Raises:
            PhysicsError: The entry cannot be set, or not to this value.
        """
        if self._batch is not None:
            self._batch.write(field, indices, values, rows)
        elif rows.all():
            if (field, indices) not in self._written:
                check_settable(self.model, field, indices, along=self.places)
            check_values((field, indices), values)
            self.put(field, indices, values, rows)

    def put(
        self,
        field: str,
        indices: tuple[int, ...],
        values: NDArray[np.float64],
        rows: NDArray[np.bool_],
    ) -> None:
        """Set an entry without asking whether it may be set."""
        if self._batch is not None:
            self._batch.put(field, indices, values, rows)
        elif rows.all():
            self.nominal(field, indices)
            self._set(field, indices, float(values[0]))

    def _set(self, field: str, indices: tuple[int, ...], value: float) -> None:
        self._written[field, indices] = None
        if indices:
            separate(self.model, field, indices[0])
            _array(self.model, field)[indices] = value
        else:
            setattr(self.model.opt, field.removeprefix("opt."), value)

    def assign(
        self, entries: Assignments, theta: NDArray[np.float64], rows: NDArray[np.bool_]
    ) -> None:
        """Set what follows from ``theta``, shape ``(N, D)``, in the environments ``rows``.

        Raises:
            PhysicsError: A value is not finite, or negative where it cannot be.
        """
        if self._batch is not None:
            self._batch.assign(entries, theta, rows)
        elif rows.all():
            base, scale, nominal, least = entries.numbers.T
            new = base * (theta[0, entries.parameter] / scale)
            new = np.where(np.isnan(new), nominal, new)
            if not (good := np.isfinite(new) & (new >= least)).all():
                wrong = int(good.argmin())
                raise bad_value(entries.places[wrong], float(new[wrong]))
            for (field, indices), value in zip(entries.places, new.tolist(), strict=True):
                self._set(field, indices, value)

    def held(self, entries: Assignments) -> NDArray[np.float64]:
        """Return the entries' values as parameters, so without their signs, shape ``(N, P)``."""
        if self._batch is not None:
            return self._batch.held(entries)
        values = [_array(self.model, field)[indices] for field, indices in entries.places]
        return np.array([values]) * np.sign(entries.numbers[:, 0])

    def refresh(self, rows: NDArray[np.bool_]) -> None:
        """Bring up to date what follows from entries that were written; see `consequences`."""
        if self._batch is not None:
            self._batch.refresh(rows)
        elif rows.all():
            fit_bounds(self, list(self._written), rows)
            if self._scratch is None:  # mj_setConst leaves its data at qpos0: not the simulator's
                self._scratch = mujoco.MjData(self.model)
            derive(self.model, self._scratch)


def _array(model: mujoco.MjModel, field: str) -> NDArray[np.float64]:
    owner = model.opt if field.startswith("opt.") else model
    return np.asarray(getattr(owner, field.removeprefix("opt.")))


def models_of(env: Any) -> MujocoModels:
    """Return the environment's models, noted on the environment itself."""
    # not getattr: TorchRL's looks through hundreds of names for what is missing
    batch = env.models if hasattr(type(env), "models") else None
    model = _model(env) if batch is None else batch.model
    known = env.__dict__.get("_mujoco_models")
    if known is None or known.model is not model:
        known = env.__dict__["_mujoco_models"] = MujocoModels(model, batch)
    return known


def _model(env: Any) -> mujoco.MjModel:
    inner = simulator_of(env)
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
