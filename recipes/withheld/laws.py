"""What the causes are made of: where one acts, and how a law becomes a cause."""

from __future__ import annotations

__all__ = ["Commands", "Forces", "Made", "Sensors", "Site", "Writes"]

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from .plant import Cause, Plant, Truth

Array = NDArray[np.float64]
Made = tuple[Cause, Truth]
Memory = dict[str, Any]


@dataclass(frozen=True)
class Site:
    """Where a cause is put, and the draws that make it.

    Attributes:
        model: The model in its true physics, before the cause.
        actuator: Index of the actuator that a cause may act on.
        dof: Index of the degree of freedom that a cause may act on.
        joint: That joint's name.
        limit: Range of the actuator's command.
        torque: What counts as a large generalised force there, N m or N.
        control_dt: Seconds between commands.
        form: ``same`` as the catalogue's, or ``other``.
        rng: Of the cause's strength.
    """

    model: mujoco.MjModel
    actuator: int
    dof: int
    joint: str
    limit: float
    torque: float
    control_dt: float
    form: str
    rng: np.random.Generator

    @property
    def same(self) -> bool:
        """Whether the catalogue's functional form is asked for."""
        return self.form == "same"

    def draw(self, low: float, high: float) -> float:
        """Return a strength, log-uniform."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def sign(self) -> float:
        """Return 1 or -1."""
        return float(self.rng.choice([-1.0, 1.0]))

    def truth(self, name: str, channel: str, *, joint: str = "", **strength: float) -> Truth:
        """Return the label; ``_`` in a unit stands for a space."""
        units = {unit.replace("_", " "): value for unit, value in strength.items()}
        return Truth(name, self.form, joint or self.joint, channel, units if self.same else {})


class Commands(Cause):
    """A law ``(u, plant, memory) -> u`` for the command of one actuator."""

    def __init__(self, site: Site, law: Callable[[float, Plant, Memory], float]) -> None:
        super().__init__()
        self.site, self.law = site, law

    def command(self, u: Array, plant: Plant) -> Array:
        """Return the commands with one changed."""
        u = u.copy()
        u[self.site.actuator] = self.law(u[self.site.actuator], plant, self.memory)
        return u


class Forces(Cause):
    """A law ``(q, v, plant, memory) -> force`` at one degree of freedom."""

    def __init__(self, site: Site, law: Callable[[float, float, Plant, Memory], float]) -> None:
        super().__init__()
        self.site, self.law = site, law

    def force(self, plant: Plant) -> Array:
        """Return forces at one degree of freedom."""
        dof, forces = self.site.dof, np.zeros(plant.model.nv)
        forces[dof] = self.law(plant.q[dof], plant.v[dof], plant, self.memory)
        return forces


class Sensors(Cause):
    """A law ``(y, plant, memory) -> y`` for all that is measured."""

    def __init__(self, law: Callable[[Array, Plant, Memory], Array]) -> None:
        super().__init__()
        self.law = law

    def sense(self, y: Array, plant: Plant) -> Array:
        """Return what is measured."""
        return self.law(y, plant, self.memory)


class Writes(Cause):
    """A change of the model."""

    def __init__(self, law: Callable[[mujoco.MjModel], None]) -> None:
        super().__init__()
        self.law = law

    def write(self, model: mujoco.MjModel) -> None:
        """Alter the model."""
        self.law(model)
