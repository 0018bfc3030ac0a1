"""Joint friction that depends on speed, direction or load, at every time step.

Dry friction raises ``frictionloss`` and viscous friction ``damping``, which MuJoCo solves
implicitly: joints stick, and large values stay stable. Strengths are per joint; ``v`` is the
joint's velocity, ``F_max`` and ``v_max`` its force and velocity scales. Friction without these
dependences is in `joints`. Sources: Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30
(1994) for the laws; Duclusaud et al., arXiv 2410.08650, for load; Dahl, Aerospace Corporation
TOR-0158(3107-18)-1 (1968), for presliding.
"""

from __future__ import annotations

__all__ = [
    "DirectionalFriction",
    "LoadDependentFriction",
    "PowerLawFriction",
    "PreslidingFriction",
    "QuadraticDrag",
    "StribeckFriction",
]

from collections.abc import Mapping

import torch
from torch import Tensor

from ..scalars import check_number
from .effect import Effect, ForceEffect, Memory, Now, Reach
from .history import filled
from .laws import within
from .robot import Robot

_PRESLIDING, _SHORTEST = 0.005, 0.0005  # rad or m
_KINETIC = 0.5  # of friction at rest
_FADED = 1e-6  # of friction at rest: never quite nothing
_ONSET = 0.1  # rad/s or m/s
_SLOWEST = 1e-6  # of that
_CREEP = 0.01  # rad/s or m/s
_FALLING = -0.5  # of a damping's force, at a velocity beyond which it falls with that
_THINNEST, _THICKEST = 0.5, 1.5  # powers
_SHARP = 0.005  # rad/s or m/s: an onset that no time step resolves


class PreslidingFriction(ForceEffect):
    """Dry friction of ``s`` that gives way before it slides, as bristles do; N m or N.

    Up to 30 % of ``F_max``. The law of Dahl (1968), for bristles that are bent by ``z``::

        force −k z,  ż = v − |v| z / z_s,  k = s / z_s,

    solved exactly for the speed at the beginning of a time step, and to first order, as a damping,
    for what the speed changes within it: what sticks is on a spring, however stiff. After every
    reversal friction turns round over a way of some ``z_s``.

    Args:
        presliding: ``z_s``, rad or m. A diagnosis fits it.

    Raises:
        ValueError: ``presliding`` is not above 0: friction without it is `joints.CoulombFriction`.
    """

    name, unit, group = "coulomb_friction", "N m", "friction"

    def __init__(self, presliding: float = _PRESLIDING) -> None:
        check_number("presliding, a way before friction slides", presliding, above=0.0)
        self.presliding = presliding

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the way, up to a tenth of the robot's."""
        return {"presliding": (0.05 * self.presliding, _SHORTEST, _farthest(reach))}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.3 ``F_max``."""
        return within(robot.force_scale, 0.0, 0.3)

    def start(self, velocity: Tensor) -> Memory:
        """Return nothing known of the bristles: bent as if the joint had moved on and on."""
        return _unknown(velocity)

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the bristles' force at the end of this time step."""
        return _bristles(strength, memory, now, presliding=self.presliding)


class StribeckFriction(ForceEffect):
    """Dry friction that fades with speed: ``s g``; N m or N, up to 30 % of ``F_max``.

    To ``c`` of it: ``g = c + (1 − c) e^{−(v/v_s)²}``, where ``c s`` is kinetic friction. With
    presliding it gives way before it slides, as bristles that are bent by ``z`` do::

        force −k z,  ż = v − |v| z / (z_s g),  k = s / z_s,

    the law of Canudas de Wit, Olsson, Åström & Lischinsky, IEEE Transactions on Automatic Control
    40 (1995), without a damping of the bristles and viscous friction. It is solved as that of
    `PreslidingFriction` is, with what has faded held over a time step.

    Args:
        speed: ``v_s``, rad/s or m/s. A diagnosis fits it.
        presliding: ``z_s``, rad or m; less than 0.0005 is 0, for none: bristles that stiff are
            faster than a time step. A diagnosis fits it.
        kinetic: ``c``, from 0 to 1. A diagnosis fits it, up to a half: what fades less is Coulomb
            friction, for the most part.

    Raises:
        ValueError: ``speed`` is not above 0, ``presliding`` is negative, or ``kinetic`` is outside
            0 to 1.

    Example:
        >>> StribeckFriction(presliding=0.004, kinetic=0.1).form
        {'speed': 0.2, 'presliding': 0.004, 'kinetic': 0.1}
    """

    name, unit, group = "stribeck_friction", "N m", "friction"

    def __init__(
        self, speed: float = 0.2, presliding: float = 0.0, *, kinetic: float = 0.0
    ) -> None:
        check_number("speed at which friction fades", speed, above=0.0)
        check_number("presliding, a way before friction slides", presliding, least=0.0)
        check_number("kinetic, a share of friction", kinetic, least=0.0, most=1.0)
        self.speed, self.presliding = speed, presliding if presliding >= _SHORTEST else 0.0
        self.kinetic = kinetic

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the speed, up to a quarter of the largest, the way, and what does not fade.

        Beyond that speed friction hardly fades.
        """
        return {
            "speed": (0.05 * self.speed, 0.02, max(0.25 * reach.velocity, self.speed)),
            "presliding": (_SHORTEST, 0.0, _farthest(reach)),
            "kinetic": (0.02, 0.0, max(_KINETIC, self.kinetic)),
        }

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.3 ``F_max``."""
        return within(robot.force_scale, 0.0, 0.3)

    def start(self, velocity: Tensor) -> Memory:
        """Return nothing known of the bristles, if there are any."""
        return _unknown(velocity) if self.presliding else {}

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the dry friction at this speed, or the bristles' force."""
        faded = torch.exp(-((now.velocity / self.speed) ** 2))
        level = self.kinetic + (1 - self.kinetic) * faded
        if not self.presliding:
            return {"frictionloss": strength * level}, memory
        level = level.clamp(min=_FADED)
        return _bristles(strength, memory, now, presliding=self.presliding, level=level)


