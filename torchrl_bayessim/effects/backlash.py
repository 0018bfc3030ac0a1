"""A gap between motor and joint, at every time step; see `rotors`."""

from __future__ import annotations

__all__ = ["Backlash"]

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ..errors import message
from ..kinds import check_kind
from ..scalars import check_number
from .effect import Effect, Memory, Now, Reach
from .history import filled
from .robot import Robot
from .rotors import at_rest, handed_on, lag, reduced, rotors, seen
from .transmission import TransmissionEffect, at_actuators, change

_DAMPED = 0.3  # of the critical damping: what a shaft and its teeth have
_TURN, _PARTS = 2.0, 16  # parts per radian of its own motion, at most
_TOO_LATE = 1.02  # radians times that, in a part: where more parts would be needed
_WINDS = 0.05, 20.0  # widths of the gap: stops nearly dead, and nearly no gap
_SOFT = 3.0  # the same; what is stiffer is found from there


class Backlash(TransmissionEffect):
    """A gap of width ``s``: no force passes until the motor has crossed it.

    The motor's place in the gap ``β ∈ [−s/2, s/2]`` follows ``β̇ = v_max F / F_max``, the speed at
    which it leaves the joint while nothing holds it; force passes at the side that it pushes. In
    rad or m of the joint, up to 0.1 (6°).

    Args:
        rotor: Whether the motor's rotor is free in the gap instead, ``I β̈ = F − I a J / M``, and
            stops dead at a side, where the joint gets its momentum: ``F − I Δβ̇ / Δt`` passes. Only
            motors with an armature have that; others are rigid.
        wind: By how many widths of the gap the motor's largest force winds the shaft up, with a
            free rotor: it meets a spring ``k = F_max / (wind · s)`` at the sides ``±s/2``, with
            0.3 of the critical damping, ``I ẍ = F − I a J / M − (k (x ∓ s/2) + c ẋ) J / M``
            beyond them (Nordin & Gutman, Automatica 38, 2002, section 2). A diagnosis fits it.

    Raises:
        TypeError: ``rotor`` is not a bool, or ``wind`` no number.
        ValueError: ``wind`` is negative, or there is one without a free rotor.
    """

    name, unit, group = "backlash", "rad", "elasticity"

    def __init__(self, *, rotor: bool = False, wind: float = 0.0) -> None:
        check_kind("rotor to be true or false", rotor, bool)
        check_number("wind, in widths of the gap", wind, least=0.0)
        if wind and not rotor:
            expected = "a rotor that winds a shaft up (a gap that a force leads has no spring)"
            raise ValueError(message(expected, f"rotor=False, wind={wind}", hint="rotor=True"))
        self.rotor, self.wind = rotor, wind

    @property
    def nuisances(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """How far a shaft that has a spring is wound up: no value is the usual one."""
        return ("wind",) if self.wind else ()

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the wind-up of a shaft that has a spring."""
        del reach
        return {"wind": (0.1 * self.wind, *_WINDS)} if self.wind else {}

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return the law of a force that leads, and those of a rotor, on a stiff or soft shaft."""
        del seconds
        return Backlash(), Backlash(rotor=True), Backlash(rotor=True, wind=_SOFT)

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the actuators' names, for a rotor those that have some armature."""
        names = super().targets(robot)
        return names if not self.rotor or (names and bool((rotors(robot) > 0).any())) else ()

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and a tenth of a radian or of the joint's range."""
        wide = 0.1 * at_actuators(robot.position_scale, robot).clamp(max=1.0)
        if self.rotor:
            wide = torch.where(rotors(robot) > 0, wide, 0.0)
        return torch.zeros_like(wide), wide

    def start(self, velocity: Tensor) -> Memory:
        """Return no place in the gap yet: the first force finds its side."""
        gap = velocity.new_full((*velocity.shape[:-1], 1), torch.nan)
        if not self.rotor:
            return {"gap": gap}
        return {"gap": gap, "speed": torch.zeros_like(gap), **at_rest(gap)}

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the change of commands."""
        _, _, gear = now.robot.actuator_limits
        half = strength / 2
        gap = filled(memory["gap"], (now.actuator_force * gear).sign() * half)
        if not self.rotor:
            passed, gap = _led(half, gap, now)
            return change(passed, now), {"gap": gap}
        if self.wind:
            passed, gap, speed = _sprung(half, gap, memory, now, wind=self.wind)
        else:
            passed, gap, speed = _free(half, gap, memory, now)
        return handed_on(passed, now), {"gap": gap, "speed": speed, **seen(passed, now)}


def _led(half: Tensor, gap: Tensor, now: Now) -> tuple[Tensor, Tensor]:
    """Return the mean force that passes, and the place in the gap of what its force moves."""
    largest, fastest, gear = now.robot.actuator_limits
    force = now.actuator_force
    way = now.timestep * fastest / gear * force / largest
    beyond = (gap + way) * (force * gear).sign() - half
    share = torch.where(way != 0, beyond / way.abs(), 1.0).clamp(0.0, 1.0)
    return force * share, (gap + way).clamp(-half, half)


def _free(half: Tensor, gap: Tensor, memory: Memory, now: Now) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean force that passes, the rotor's place in the gap and its speed."""
    _, _, gear = now.robot.actuator_limits
    rotor = rotors(now.robot).to(gap)
    inertia = torch.where(rotor > 0, rotor, 1.0) / gear
    gain = now.timestep * (now.actuator_force - lag(memory, now)) / inertia
    there = gap + now.timestep * (memory["speed"] + gain / 2)
    after = torch.where((there.abs() < half) & (rotor > 0), memory["speed"] + gain, 0.0)
    taken = inertia * (after - memory["speed"]) / now.timestep
    return now.actuator_force - taken, there.clamp(-half, half), after


def _sprung(
    half: Tensor, gap: Tensor, memory: Memory, now: Now, *, wind: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the same where a spring is at the sides: exact in the gap, and exact beyond it.

    A side is met between parts of a time step. Where the spring is so stiff that it would be wound
    up by then, the rotor meets it at the side, or bounces would gain what they never had.
    """
    largest, _, gear = now.robot.actuator_limits
    rotor = rotors(now.robot).to(gap)
    inertia = torch.where(rotor > 0, rotor, 1.0) / gear
    push = (now.actuator_force - lag(memory, now)) / inertia
    there = (half > 0) & (rotor > 0)
    give = 2 * wind * torch.where(there, half, 1.0) / (largest * gear.abs())
    omega = 1 / (give * torch.where(rotor > 0, reduced(now.robot).to(gap), 1.0)).sqrt()
    # as many as its own motion needs, whatever is beside it
    parts = (_TURN * omega * now.timestep).ceil().clamp(1, _PARTS)
    dt = now.timestep / parts
    late = _TURN * omega * dt > _TOO_LATE
    rings = omega * math.sqrt(1 - _DAMPED**2)
    left = torch.exp(-_DAMPED * omega * dt)
    cosine, sine = left * (rings * dt).cos(), left * (rings * dt).sin() / rings
    wound, speed = push / omega**2, memory["speed"]
    gap = torch.where(memory["gap"].isnan(), gap + wound, gap)  # of the first force at rest
    for part in range(int(parts.max())):
        side = gap.clamp(-half, half) + wound  # where the spring would come to rest
        off, slope = gap - side, speed + _DAMPED * omega * (gap - side)
        touches = (gap.abs() > half) | (late & (gap.abs() == half) & (gap * speed > 0))
        rate = cosine * slope - sine * rings**2 * off
        held = side + cosine * off + sine * slope
        free = gap + dt * (speed + dt * push / 2)
        free = torch.where(late, free.clamp(-half, half), free)
        slower = torch.where(touches, rate - _DAMPED * omega * (held - side), speed + dt * push)
        gap = torch.where(part < parts, torch.where(touches, held, free), gap)
        speed = torch.where(part < parts, slower, speed)
    gap, speed = torch.where(there, gap, 0.0), torch.where(there, speed, 0.0)
    return now.actuator_force - inertia * (speed - memory["speed"]) / now.timestep, gap, speed
