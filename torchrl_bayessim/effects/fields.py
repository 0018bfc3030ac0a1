"""Entries of the model that effects write, in every member of a batch at once.

Physics write absolute values first, effects add to them, and what follows from masses, places and
gears is recomputed once at the end. An entry that keeps its value is not written.
"""

from __future__ import annotations

__all__ = ["ModelFields", "Models"]

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..physics.consequences import DERIVED_FROM

Entry = tuple[str, tuple[int, ...]]


class Models(Protocol):
    """The models of ``P`` simulations, such as a `ModelBatch`."""

    def read(self, field: str, indices: tuple[int, ...]) -> NDArray[np.float64]:
        """Return an entry, shape ``(P,)``."""
        ...

    def write(
        self,
        field: str,
        indices: tuple[int, ...],
        values: NDArray[np.float64],
        rows: NDArray[np.bool_],
    ) -> None:
        """Set an entry in ``rows``."""
        ...

    def refresh(self, rows: NDArray[np.bool_]) -> None:
        """Recompute what is derived from others in ``rows``."""
        ...


class ModelFields:
    """What a `ModelEffect` writes to; `finish` comes after the last.

    Example:
        >>> from torchrl_bayessim.effects.catalogue import effect
        >>> from torchrl_bayessim.effects.robot import robot_of
        >>> from torchrl_bayessim.envs.model_batch import ModelBatch
        >>> from torchrl_bayessim.envs.tasks.catalogue import known_task
        >>> task = known_task("InvertedPendulum-v5")
        >>> models = ModelBatch(task.model, 2)
        >>> fields = ModelFields(models)
        >>> friction = torch.tensor([[0.0, 0.0], [0.0, 0.1]])
        >>> effect("coulomb_friction").write(fields, friction, robot_of(task))
        >>> fields.finish()
        >>> models.read("dof_frictionloss", (1,))
        array([0. , 0.1])

    Args:
        models: The models.
        rows: Which of them to write, boolean, shape ``(P,)``; default all.

    Attributes:
        before: The entries that were written, and what they were before, shape ``(P,)`` each.
    """

    def __init__(self, models: Models, rows: NDArray[np.bool_] | None = None) -> None:
        self._models, self._rows = models, rows
        self._stale: NDArray[np.bool_] | None = None
        self.before: dict[Entry, NDArray[np.float64]] = {}

    def __getitem__(self, entry: Entry) -> Tensor:
        """Return an entry, shape ``(P,)``."""
        return torch.from_numpy(self._models.read(*entry))

    def __setitem__(self, entry: Entry, value: Tensor) -> None:
        """Set an entry; a body's inertia follows its mass."""
        old = self._models.read(*entry)
        new = np.broadcast_to(value.double().numpy(), old.shape)
        changed = new != old
        rows = changed if self._rows is None else changed & self._rows
        if not rows.any():
            return
        self.before.setdefault(entry, old)
        self._models.write(*entry, np.where(rows, new, old), self._everyone(old))
        if entry[0] in DERIVED_FROM:
            self._stale = rows if self._stale is None else self._stale | rows
        if entry[0] == "body_mass":
            for axis in range(3):
                inertia = "body_inertia", (*entry[1], axis)
                self[inertia] = self[inertia] * torch.from_numpy(np.where(rows, new / old, 1.0))

    def restore(self) -> None:
        """Give the entries in ``rows`` back what they were before."""
        for entry, old in self.before.items():
            now = self._models.read(*entry)
            rows = np.ones(len(old), dtype=bool) if self._rows is None else self._rows
            self._models.write(*entry, np.where(rows, old, now), self._everyone(old))

    def finish(self) -> None:
        """Recompute what MuJoCo derives from the entries that were written."""
        if self._stale is not None:
            self._models.refresh(self._stale)

    @staticmethod
    def _everyone(values: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.ones(len(values), dtype=bool)
