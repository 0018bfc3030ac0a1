"""Causes in joints, bodies and contacts, each in the usual form and in another."""

from __future__ import annotations

__all__ = ["BODY", "CONTACT"]

import math

import mujoco
import numpy as np

from .laws import Forces, Made, Site, Writes
from .plant import Plant

_SOFT = 0.02  # rad/s or m/s: the speed at which dry friction is three quarters of itself


def _bristle(site: Site, kinetic: float, static: float, speed: float) -> Forces:
    """Dry friction after Canudas de Wit, Olsson, Åström & Lischinsky (1995).

    ``z' = v - k |v| z / g(v)``, force ``k z + c z'``, ``g = F_c + (F_s - F_c) exp(-(v/v_s)²)``.
    """
    stiffness = max(kinetic, static) / 0.004  # N m/rad: gives way after 4 mrad
    inertia = _inertia(site)
    damping = 0.3 * math.sqrt(stiffness * inertia)

    def law(_: float, v: float, plant: Plant, memory: dict) -> float:
        level = kinetic + (static - kinetic) * math.exp(-((v / speed) ** 2))
        z = memory.get("z", 0.0)
        rate = stiffness * abs(v) / max(level, 1e-9)
        held = v / rate if rate > 1e-9 else 0.0
        new = held + (z - held) * math.exp(-rate * plant.dt) if rate > 1e-9 else z + v * plant.dt
        memory["z"] = new
        return -(stiffness * new + damping * math.exp(-abs(v) / speed) * (new - z) / plant.dt)

    return Forces(site, law)


def _inertia(site: Site) -> float:
    data, full = mujoco.MjData(site.model), np.zeros((site.model.nv, site.model.nv))
    mujoco.mj_forward(site.model, data)
    mujoco.mj_fullM(site.model, data, full)
    return float(full[site.dof, site.dof])


def _dry(v: float) -> float:
    return math.tanh(v / _SOFT)


def coulomb(site: Site) -> Made:
    """Constant against the motion; or bristles."""
    s = site.draw(0.005, 0.2) * site.torque
    truth = site.truth("coulomb_friction", "body", N_m=s, N=s)
    if not site.same:
        return _bristle(site, s, s, 0.1), truth
    return Forces(site, lambda _q, v, *_: -s * _dry(v)), truth


def stribeck(site: Site) -> Made:
    """Friction of slow motion only; or bristles with little kinetic friction."""
    s, speed = site.draw(0.0125, 0.25) * site.torque, site.draw(0.15, 0.4)
    truth = site.truth("stribeck_friction", "body")
    if not site.same:
        return _bristle(site, 0.1 * s, s, speed), truth
    return Forces(site, lambda _q, v, *_: -s * math.exp(-((v / speed) ** 2)) * _dry(v)), truth


def viscous(site: Site) -> Made:
    """Proportional to speed; or to a lower power of it."""
    s = site.draw(0.0075, 0.3) * site.torque
    power = 1.0 if site.same else 0.8
    truth = site.truth("viscous_friction", "body", **{"N_m_s/rad": s, "N_s/m": s})
    return Forces(site, lambda _q, v, *_: -s * math.copysign(abs(v) ** power, v)), truth


def drag(site: Site) -> Made:
    """Proportional to speed squared; or to a lower power of it."""
    s = site.draw(0.0025, 0.1) * site.torque
    power = 2.0 if site.same else 1.7
    truth = site.truth("quadratic_drag", "body", **{"N_m_s²/rad²": s, "N_s²/m²": s})
    return Forces(site, lambda _q, v, *_: -s * math.copysign(abs(v) ** power, v)), truth


def load_dependent(site: Site) -> Made:
    """Proportional to the motor's torque; or to motor minus external torque."""
    s = site.draw(0.0125, 0.35)

    def law(_: float, v: float, plant: Plant, memory: dict) -> float:  # noqa: ARG001
        load = plant.data.qfrc_actuator[site.dof]
        if not site.same:
            load = load + plant.data.qfrc_bias[site.dof]
        return -s * abs(load) * _dry(v)

    return Forces(site, law), site.truth("load_dependent_friction", "body", fraction=s)


def directional(site: Site) -> Made:
    """Dry friction in one direction only; or with a soft beginning."""
    s, side = site.draw(0.01, 0.25) * site.torque, site.sign()

    def law(_: float, v: float, *__: object) -> float:
        v *= side
        share = _dry(v) if site.same else 1 - math.exp(-max(v, 0.0) / 0.15)
        return -side * s * share if v > 0 else 0.0

    truth = site.truth("directional_friction", "body", N_m=side * s, N=side * s)
    return Forces(site, law), truth


def spring(site: Site) -> Made:
    """Proportional to the angle; or hardening."""
    s = site.draw(0.0075, 0.4) * site.torque
    cubic = 0.0 if site.same else 0.4
    truth = site.truth("parallel_spring", "body", **{"N_m/rad": s, "N/m": s})
    return Forces(site, lambda q, *_: -s * q * (1 + cubic * q * q)), truth