def _unknown(velocity: Tensor) -> Memory:
    return {"bent": torch.full_like(velocity, torch.nan)}


def _farthest(reach: Reach) -> float:
    """Return the longest way before friction slides, a tenth of the robot's."""
    return max(0.1 * reach.position, 2 * _PRESLIDING)


def _bristles(
    strength: Tensor, memory: Memory, now: Now, *, presliding: float, level: Tensor | float = 1.0
) -> tuple[Mapping[str, Tensor], Memory]:
    """Return the force of bristles at the end of a time step, and how far they are bent by then.

    Args:
        strength: ``s``, shape ``(*batch, J)``.
        memory: How far they are ``bent`` at its beginning, of the same shape; NaN if unknown.
        now: The time step.
        presliding: ``z_s``, for friction that has not faded.
        level: What is left of friction at this speed, above 0 to 1, of the same shape.

    Returns:
        ``force`` and ``damping``, and the new memory.
    """
    sign, stiffness, way = now.velocity.sign(), strength / presliding, presliding * level
    slid = way * sign
    before = filled(memory["bent"], slid)
    left = torch.exp(-now.velocity.abs() * now.timestep / way)
    after = slid + (before - slid) * left
    # the derivative of k z by the speed; bristles that spring back as friction fades damp nothing
    damping = stiffness * now.timestep * (1 - sign * before / way).clamp(min=0.0) * left
    force = damping * now.velocity - stiffness * after
    return {"force": force, "damping": damping}, {"bent": after}


