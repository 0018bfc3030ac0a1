"""A spring between motor and joint, at every time step; see `rotors`."""

from __future__ import annotations

__all__ = ["SeriesElasticity"]

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ..scalars import check_number
from .effect import Memory, Now, Reach
from .history import filled
from .robot import Robot
from .rotors import at_rest, handed_on, lag, reduced, seen
from .transmission import TransmissionEffect


class SeriesElasticity(TransmissionEffect):
    """A spring of stiffness ``k = 1/s`` between motor and joint, seen by the joint as a resonance.

    ``I ẍ (1 − I/J) = F (1 − I/J) − k x − c ẋ − I a`` with ``c = 2 ζ √(k μ)``, ``μ = I M / J``;
    without an armature the spring has the whole joint's inertia, ``J ẍ = F − k x − c ẋ``. Solved
    exactly over each time step: stiff springs are stable, and the limit ``s = 0`` is a rigid shaft.
    In rad/(N m) or m/N, up to a resonance ``√(k/μ)`` of 2 Hz.

    Args:
        damping: ``ζ``, a fraction of the critical damping. A diagnosis fits it, from so much that a
            search for the period finds its way.

    Raises:
        ValueError: ``damping`` is not at least 0 and below 1: the spring would not ring.
    """

    name, unit, group = "series_elasticity", "rad/(N m)", "elasticity"
    search_power = 2.0  # the period shows
    nuisances = ("damping",)

    def __init__(self, damping: float = 0.3) -> None:
        check_number("damping of a spring, a fraction of the critical", damping, least=0.0, below=1)
        self.damping = damping

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the damping."""
        del reach
        return {"damping": (0.01, 0.01, 0.9)}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and the compliance that resonates at 2 Hz."""
        soft = 1 / (reduced(robot) * (2 * math.pi * 2.0) ** 2)
        return torch.zeros_like(soft), soft

    def start(self, velocity: Tensor) -> Memory:
        """Return no deflection yet: the first force is in equilibrium."""
        unknown = velocity.new_full((*velocity.shape[:-1], 1), torch.nan)
        return {"load": unknown, "rate": torch.zeros_like(unknown), **at_rest(unknown)}

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the change of commands.

        With ``y = k x J / M`` the equation is ``ÿ = ω² (F − I a J / M − y) − 2 ζ ω ẏ`` for
        ``ω² = k / μ``, and ``F − Δẏ / (ω² Δt)`` passes.
        """
        pull, damping = now.actuator_force - lag(memory, now), self.damping
        inertia = reduced(now.robot).to(pull)
        omega = 1 / (torch.where(strength > 0, strength, 1.0) * inertia).sqrt()
        ringing = omega * math.sqrt(1 - damping**2)
        left = torch.exp(-damping * omega * now.timestep)
        phase = ringing * now.timestep
        off = filled(memory["load"], pull) - pull
        slope = (memory["rate"] + damping * omega * off) / ringing
        after = left * (off * phase.cos() + slope * phase.sin())
        rate = (
            left * ((slope * phase.cos() - off * phase.sin()) * ringing) - damping * omega * after
        )
        mean = now.actuator_force - (rate - memory["rate"]) / (omega**2 * now.timestep)
        passed = torch.where(strength > 0, mean, now.actuator_force)
        load = torch.where(strength > 0, pull + after, pull)
        rate = torch.where(strength > 0, rate, 0.0)
        return handed_on(passed, now), {"load": load, "rate": rate, **seen(passed, now)}
