"""Models of numbers alone, with as much left in every segment, to be compared and chosen from."""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from torchrl_bayessim.diagnosis.model import Model
from torchrl_bayessim.diagnosis.objective import Point
from torchrl_bayessim.diagnosis.refit import Fit


class Unit(NamedTuple):
    """An effect at one joint, whose number is that of its place."""

    name: str
    where: str = "hip"
    high: float = 1.0
    direction: tuple[float, ...] = (1.0,)
    group: str = ""  # default its name
    channel: str = "body"
    low: float = -1.0

    def inside(self, strength):
        return min(strength, self.high)

    @property
    def targets(self):
        return [i for i, part in enumerate(self.direction) if part]

    @property
    def effect(self):
        joint = ["hip", "knee", "x", "y"].index(self.where)
        return SimpleNamespace(
            group=self.group or self.name,
            placed=(),
            form={},
            channel=self.channel,
            joint=lambda robot, target: joint,
        )


A, B, C = Unit("gain", "knee"), Unit("gain", "hip"), Unit("friction", "hip")


def plain(units, deviance, *, z=0.0, segments=40, width=10, flipped=False):
    """Return a model of units, or of strengths; the other side is left if ``flipped``."""
    left = np.full((segments // 2, width), np.sqrt(deviance / (width * segments))) * (-1) ** flipped
    strengths = dict(units) if isinstance(units, dict) else dict.fromkeys(units, 1.0)
    point = Point(np.array([z]), strengths)
    jacobian = np.ones((left.size, 1 + len(units)))
    fit = Fit(point, tuple(units), left, jacobian)
    return Model(fit=fit, validation=left, logs=np.arange(segments))
