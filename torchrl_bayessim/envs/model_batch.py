"""N physics for one MuJoCo model: only the entries in which environments differ are stored.

`ModelBatch` keeps one nominal ``MjModel`` and a table ``(N, K)`` with the values of the ``K``
overridden entries (say, the friction of one geom and the mass of one body). Each thread that steps
environments has a private copy of the model, and writes row ``i`` of the table into it before
environment ``i`` is stepped. A thousand environments of a large model thus cost ``K`` numbers each.
"""

from __future__ import annotations

__all__ = ["ModelBatch"]

import copy
from collections.abc import Set

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import PhysicsError, SimulationError, message
from ..physics.assignments import Assignments
from ..physics.consequences import BOUNDS, bad_value, check_settable, check_values
from ..physics.frames import separate, unskip
from ..physics.geom_bounds import fit_bounds
from . import native
from .addresses import SCALARS, address, attribute
from .components import chosen_rows
from .fatal_errors import fault_text
from .scratch import Scratch, derived_places
from .threads import Threads

_Place = tuple[str, tuple[int, ...]]
_SHARE = 32  # environments that are worth another thread


class ModelBatch:
    """The physics of ``num_envs`` environments that share one model.

    Example:
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body name='ball'><freejoint/><geom size='.1'/></body>"
        ...     "</worldbody></mujoco>")
        >>> models = ModelBatch(model, 3)
        >>> models.write("body_mass", (1,), np.array([1.0, 2.0, 3.0]))
        >>> models.read("body_mass", (1,))
        array([1., 2., 3.])

    Args:
        model: The nominal model. It is never changed; environments start from its values.
        num_envs: The number of environments ``N``.
        threads: That refresh many environments at once.

    Attributes:
        model: The nominal model.
        num_envs: The number of environments.
        table: Values of the overridden entries, shape ``(N, K)``.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, *, threads: int = 1) -> None:
        self.model, self.threads = model, threads
        self.num_envs = num_envs
        self.table: NDArray[np.float64] = np.empty((num_envs, 0))
        self._columns: dict[_Place, int] = {}
        self._nominals: list[float] = []  # of the columns
        self._bounding: list[_Place] = []  # those that `fit_bounds` looks at
        self._places: dict[Assignments, NDArray[np.int64]] = {}
        self._scratch: list[Scratch] = []
        self._pool = Threads(max(1, threads - 1))

    def write(
        self,
        field: str,
        indices: tuple[int, ...],
        values: NDArray[np.float64],
        rows: NDArray[np.bool_] | None = None,
    ) -> None:
        """Set one entry of the model in the environments ``rows``.

        What follows from masses, inertias, sizes and positions stays stale until `refresh`.

        Args:
            field: An attribute of ``MjModel`` that holds floating-point numbers (``body_mass``),
                or one of its options (``opt.gravity``, ``opt.timestep``).
            indices: The entry: its row and, for a matrix, its column; empty for a scalar.
            values: One value per environment, in the model's units, shape ``(N,)``.
            rows: Which environments to write, boolean, shape ``(N,)``; default all.

        Raises:
            PhysicsError: The model has no such entry, it cannot be set, or not to these values
                (see `consequences`).
            ValueError: ``values`` or ``rows`` has not shape ``(N,)``.
        """
        values = np.asarray(values, dtype=np.float64)
        if values.shape != (self.num_envs,):
            expected = f"one value per environment, shape ({self.num_envs},)"
            raise ValueError(message(expected, values.shape))
        if rows is not None:
            rows = np.asarray(rows)
            chosen_rows(rows, self.num_envs)
        if (field, indices) not in self._columns:
            self._nominal(field, indices)  # or an error that says what there is
            check_settable(self.model, field, indices, along=self.places)
        check_values((field, indices), values if rows is None else values[rows])
        self.put(field, indices, values, rows)

    def put(
        self,
        field: str,
        indices: tuple[int, ...],
        values: NDArray[np.float64],
        rows: NDArray[np.bool_] | None = None,
    ) -> None:
        """Do what `write` does without asking whether the entry may be set."""
        column = self.column(field, indices)
        where = True if rows is None else np.asarray(rows)
        np.copyto(self.table[:, column], values, where=where)

    def assign(
        self, entries: Assignments, theta: NDArray[np.float64], rows: NDArray[np.bool_]
    ) -> None:
        """Set entries from parameters ``theta``, shape ``(N, D)``, in the environments ``rows``.

        Raises:
            PhysicsError: A value is not finite, or negative where it cannot be; none is written.
            ValueError: ``theta`` or ``rows`` are for another number of environments.
        """
        if not len(theta) == len(rows) == self.num_envs:
            expected = f"parameters and a mask of {self.num_envs} environments"
            raise ValueError(message(expected, f"{theta.shape} and {rows.shape}"))
        places = self._columns_of(entries)
        row, number = native.assign(self.table, rows, theta, places, entries.numbers)
        if row >= 0:
            raise bad_value(entries.places[number], float(theta[row, places[number, 0]]))

    def held(self, entries: Assignments) -> NDArray[np.float64]:
        """Return the entries' values as parameters, so without their signs, shape ``(N, P)``."""
        columns = self._columns_of(entries)[:, 1]
        return self.table[:, columns] * np.sign(entries.numbers[:, 0])

    def _columns_of(self, entries: Assignments) -> NDArray[np.int64]:
        """Return columns of θ and of the table, shape ``(P, 2)``."""
        known = self._places.get(entries)
        if known is None:
            columns = [self.column(*place) for place in entries.places]
            known = self._places[entries] = np.stack([entries.parameter, columns], -1)
        return known

    def read(self, field: str, indices: tuple[int, ...]) -> NDArray[np.float64]:
        """Return one entry of the model in every environment, shape ``(N,)``."""
        column = self._columns.get((field, indices))
        if column is None:
            return np.full(self.num_envs, self._nominal(field, indices))
        return self.table[:, column].copy()

    def column(self, field: str, indices: tuple[int, ...]) -> int:
        """Return the column of the table that holds an entry; there is one from now on."""
        known = self._columns.get((field, indices))
        return self._add(field, indices) if known is None else known

    def refresh(self, rows: NDArray[np.bool_] | None = None) -> None:
        """Bring up to date what follows from entries that were written; see `consequences`.

        Args:
            rows: Which environments to refresh, boolean, shape ``(N,)``; default all.

        Raises:
            PhysicsError: A quaternion is not of unit length.
            ValueError: ``rows`` is no mask of the environments.
            SimulationError: MuJoCo cannot evaluate the physics of an environment.
        """
        selected = chosen_rows(rows, self.num_envs)
        if not self._scratch:
            self._scratch.append(Scratch(self.model))
            for place in derived_places(self.model):
                self.column(*place)
        if self._bounding:
            mask = np.ones(self.num_envs, dtype=bool) if rows is None else np.asarray(rows)
            fit_bounds(self, list(self._bounding), mask)
        threads = min(self.threads, len(selected) // _SHARE)
        if threads < 2:
            self._refresh(0, selected)
            return
        while len(self._scratch) < threads:
            self._scratch.append(Scratch(self.model))
        first, *others = np.array_split(selected, threads)
        futures = [self._pool.submit(self._refresh, i, part) for i, part in enumerate(others, 1)]
        self._refresh(0, first)
        for future in futures:
            future.result()

    def _refresh(self, thread: int, rows: NDArray[np.int64]) -> None:
        scratch = self._scratch[thread]
        if len(scratch.columns) != len(self._columns):
            scratch.columns = self.addresses(scratch.model)
            columns = [self._columns[place] for place in derived_places(self.model)]
            scratch.derived = np.array(columns, dtype=np.int64)
        columns, derived = scratch.columns, scratch.derived
        bad = native.refresh(scratch.owned, rows, self.table, columns, derived)
        if bad >= 0:
            expected = f"physics that MuJoCo can evaluate, not those of environment {bad}"
            raise SimulationError(message(expected, fault_text(scratch.fault)))

    @property
    def places(self) -> Set[_Place]:
        """The entries that are overridden, or may be."""
        return self._columns.keys()

    def resize(self, num_envs: int) -> None:
        """Change the number of environments; new ones have the nominal physics."""
        if num_envs > self.num_envs:
            more = np.tile(np.array(self._nominals), (num_envs - self.num_envs, 1))
            self.table = np.concatenate([self.table, more])
        self.table = self.table[:num_envs].copy()
        self.num_envs = num_envs

    def restore(self) -> None:
        """Give all environments the nominal physics."""
        self.table[:] = self._nominals

    def repeated(self, count: int) -> ModelBatch:
        """Return a batch in which the physics of each environment stands ``count`` times in a row.

        Both know the same entries, and the same of them are overridden, from then on separately.
        """
        other = ModelBatch(self.model, self.num_envs * count, threads=self.threads)
        other._columns, other._bounding = dict(self._columns), list(self._bounding)
        other._nominals = list(self._nominals)
        other.table = np.repeat(self.table, count, axis=0)
        return other

    def overrides(self, other: ModelBatch) -> bool:
        """Return whether all entries that ``other`` overrides are overridden here."""
        return other._columns.keys() <= self._columns.keys()

    def same_columns(self, other: ModelBatch) -> bool:
        """Return whether the tables override the same entries in the same order."""
        return list(self._columns) == list(other._columns)

    def addresses(self, model: mujoco.MjModel) -> NDArray[np.int64]:
        """Return where the columns of the table belong in a copy of the model, shape ``(K,)``.

        The copy is told not to take short cuts that hold for the nominal values only.
        """
        unskip(model, self._columns)
        for field, indices in self._columns:
            if indices:
                separate(model, field, indices[0])
        return np.array([address(model, *key) for key in self._columns], dtype=np.int64)

    def copy_of(self, row: int) -> mujoco.MjModel:
        """Return a model with the physics of environment ``row``, for use outside the batch."""
        model = copy.copy(self.model)
        native.override(self.addresses(model), self.table, row)
        return model

    def _add(self, field: str, indices: tuple[int, ...]) -> int:
        value = self._nominal(field, indices)
        if field in BOUNDS or field.endswith("quat"):
            self._bounding.append((field, indices))
        column = np.full((self.num_envs, 1), value)
        self.table = np.concatenate([self.table, column], axis=1)
        self._columns[field, indices] = len(self._columns)
        self._nominals.append(value)
        return self._columns[field, indices]

    def _nominal(self, field: str, indices: tuple[int, ...]) -> float:
        try:
            value = np.asarray(attribute(self.model, field))
        except AttributeError:
            names = [
                name
                for name in dir(self.model)
                if isinstance(getattr(self.model, name, None), np.ndarray)
            ]
            raise PhysicsError(message("a field of MjModel", field, available=names)) from None
        inside = len(indices) == value.ndim and all(
            0 <= i < n for i, n in zip(indices, value.shape, strict=False)
        )
        if not inside or value.dtype != np.float64 or (not indices and field not in SCALARS):
            expected = f"the index of a floating-point number in {field} of shape {value.shape}"
            raise PhysicsError(message(expected, indices))
        return float(value[indices])
