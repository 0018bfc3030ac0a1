"""How well parameters and effects explain segments: weighted innovations of many points at once.

A *point* is a parameter vector in standardised units (the prior has mean 0 and standard deviation
1), of which the last says how much of the time step's error the data have (0: they are like the
simulator's own, 1: exact), and strengths of some *units*, an effect at one of its targets each. Its
cost is::

    Σ_i w_i ‖L_i⁻¹ r_i(θ, s)‖² + ‖z(θ)‖²,

with the prior as regulariser: a posterior that was fitted to the same data without the effect has
already absorbed it.
"""

from __future__ import annotations

__all__ = [
    "Objective",
    "Point",
    "Unit",
    "at_targets",
    "origin",
    "parameters_at",
    "pushes_of",
    "strengths_of",
    "units_of",
]

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..effects.disturbance import ConstantForce
from ..effects.effect import Effect
from ..effects.robot import Robot
from ..effects.units import unit_at
from ..inference.priors import Prior
from .prediction import Predictor
from .segments import Segments
from .strengths import Strengths
from .whitening import Whitening, drawn_starts, start_noise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Unit:
    """One effect at one of its targets, or at all of them in a fixed proportion.

    Attributes:
        effect: The effect.
        where: The target's name, or ``all``.
        direction: Strength of each target per strength of the unit, shape ``(N,)``.
        low: Lowest plausible strength, zero or negative.
        high: Highest plausible strength.
        onset: Largest strength that does nothing in these data. Searches and fits count from there:
            see `actual`.
    """

    effect: Effect
    where: str
    direction: tuple[float, ...]
    low: float
    high: float
    onset: float = 0.0

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.effect.name

    @property
    def place(self) -> tuple[str, str, tuple[float, ...]]:
        """What two units share that are one effect, in any form, at the same target."""
        return self.name, self.where, self.direction

    @property
    def targets(self) -> list[int]:
        """The numbers of the targets at which it acts."""
        return [target for target, part in enumerate(self.direction) if part]

    def inside(self, strength: float) -> float:
        """Return the strength within what a fit may try: twice the plausible range.

        Fractions stay in it, since less than nothing of a friction is none that a simulator knows.
        """
        reach = 1.0 if self.effect.unit == "fraction" else 2.0 ** (1 / self.effect.search_power)
        return float(np.clip(strength, reach * self.low, reach * self.high))

    def actual(self, strength: float) -> float:
        """Return the effect's own strength: ``onset + strength (1 - onset / high)``, 0 for 0.

        With ``high |strength / high|^power`` in the place of ``strength`` (`Effect.search_power`).
        """
        share = abs(strength / self.high) ** self.effect.search_power
        bent = float(np.copysign(share * self.high, strength))
        return self.onset + bent * (1 - self.onset / self.high) if strength else 0.0

    def slope(self, strength: float) -> float:
        """Return the derivative of `actual`."""
        power = self.effect.search_power
        steep = power * abs(strength / self.high) ** (power - 1)
        return steep * (1 - self.onset / self.high)

    def joint(self, robot: Robot) -> int:
        """Return the joint at which it acts, -1 where there is none or there are several."""
        targets = self.targets
        return self.effect.joint(robot, targets[0]) if len(targets) == 1 else -1

    def measured_in(self, robot: Robot) -> str:
        """Return the unit of its strength; at all together, where it is largest."""
        return unit_at(self.effect, robot, int(np.argmax(np.abs(self.direction))))

    def __str__(self) -> str:
        return f"{self.effect.name}[{self.where}]"


def units_of(effects: Sequence[Effect], robot: Robot) -> list[Unit]:
    """Return every effect at every target that it has on this robot, and at all together.

    At all together strengths are in proportion to their bounds.
    """
    units = []
    for effect in (one.on(robot) for one in effects):
        names = effect.targets(robot)
        if not names:
            continue
        low, high = (b.tolist() for b in effect.bounds(robot))
        for i, name in enumerate(names):
            if high[i] > 0:
                one = tuple(float(i == j) for j in range(len(names)))
                units.append(Unit(effect, name, one, low[i], high[i]))
        if len(names) > 1 and max(high) > 0:
            largest = max(range(len(names)), key=lambda i: high[i])
            every = tuple(h / high[largest] for h in high)
            units.append(Unit(effect, "all", every, low[largest], high[largest]))
    return units


def pushes_of(robot: Robot) -> list[Unit]:
    """Return a constant force at each joint."""
    return [unit for unit in units_of([ConstantForce()], robot) if unit.where != "all"]


@dataclass(frozen=True, eq=False)
class Point:
    """A candidate explanation.

    Attributes:
        z: Standardised parameters and the time step's share, shape ``(D + 1,)``.
        strengths: Strengths of the units that are on.
    """

    z: Array
    strengths: Mapping[Unit, float] = field(default_factory=dict)

    def beside(self, others: Mapping[Unit, float]) -> Point:
        """Return the point with other strengths beside its own, or in the place of those."""
        return Point(self.z, {**self.strengths, **others})

    def more(self, unit: Unit, strength: float) -> Point:
        """Return the point with so much more of a unit than it has."""
        return self.beside({unit: self.strengths.get(unit, 0.0) + strength})


