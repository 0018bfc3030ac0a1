"""Causes between the state and the log, each in the usual form and in another."""

from __future__ import annotations

__all__ = ["SENSING"]

import math

import numpy as np

from .laws import Made, Sensors, Site
from .plant import Plant

Array = np.ndarray


def delay(site: Site) -> Made:
    """All channels are late by a time; or by one that jitters."""
    s = site.draw(0.075, 3.0) * site.control_dt

    def law(y: Array, plant: Plant, memory: dict) -> Array:
        seen = memory.setdefault("seen", [])
        seen.append(y)
        late = s if site.same else s * plant.rng.uniform(0.7, 1.3)
        at = max(len(seen) - 1 - late / plant.control_dt, 0.0)
        k = int(at)
        return seen[k] + (at - k) * (seen[min(k + 1, len(seen) - 1)] - seen[k])

    steps = s / site.control_dt
    return Sensors(law), site.truth("sensor_delay", "sensing", joint="all", s=s, steps=steps)


def bias(site: Site) -> Made:
    """An encoder's zero is elsewhere; or creeps about there."""
    s = site.sign() * site.draw(0.0025, 0.15)

    def law(y: Array, plant: Plant, _: dict) -> Array:
        y = y.copy()
        y[site.dof] += s * (1.0 if site.same else 1 + 0.2 * math.sin(1.5 * plant.time))
        return y

    return Sensors(law), site.truth("sensor_bias", "sensing", rad=s, m=s)


def gain(site: Site) -> Made:
    """A velocity is read too large or too small; or ever less so at speed."""
    s = site.sign() * site.draw(0.005, 0.15)

    def law(y: Array, _: Plant, __: dict) -> Array:
        y, i = y.copy(), site.dof + len(y) // 2
        y[i] *= 1 + s * (1.0 if site.same else math.exp(-abs(y[i]) / 10.0))
        return y

    return Sensors(law), site.truth("sensor_gain", "sensing", fraction=s)


def lag(site: Site) -> Made:
    """A velocity is filtered once; or twice."""
    s = site.draw(0.0025, 0.08)

    def law(y: Array, plant: Plant, memory: dict) -> Array:
        y, i = y.copy(), site.dof + len(y) // 2
        stages = memory.setdefault("a", [y[i]] if site.same else [y[i], y[i]])
        pole = 1 - math.exp(-plant.control_dt * len(stages) / s)
        for j in range(len(stages)):
            stages[j] += pole * (y[i] - stages[j])
            y[i] = stages[j]
        return y

    return Sensors(law), site.truth("sensor_lag", "sensing", s=s)


def drift(site: Site) -> Made:
    """An angle's zero moves; steadily, or ever more slowly."""
    s = site.sign() * site.draw(0.0025, 0.1)

    def law(y: Array, plant: Plant, _: dict) -> Array:
        y = y.copy()
        t = plant.time
        y[site.dof] += s * (t if site.same else 2.0 * (1 - math.exp(-t / 2.0)))
        return y

    return Sensors(law), site.truth("sensor_drift", "sensing", **{"rad/s": s, "m/s": s})


SENSING = {
    "sensor_delay": delay, "sensor_bias": bias, "sensor_gain": gain, "sensor_lag": lag,
    "sensor_drift": drift,
}  # fmt: skip
