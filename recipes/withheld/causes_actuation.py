"""Causes between the command and the joint, each in the usual form and in another."""

from __future__ import annotations

__all__ = ["ACTUATION"]

import math

import mujoco
import numpy as np

from .laws import Commands, Made, Site
from .plant import Cause, Plant


class _Delay(Cause):
    """Every command arrives later; jitter draws each one's delay anew."""

    def __init__(self, seconds: float, *, mixed: bool, jitter: float = 0.0) -> None:
        super().__init__()
        self.seconds, self.mixed, self.jitter = seconds, mixed, jitter

    def command(self, u: np.ndarray, plant: Plant) -> np.ndarray:  # noqa: ARG002
        """Return an earlier command."""
        sent, steps = plant.commands, self.seconds / plant.control_dt
        if self.mixed:  # a mean of two commands, which do not change within a control step
            n, f = int(steps), steps - int(steps)
            k = len(sent) - 1
            return (1 - f) * sent[max(k - n, 0)] + f * sent[max(k - n - 1, 0)]
        arrivals = self.memory.setdefault("arrivals", [])
        while len(arrivals) < len(sent):
            late = self.seconds + self.jitter * plant.rng.uniform(-1.0, 1.0)
            arrivals.append(len(arrivals) * plant.control_dt + late)
        there = [k for k, at in enumerate(arrivals) if at <= plant.time + 1e-9]
        return sent[max(there, default=0)]


def delay(site: Site) -> Made:
    """A time, as a mean of two commands; or continuous and jittered."""
    s = site.draw(0.0625, 3.0) * site.control_dt
    cause = _Delay(s, mixed=site.same, jitter=0.3 * min(s, site.control_dt))
    steps = s / site.control_dt
    return cause, site.truth("action_delay", "actuation", joint="all", s=s, steps=steps)


def lag(site: Site) -> Made:
    """A first-order filter; or two in a row."""
    s = site.draw(0.00375, 0.12)

    def law(u: float, plant: Plant, memory: dict) -> float:
        stages = memory.setdefault("a", [u] if site.same else [u, u])
        gain = 1 - math.exp(-plant.dt * len(stages) / s)
        for i in range(len(stages)):
            stages[i] += gain * (u - stages[i])
            u = stages[i]
        return u

    return Commands(site, law), site.truth("action_lag", "actuation", s=s)


def dead_band(site: Site) -> Made:
    """Small commands are lost; sharply, or smoothly."""
    s = site.draw(0.0075, 0.25) * site.limit

    def law(u: float, *_: object) -> float:
        if site.same:
            return math.copysign(max(abs(u) - s, 0.0), u)
        return u - s * math.tanh(u / s)

    return Commands(site, law), site.truth("dead_band", "actuation", command=s)


def saturation(site: Site) -> Made:
    """Large commands are cut; sharply, or by a hyperbolic tangent."""
    top = site.limit * (1 - site.draw(0.5, 0.85))

    def law(u: float, *_: object) -> float:
        return float(np.clip(u, -top, top)) if site.same else top * math.tanh(u / top)

    share = 1 - top / site.limit
    return Commands(site, law), site.truth("saturation", "actuation", fraction=share)


def gain(site: Site) -> Made:
    """A factor; or one that falls with the command."""
    s = site.sign() * site.draw(0.0125, 0.4)

    def law(u: float, *_: object) -> float:
        fall = 1.0 if site.same else 1.2 - 0.4 * abs(u) / site.limit
        return (1 + s * fall) * u

    return Commands(site, law), site.truth("action_gain", "actuation", fraction=s)


def bias(site: Site) -> Made:
    """A constant; or one that wanders by a fifth."""
    s = site.sign() * site.draw(0.0075, 0.2) * site.limit

    def law(u: float, plant: Plant, _: dict) -> float:
        wander = 0.0 if site.same else 0.2 * math.sin(2.0 * plant.time)
        return u + s * (1 + wander)

    return Commands(site, law), site.truth("action_bias", "actuation", command=s)


