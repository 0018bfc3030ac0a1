"""Causes of chance, each in the usual form, with draws that know nothing of each other, and not."""

from __future__ import annotations

__all__ = ["CHANCE", "torque_noise"]

from collections.abc import Callable

import numpy as np

from .laws import Commands, Forces, Made, Memory, Sensors, Site
from .plant import Plant

Array = np.ndarray
_STAYS = 0.5  # probability that what is lost is followed by another that is lost


def _lost(site: Site, share: float) -> Callable[[Plant, Memory], bool]:
    """Return what says whether this control step's value is lost.

    With probability ``share``; or in bursts that cover as much (Gilbert 1960): after one that came
    the next is lost with probability ``(1 - b) s / (1 - s)``, after a lost one with ``b``.
    """
    begins = (1 - _STAYS) * share / (1 - share)

    def lost(plant: Plant, memory: Memory) -> bool:
        k = len(plant.states)
        if memory.get("step") != k:
            chance = share if site.same else _STAYS if memory.get("lost") else begins
            memory["step"], memory["lost"] = k, bool(plant.rng.random() < chance)
        return memory["lost"]

    return lost


def packet_drop(site: Site) -> Made:
    """Commands are lost and the last one stays; each by itself, or in bursts."""
    s = site.draw(0.02, 0.4)
    lost = _lost(site, s)

    def law(u: float, plant: Plant, memory: Memory) -> float:
        if not lost(plant, memory) or "last" not in memory:
            memory["last"] = u
        return memory["last"]

    return Commands(site, law), site.truth("packet_drop", "actuation", probability=s)


def action_jitter(site: Site) -> Made:
    """Commands act late by another time each; uniform up to ``s``, or ``s`` or not at all."""
    s = site.draw(0.2, 2.0) * site.control_dt

    def law(u: float, plant: Plant, memory: Memory) -> float:
        sent = plant.commands
        if memory.get("step") != len(sent):
            chance = plant.rng.random()
            late = s * (chance if site.same else float(chance < 0.5)) / plant.control_dt
            n, f = int(late), late - int(late)
            now, past = sent[-1], [sent[max(len(sent) - 1 - i, 0)] for i in (n, n + 1)]
            change = (1 - f) * past[0] + f * past[1] - now
            memory["step"], memory["change"] = len(sent), change[site.actuator]
        return u + memory["change"]

    return Commands(site, law), site.truth("action_jitter", "actuation", s=s)


def sensor_dropout(site: Site) -> Made:
    """An angle is not renewed and the last one stays; each by itself, or in bursts."""
    s = site.draw(0.02, 0.3)
    lost = _lost(site, s)

    def law(y: Array, plant: Plant, memory: Memory) -> Array:
        y = y.copy()
        if lost(plant, memory) and "last" in memory:
            y[site.dof] = memory["last"]
        memory["last"] = y[site.dof]
        return y

    return Sensors(law), site.truth("sensor_dropout", "sensing", probability=s)


def torque_noise(site: Site) -> Made:
    """A force that is drawn anew in every control step, as no entry of a catalogue has it."""
    s = site.draw(0.02, 0.2) * site.torque

    def law(_q: float, _v: float, plant: Plant, memory: Memory) -> float:
        if memory.get("step") != len(plant.commands):
            memory["step"], memory["force"] = len(plant.commands), s * plant.rng.standard_normal()
        return memory["force"]

    return Forces(site, law), site.truth("torque_noise", "body")


CHANCE = {
    "packet_drop": packet_drop, "action_jitter": action_jitter, "sensor_dropout": sensor_dropout,
}  # fmt: skip