class _PowerLaw(ForceEffect):
    """A force ``−s v |v|ᵖ⁻¹``, as a damping.

    With ``p`` below 1 that is as large at rest as at a speed of 0.01, and no larger: fluids that
    thin with speed do not where they creep, and a damping without bound would be unstable.
    """

    def __init__(self, power: float) -> None:
        check_number("power, of speed", power, above=0.0)
        self.power = power

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the damping at this speed."""
        speed = now.velocity.abs()
        speed = speed.clamp(min=_CREEP) if self.power < 1 else speed
        return {"damping": strength * speed ** (self.power - 1)}, memory


class QuadraticDrag(_PowerLaw):
    """Drag ``−s v |v|ᵖ⁻¹``, ``p = 2``, as a damping; N m s²/rad², up to ``F_max / v_max²``.

    Args:
        power: ``p``; a diagnosis fits it.

    Raises:
        ValueError: ``power`` is not above 0.
    """

    name, unit, group = "quadratic_drag", "N m s²/rad²", "friction"

    def __init__(self, power: float = 2.0) -> None:
        super().__init__(power)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the power, nearer to 2 than to that of other friction."""
        del reach
        return {"power": (0.02, 1.5, 3.0)}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and ``F_max / v_max²``."""
        return within(robot.force_scale / robot.velocity_scale**2, 0.0, 1.0)


class PowerLawFriction(_PowerLaw):
    """Damping ``−s v |v|ᵖ⁻¹`` by a lubricant that thins with speed, or thickens; N m s/rad.

    The power law of Ostwald (1925) and de Waele for such fluids, whose viscosity goes with the
    power ``p − 1`` of the shear; ``s`` is the damping at a speed of 1. Up to 1.2 ``F_max / v_max``,
    whatever the power.

    Args:
        power: ``p``, 1 for a fluid that does neither; a diagnosis fits it.

    Raises:
        ValueError: ``power`` is not above 0.
    """

    name, unit, group = "viscous_friction", "N m s/rad", "friction"

    @classmethod
    def like(cls, rise: float, velocity: float) -> PowerLawFriction:
        """Return the law whose force bends as ``v (1 + r v)`` does at a velocity.

        As nearly as powers of 0.5 to 1.5 do, beyond which a diagnosis fits none.

        Example:
            >>> PowerLawFriction.like(-0.1, velocity=2.0)
            PowerLawFriction(power=0.75)
        """
        part = max(rise * velocity, _FALLING)
        return cls(power=min(max(1.0 + part / (1.0 + part), _THINNEST), _THICKEST))

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the power, nearer to 1 than to that of other friction."""
        del reach
        return {"power": (0.02, _THINNEST, _THICKEST)}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 1.2 ``F_max / v_max``."""
        return within(robot.force_scale / robot.velocity_scale, 0.0, 1.2)


class LoadDependentFriction(ForceEffect):
    """Dry friction in proportion to a joint's load: ``s |F|``; a fraction, 0 to 0.4.

    The load is the actuators' force; or, as in Duclusaud et al. (2024), that minus the force from
    outside: ``F = τ_motor + τ_bias``, with ``τ_bias`` what holds a robot against gravity, Coriolis
    and centrifugal forces (``qfrc_bias``). At joints without an actuator the load is the latter.

    Or one that begins softly, as of greased teeth: ``s |F| (1 − e^{−|v| / v_0})``.

    Args:
        external: Whether the load counts forces from outside where there is an actuator, too.
        onset: ``v_0``, rad/s or m/s; friction is all there at once below 0.005, which no time step
            resolves. A diagnosis fits it.

    Raises:
        ValueError: ``onset`` is below 0.
    """

    name, unit, group = "load_dependent_friction", "fraction", "friction"

    def __init__(self, *, external: bool = False, onset: float = 0.0) -> None:
        check_number("onset, a speed over which friction begins", onset, least=0.0)
        self.external, self.onset = external, onset

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return friction under the actuators' force, and under that from outside, too."""
        del seconds
        return LoadDependentFriction(), LoadDependentFriction(external=True)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the speed of a soft beginning, up to a tenth of the largest, or to that it has."""
        most = max(0.1 * reach.velocity, _ONSET, self.onset)
        return {"onset": (max(4 * _SHARP, 0.05 * self.onset), 0.0, most)}

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of the joints, none if no actuator moves one."""
        moved = any(j >= 0 for j in robot.joint_of_actuator)
        return super().targets(robot) if moved else ()

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return 0 and 0.4, or 0 where nothing is joined: a base that moves freely.

        And at joints without an actuator if ``external``, where both are the same.
        """
        driven = [j in robot.joint_of_actuator for j in range(len(robot.joints))]
        loaded = torch.tensor(driven, dtype=torch.bool)
        high = 0.4 * (loaded if self.external else loaded | robot.passive).double()
        return torch.zeros_like(high), high

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the dry friction under this load."""
        outside = now.robot.passive | self.external
        load, weighed = now.load, strength[..., outside].any(-1)
        if weighed.any():  # what is outside takes as long as a time step
            load = load + torch.where(outside, now.bias_of(weighed), 0.0)
        force = strength * load.abs()
        if self.onset >= _SHARP:  # as dry friction: a damping exceeds it where a step reverses
            force = force * -torch.expm1(-now.velocity.abs() / self.onset)
        return {"frictionloss": force}, memory


class DirectionalFriction(ForceEffect):
    """Dry friction ``|s|`` in one direction only: where ``v`` has the sign of ``s``.

    Half of it is dry friction in both directions, half a force that helps in the other: so what
    sticks is held by as much as there is. N m or N, up to 30 % of ``F_max`` in either direction.

    Or one that begins softly, as of a brush or a lip seal that is dragged along, and holds nothing
    that stands: ``|s| (1 − e^{−|v| / v_0})``, as a damping.

    Args:
        onset: ``v_0``, rad/s or m/s; 0 for friction that is all there at once. A diagnosis fits it.
    """

    name, unit, group = "directional_friction", "N m", "friction"

    def __init__(self, onset: float = 0.0) -> None:
        check_number("onset, a speed over which friction begins", onset, least=0.0)
        self.onset = onset

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return friction that is there at once, and one that begins softly."""
        del seconds
        return DirectionalFriction(), DirectionalFriction(onset=_ONSET)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the speed of a soft beginning, up to a quarter of the largest."""
        if not self.onset:
            return {}
        return {"onset": (0.05 * self.onset, 0.01, max(0.25 * reach.velocity, self.onset))}

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return ±0.3 ``F_max``."""
        return within(robot.force_scale, -0.3, 0.3)

    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return the friction in this direction."""
        if not self.onset:
            return {"frictionloss": strength.abs() / 2, "force": -strength / 2}, memory
        along = now.velocity * strength.sign()
        speed = along.clamp(min=_SLOWEST * self.onset) / self.onset
        damping = strength.abs() / self.onset * -torch.expm1(-speed) / speed
        return {"damping": torch.where(along > 0, damping, 0.0)}, memory
