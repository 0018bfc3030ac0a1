"""Causes that no catalogue entry describes: nothing may be named for them without reserve."""

from __future__ import annotations

__all__ = ["FOREIGN"]

import math

from .causes_chance import torque_noise
from .laws import Commands, Forces, Made, Site
from .plant import Plant


def tight_spot(site: Site) -> Made:
    """Dry friction near one angle."""
    s, at = site.draw(0.1, 0.4) * site.torque, site.rng.uniform(-0.6, 0.6)

    def law(q: float, v: float, *_: object) -> float:
        return -s * math.tanh(v / 0.02) * math.exp(-(((q - at) / 0.15) ** 2))

    return Forces(site, law), site.truth("tight_spot", "body")


def soft_stop(site: Site) -> Made:
    """A cushion that pushes back beyond one angle."""
    side, at, s = site.sign(), site.rng.uniform(0.1, 0.5), site.draw(0.5, 3.0) * site.torque

    def law(q: float, v: float, *_: object) -> float:
        over = side * q - at
        return -side * s * over * (1.0 + 0.3 * max(side * v, 0.0)) if over > 0 else 0.0

    return Forces(site, law), site.truth("soft_stop", "body")


def cable(site: Site) -> Made:
    """A cable with slack: pulls back on both sides, with hysteresis."""
    slack, s = site.rng.uniform(0.2, 0.5), site.draw(0.3, 1.5) * site.torque

    def law(q: float, v: float, *_: object) -> float:
        over = math.copysign(max(abs(q) - slack, 0.0), q)
        return -s * over * (1.3 if q * v > 0 else 0.7)

    return Forces(site, law), site.truth("cable", "body")


def detent(site: Site) -> Made:
    """A magnet that holds the joint at one place."""
    s, at = site.draw(0.1, 0.5) * site.torque, site.rng.uniform(-0.5, 0.5)

    def law(q: float, *_: object) -> float:
        x = (q - at) / 0.12
        return -s * x * math.exp(0.5 - 0.5 * x * x)

    return Forces(site, law), site.truth("detent", "body")


def thermal(site: Site) -> Made:
    """A motor that weakens with the heat of its own currents, and cools."""
    s = site.draw(0.2, 0.7)

    def law(u: float, plant: Plant, memory: dict) -> float:
        heat = memory.get("heat", 0.0)
        memory["heat"] = heat + plant.dt * ((u / site.limit) ** 2 * 4.0 - heat / 2.0)
        return u * (1 - s * heat / (1 + heat))

    return Commands(site, law), site.truth("thermal", "actuation")


def event(site: Site) -> Made:
    """Something comes loose or jams in mid-run: dry friction that begins at a time."""
    s, begins = site.draw(0.06, 0.3) * site.torque, site.rng.uniform(0.5, 2.5)

    def law(_q: float, v: float, plant: Plant, _m: dict) -> float:
        return -s * math.tanh(v / 0.02) if plant.time > begins else 0.0

    return Forces(site, law), site.truth("event", "body")


FOREIGN = {
    "tight_spot": tight_spot, "soft_stop": soft_stop, "cable": cable, "detent": detent,
    "thermal": thermal, "event": event, "torque_noise": torque_noise,
}  # fmt: skip
