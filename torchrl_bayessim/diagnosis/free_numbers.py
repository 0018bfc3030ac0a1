"""What laws have beside their strengths that can be moved, and what each such number costs."""

from __future__ import annotations

__all__ = ["Shift", "bendable", "fitted_numbers", "priced", "shifts_of", "value_of"]

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from ..effects.effect import Reach
from ..effects.units import slides
from .model import Model, criterion, numbers, price
from .objective import Objective, Unit


@dataclass(frozen=True)
class Shift:
    """One number of one unit that can be moved: how far to see what that does, and at most."""

    unit: Unit
    number: str
    width: float
    least: float
    most: float

    @property
    def placed(self) -> bool:
        """Whether it was read off the data before the effect was offered, and is priced with it."""
        return self.number in self.unit.effect.placed

    def paid(self, offered: Collection[Unit]) -> bool:
        """Return whether it is fitted anyway, or has been: of a wave, or none that was offered."""
        if self.placed or self.number in self.unit.effect.nuisances:
            return True
        return value_of(self) not in self.offered(offered)

    def offered(self, units: Collection[Unit]) -> set[float]:
        """Return the values that it was offered with, of the same law."""
        alike = (u.effect for u in units if type(u.effect) is type(self.unit.effect))
        return {float(effect.form[self.number]) for effect in alike}


def shifts_of(train: Objective, units: Iterable[Unit]) -> list[Shift]:
    """Return what can be moved."""
    return [
        Shift(unit, number, *bounds)
        for unit in units
        for number, bounds in unit.effect.free(_reach(train, unit)).items()
    ]


def _reach(train: Objective, unit: Unit) -> Reach:
    """Return how far the robot went where a unit acts, at any of the joints if at several."""
    robot, segments = train.predictor.system.robot, train.segments
    joint = unit.joint(robot)
    joints = [joint] if joint >= 0 else list(range(len(robot.joints)))
    places = [robot.qpos_index[j] for j in joints], [robot.dof_index[j] for j in joints]
    position, velocity = (
        float(np.abs(states[..., list(columns)]).max(initial=0.0))
        for states, columns in zip((segments.qpos, segments.qvel), places, strict=True)
    )
    time = float(np.abs(segments.time).max())
    return Reach(position, velocity, time, all(slides(robot, j) for j in joints))


def value_of(shift: Shift) -> float:
    """Return the number as it is."""
    return float(shift.unit.effect.form[shift.number])


def bendable(train: Objective, units: Iterable[Unit]) -> bool:
    """Return whether the law of any of the units has a number that bends it."""
    return any(
        set(unit.effect.free(_reach(train, unit))) - set(unit.effect.placed) for unit in units
    )


def priced(model: Model, offered: Collection[Unit], *, dispersion: float = 1.0) -> float:
    """Return the criterion, and a price for each number of a law that was fitted."""
    return criterion(model, dispersion) + sum(_bent(u, offered) for u in model.units) * price(model)


def fitted_numbers(model: Model, offered: Collection[Unit]) -> int:
    """Return how many numbers its effects have that were fitted: strengths, and those of laws."""
    return numbers(model) + sum(_bent(unit, offered) for unit in model.units)


def _bent(unit: Unit, offered: Collection[Unit]) -> int:
    """Return how many numbers of a law are none that it was offered with, but for placed ones."""
    if not any(u.name == unit.name for u in offered):
        return 0
    alike = [u.effect.form for u in offered if type(u.effect) is type(unit.effect)]
    return sum(
        number in unit.effect.nuisances or value not in [form[number] for form in alike]
        for number, value in unit.effect.form.items()
        if number not in unit.effect.placed
    )