def tilt(site: Site) -> Made:
    """Gravity is turned about the axis of the joints; or about another axis a little too."""
    s = site.sign() * site.draw(0.005, 0.3)

    def law(model: mujoco.MjModel) -> None:
        g = float(np.linalg.norm(model.opt.gravity))
        roll = 0.0 if site.same else 0.6 * s
        model.opt.gravity[:] = (
            g * math.sin(s), g * math.sin(roll) * math.cos(s), -g * math.cos(s) * math.cos(roll)
        )  # fmt: skip

    return Writes(law), site.truth("gravity_tilt", "body", joint="all", rad=-s)


def periodic(site: Site) -> Made:
    """A sine of time; or with a third harmonic."""
    s, hertz = site.draw(0.0075, 0.2) * site.torque, site.draw(0.5, 6.0)
    phase = site.rng.uniform(0, 2 * math.pi)

    def law(_q: float, _v: float, plant: Plant, _m: dict) -> float:
        angle = 2 * math.pi * hertz * plant.time + phase
        return s * (math.sin(angle) + (0.0 if site.same else 0.3 * math.sin(3 * angle)))

    return Forces(site, law), site.truth("periodic_disturbance", "body", N_m=s, N=s)


def cogging(site: Site) -> Made:
    """A sine of the angle; or with a second harmonic."""
    s, teeth = site.draw(0.0075, 0.2) * site.torque, int(site.rng.integers(3, 13))
    phase = site.rng.uniform(0, 2 * math.pi)

    def law(q: float, *_: object) -> float:
        angle = teeth * q + phase
        return s * (math.sin(angle) + (0.0 if site.same else 0.4 * math.sin(2 * angle)))

    return Forces(site, law), site.truth("cogging", "body", N_m=s, N=s)


def _moving_body(site: Site) -> int:
    joints = [j for j in range(site.model.njnt) if site.model.jnt_dofadr[j] == site.dof]
    return int(site.model.jnt_bodyid[joints[0]])


def payload(site: Site) -> Made:
    """More mass, spread as the body's; or a point mass at the far end, and beside it."""
    body, share = _moving_body(site), site.draw(0.02, 0.6)

    def law(model: mujoco.MjModel) -> None:
        mass = model.body_mass[body]
        if site.same:
            model.body_inertia[body] *= 1 + share
        else:  # twice as far as the centre, and half of that towards x
            offset = model.body_ipos[body].copy()
            offset[0] += 0.5 * float(np.linalg.norm(offset))
            model.body_ipos[body] += offset * share / (1 + share)
            model.body_inertia[body][:2] += mass * share / (1 + share) * offset @ offset
        model.body_mass[body] = mass * (1 + share)

    kilograms = share * float(site.model.body_mass[body])
    return Writes(law), site.truth("payload", "body", kg=kilograms, fraction=share)


def com_shift(site: Site) -> Made:
    """The centre of mass lies elsewhere, along the body or to its side."""
    body, s = _moving_body(site), site.sign() * site.draw(0.0025, 0.06)
    axis = 0 if site.same else 2

    def law(model: mujoco.MjModel) -> None:
        model.body_ipos[body, axis] += s

    return Writes(law), site.truth("com_shift", "body")


def armature(site: Site) -> Made:
    """The rotor is heavier."""
    s = site.draw(0.125, 6.0)

    def law(model: mujoco.MjModel) -> None:
        model.dof_armature[site.dof] *= 1 + s

    kilograms = s * float(site.model.dof_armature[site.dof])
    return Writes(law), site.truth("armature", "body", **{"kg_m²": kilograms, "kg": kilograms})


def contact_friction(site: Site) -> Made:
    """Slippery ground; or that, with an elliptic cone."""
    s = site.draw(0.075, 0.9)

    def law(model: mujoco.MjModel) -> None:
        model.geom_friction[:, 0] *= 1 - s
        if not site.same:
            model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC

    return Writes(law), site.truth("contact_friction", "contact", joint="all", fraction=s)


def contact_softness(site: Site) -> Made:
    """Contacts that give way more slowly; or that, with another impedance."""
    s = site.draw(0.15, 4.0)

    def law(model: mujoco.MjModel) -> None:
        model.geom_solref[:, 0] *= 1 + s
        if not site.same:
            model.geom_solimp[:, 0] *= 0.8

    return Writes(law), site.truth("contact_softness", "contact", joint="all", fraction=s)


BODY = {
    "coulomb_friction": coulomb, "stribeck_friction": stribeck, "viscous_friction": viscous,
    "quadratic_drag": drag, "load_dependent_friction": load_dependent,
    "directional_friction": directional, "parallel_spring": spring, "gravity_tilt": tilt,
    "periodic_disturbance": periodic, "cogging": cogging, "payload": payload,
    "com_shift": com_shift, "armature": armature,
}  # fmt: skip
CONTACT = {"contact_friction": contact_friction, "contact_softness": contact_softness}
