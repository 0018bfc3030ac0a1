"""Which numbers of a MuJoCo model follow from which parameter, worked out once per model."""

from __future__ import annotations

__all__ = ["Assignments", "assignments"]

from collections.abc import Set
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import PhysicsError, message
from .consequences import check_settable, lowest
from .idle import Place
from .model_fields import Entries


@dataclass(frozen=True, eq=False)
class Assignments:
    """Numbers of a model in the order in which they are set, P of them.

    Number ``p`` becomes ``base[p] · (θ[parameter[p]] / scale[p])``, or ``nominal[p]`` where θ is
    NaN; the quotient first, so that a nominal mass gives the nominal inertia to the last bit.

    Attributes:
        places: Field and indices of each number.
        parameter: The column of θ that it follows from, shape ``(P,)``.
        numbers: ``base``, ``scale``, ``nominal`` and the least value allowed, shape ``(P, 4)``.
        groups: The numbers that are each parameter's own, by position; others follow from them.
        fields: The fields that they are in.
    """

    places: tuple[tuple[str, tuple[int, ...]], ...]
    parameter: NDArray[np.int64]
    numbers: NDArray[np.float64]
    groups: tuple[tuple[int, ...], ...]
    fields: frozenset[str]


class _Models(Protocol):
    model: mujoco.MjModel

    @property
    def places(self) -> Set[Place]: ...

    def nominal(self, field: str, indices: tuple[int, ...]) -> float: ...


def assignments(models: _Models, groups: list[list[Entries]]) -> Assignments:
    """Return what to set in a model for parameters that each set a group of entries.

    Raises:
        PhysicsError: An entry cannot be set, or has no effect; the mass of a body without a nominal
            one, whose inertia cannot follow it.

    Example:
        >>> from torchrl_bayessim.physics.model_fields import resolve
        >>> from torchrl_bayessim.physics.mujoco_models import MujocoModels
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body name='ball'><freejoint/><geom size='.1'/></body>"
        ...     "</worldbody></mujoco>")
        >>> mass = assignments(MujocoModels(model), [[resolve(model, "body_mass[ball]")]])
        >>> [field for field, _ in mass.places]
        ['body_mass', 'body_inertia', 'body_inertia', 'body_inertia']
        >>> mass.groups
        ((0,),)
    """
    rows: list[tuple[str, tuple[int, ...], int, float, float]] = []
    own: dict[int, list[int]] = {parameter: [] for parameter in range(len(groups))}
    every = [(parameter, entry) for parameter, group in enumerate(groups) for entry in group]
    along = models.places | {(entry.field, at) for _, entry in every for at in entry.indices}
    # Masses first: they scale inertias, which may be parameters themselves.
    for parameter, entry in sorted(every, key=lambda pair: pair[1].field != "body_mass"):
        for indices in entry.indices:
            check_settable(models.model, entry.field, indices, along=along)
            own[parameter].append(len(rows))
            rows.append((entry.field, indices, parameter, entry.sign, 1.0))
            if entry.field == "body_mass":
                rows += _inertia(models, indices[0], parameter, entry.sign)
    return Assignments(
        places=tuple(row[:2] for row in rows),
        parameter=np.array([row[2] for row in rows]),
        numbers=np.array([(*row[3:], models.nominal(*row[:2]), lowest(row[0])) for row in rows]),
        groups=tuple(tuple(positions) for positions in own.values()),
        fields=frozenset(row[0] for row in rows),
    )


def _inertia(
    models: _Models, body: int, parameter: int, sign: float
) -> list[tuple[str, tuple[int, ...], int, float, float]]:
    """Keep a body's shape: its inertia is proportional to its mass."""
    mass = models.nominal("body_mass", (body,))
    if mass == 0:
        raise PhysicsError(message("a body that has a nominal mass, to scale its inertia", body))
    field = "body_inertia"
    return [
        (field, (body, axis), parameter, sign * models.nominal(field, (body, axis)), mass)
        for axis in range(3)
    ]