class Objective:
    """Evaluates points on segments.

    Args:
        predictor: Simulates.
        prior: Over the parameters; none if there are none.
        segments: What to explain.
        whitening: Turns residuals into innovations.

    Attributes:
        located: Whether each residual belongs to a row of its segment.
        width: Step of derivatives, of a prior standard deviation and of an effect's range.
    """

    located = True
    width = 0.01

    def __init__(
        self, predictor: Predictor, prior: Prior | None, segments: Segments, whitening: Whitening
    ) -> None:
        self.predictor, self.prior = predictor, prior
        self.segments, self.whitening = segments, whitening

    @property
    def size(self) -> int:
        """The number of coordinates ``D + 1``."""
        return 1 + (0 if self.prior is None else len(self.prior.names))

    def take(self, index: NDArray[np.int64]) -> Objective:
        """Return the objective on some segments."""
        return self._but(segments=self.segments.take(index), whitening=self.whitening.take(index))

    def along(self, segments: Segments) -> Objective:
        """Return the same on other segments, as many, with the same covariance."""
        return self._but(segments=segments)

    def on(self, predictor: Predictor) -> Objective:
        """Return the same with another simulator."""
        return self._but(predictor=predictor)

    def differing(self, width: float) -> Objective:
        """Return the same with another step of derivatives."""
        return self._but(width=width)

    def weighted(self, point: Point) -> Objective:
        """Return the same with the robust weights that the segments deserve at a point."""
        return self.whitened(self.whitening.weighted(self([point])[0]))

    def whitened(self, whitening: Whitening) -> Objective:
        """Return the same with another covariance, or other weights."""
        return self._but(whitening=whitening)

    def _but(self, **changes: Any) -> Objective:
        other = copy.copy(self)
        other.__dict__.update(changes)
        return other

    def theta(self, z: Array) -> Array:
        """Return parameters in their own units, shape ``(*, D)``."""
        return parameters_at(self.prior, z)

    def raw(self, points: Sequence[Point], offsets: Array | None = None) -> Array:
        """Return residuals, shape ``(P, S, K, C)``; of sensors with ``offsets`` if given."""
        theta = self.theta(np.stack([point.z for point in points]))
        strengths = strengths_of(points, self.predictor.system.robot)
        return self.predictor.residuals(self.segments, theta, strengths, offsets)

    def __call__(self, points: Sequence[Point], offsets: Array | None = None) -> Array:
        """Return weighted innovations, shape ``(P, S, KC)``."""
        return self.innovations(points, self.raw(points, offsets))

    def innovations(self, points: Sequence[Point], raw: Array) -> Array:
        """Return weighted innovations of residuals ``(P, S, K, C)``, shape ``(P, S, KC)``."""
        share = np.array([point.z[-1] for point in points])
        drift = self.whitening.drift * self.whitening.weights[:, None]
        return self.whitening(raw) - share[:, None, None] * drift

    def made_by_noise(
        self, point: Point, noise: Array, *, draws: int, generator: np.random.Generator
    ) -> Array:
        """Return residuals that noise alone would leave at a point, ``(draws, S, K, C)``.

        Args:
            point: The simulator.
            noise: Standard deviation of each channel's noise, shape ``(C,)``.
            draws: So many times.
            generator: Of the noise, of starts and sensors.
        """
        root = start_noise(self.predictor, self.segments, noise)
        moved = self.raw([point] * draws, drawn_starts(root, draws, generator))
        moved -= self.raw([point])
        return moved + noise * generator.standard_normal(moved.shape)

    def unweighted(self, points: Sequence[Point], offsets: Array | None = None) -> Array:
        """Return innovations without the robust weights, shape ``(P, S, KC)``."""
        return self(points, offsets) / self.whitening.weights[:, None]


def at_targets(strengths: Mapping[Unit, float], robot: Robot) -> dict[str, float]:
    """Return the strength at each target, of those that act at all at once in proportion."""
    found: dict[str, float] = {}
    for unit, strength in strengths.items():
        for target, part in zip(unit.effect.targets(robot), unit.direction, strict=True):
            if part:
                found[target] = found.get(target, 0.0) + part * strength
    return found


def origin(prior: Prior | None) -> Array:
    """Return where fits start: the prior's mean, and none of the time step's error."""
    return np.zeros(1 + (0 if prior is None else len(prior.names)))


def parameters_at(prior: Prior | None, z: Array) -> Array:
    """Return the parameters of points ``(*, D + 1)`` in their own units, shape ``(*, D)``."""
    if prior is None:
        return np.zeros((*z.shape[:-1], 0))
    return prior.unstandardize(torch.from_numpy(z[..., :-1])).double().numpy()


def strengths_of(points: Sequence[Point], robot: Robot) -> Strengths:
    """Return the strengths of points, by effect."""
    result: dict[Effect, Array] = {}
    for p, point in enumerate(points):
        for unit, strength in point.strengths.items():
            if unit.effect not in result:
                count = len(unit.effect.targets(robot))
                result[unit.effect] = np.zeros((len(points), count))
            result[unit.effect][p] += unit.actual(strength) * np.array(unit.direction)
    return result