def torque_speed(site: Site) -> Made:
    """The limit of a motor's torque falls with its speed; linearly, or with its square."""
    top = site.draw(3.0, 9.0) * (1.0 if site.torque < 100 else 2.0)

    def law(u: float, plant: Plant, _: dict) -> float:
        v = plant.v[site.dof]
        share = abs(v) / top
        limit = site.limit * max(1 - (share if site.same else share**2), 0.05)
        return float(np.clip(u, -limit, limit)) if u * v > 0 else u

    return Commands(site, law), site.truth("torque_speed_limit", "actuation")


def sag(site: Site) -> Made:
    """The gain falls with time; linearly, or exponentially."""
    s, seconds = site.draw(0.025, 0.6), 4.0

    def law(u: float, plant: Plant, _: dict) -> float:
        share = plant.time / seconds
        return u * (1 - s * (min(share, 1.5) if site.same else 1 - math.exp(-1.6 * share)))

    return Commands(site, law), site.truth("battery_sag", "actuation", joint="all")


class _Rotor(Cause):
    """A rotor drives the joint through a spring, with play; the rotor's inertia is the armature.

    ``I w' = u - f``,  ``f = k d(phi - q) + c (w - v)``,  where ``d`` cuts out the play.
    """

    def __init__(self, site: Site, *, hertz: float, play: float) -> None:
        super().__init__()
        self.site, self.play = site, play
        self.inertia = max(float(site.model.dof_armature[site.dof]), 1e-3)
        self.stiffness = self.inertia * (2 * math.pi * hertz) ** 2
        self.damping = 0.2 * 2 * math.sqrt(self.stiffness * self.inertia)
        self.gear = float(site.model.actuator_gear[site.actuator, 0])

    def write(self, model: mujoco.MjModel) -> None:
        """Take the rotor out of the joint."""
        model.dof_armature[self.site.dof] = 0.0

    def command(self, u: np.ndarray, plant: Plant) -> np.ndarray:  # noqa: ARG002
        """Return nothing for the joint: the torque goes to the rotor."""
        self.memory["torque"] = self.gear * u[self.site.actuator]
        u = u.copy()
        u[self.site.actuator] = 0.0
        return u

    def force(self, plant: Plant) -> np.ndarray:
        """Return the spring's mean torque, and move the rotor on."""
        dof, memory = self.site.dof, self.memory
        q, v = plant.q[dof], plant.v[dof]
        phi, w = memory.get("rotor", (q, v))
        total, parts = 0.0, 8
        for _ in range(parts):
            stretch = phi - q
            over = math.copysign(max(abs(stretch) - self.play / 2, 0.0), stretch)
            force = self.stiffness * over + (self.damping * (w - v) if over else 0.0)
            w += (memory["torque"] - force) / self.inertia * plant.dt / parts
            phi += w * plant.dt / parts
            q += v * plant.dt / parts
            total += force / parts
        memory["rotor"] = phi, w
        forces = np.zeros(plant.model.nv)
        forces[dof] = total
        return forces


def backlash(site: Site) -> Made:
    """A gap between motor and joint, always of two masses: another form than the catalogue's."""
    s = site.draw(0.0025, 0.1)
    return _Rotor(site, hertz=40.0, play=s), site.truth("backlash", "actuation")


def series_elasticity(site: Site) -> Made:
    """A spring between motor and joint, always of two masses."""
    hertz = site.draw(8.0, 30.0)
    return _Rotor(site, hertz=hertz, play=0.0), site.truth("series_elasticity", "actuation")


ACTUATION = {
    "action_delay": delay, "action_lag": lag, "dead_band": dead_band, "saturation": saturation,
    "action_gain": gain, "action_bias": bias, "torque_speed_limit": torque_speed,
    "battery_sag": sag, "backlash": backlash, "series_elasticity": series_elasticity,
}  # fmt: skip
