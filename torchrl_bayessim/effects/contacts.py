"""Friction and softness of contacts, of all geoms at once.

MuJoCo takes the larger of two geoms' friction and mixes their softness by weight
(https://mujoco.readthedocs.io/en/stable/modeling.html#contact-parameters), so that scaling one of
them need not change the contact: all are scaled, and contact pairs with parameters of their own.
"""

from __future__ import annotations

__all__ = ["ContactFriction", "ContactSoftness"]

import mujoco
import torch
from torch import Tensor

from .effect import Fields, ModelEffect
from .robot import Robot


class _Contact(ModelEffect):
    channel = "contact"

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return ``all``, nothing for a model without contacts."""
        model = robot.model
        if model is None or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
            return ()
        touching = any(_meet(model, a, b) for a in range(model.ngeom) for b in range(a))
        return ("all",) if touching or model.npair else ()


def _meet(model: mujoco.MjModel, a: int, b: int) -> bool:
    """Return whether two geoms can touch, by MuJoCo's filters."""
    bodies = [int(model.body_weldid[model.geom_bodyid[g]]) for g in (a, b)]
    parents = [int(model.body_weldid[model.body_parentid[body]]) for body in bodies]
    if bodies[0] == bodies[1]:
        return False
    related = bodies[0] == parents[1] or bodies[1] == parents[0]
    if related and 0 not in bodies:  # a body touches its parent only if that is the world
        return False
    types, affinities = model.geom_contype, model.geom_conaffinity
    return bool(types[a] & affinities[b] or types[b] & affinities[a])


class ContactFriction(_Contact):
    """Sliding friction is scaled: ``(1 + s) μ``; a fraction, −0.95 to 1."""

    name, unit, group = "contact_friction", "fraction", "contact"

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return −0.95 and 1."""
        del robot
        return torch.tensor([-0.95]).double(), torch.tensor([1.0]).double()

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Scale the friction of geoms, and both directions of pairs."""
        entries = [("geom_friction", (g, 0)) for g in range(robot.require_model().ngeom)]
        entries += [
            ("pair_friction", (p, i)) for p in range(robot.require_model().npair) for i in (0, 1)
        ]
        for entry in entries:
            fields[entry] = fields[entry] * (1 + strength[..., 0])


class ContactSoftness(_Contact):
    """The time constant of contacts is scaled: ``(1 + s) T``; a fraction, −0.8 to 4.

    Where ``solref`` is given as stiffness and damping (negative numbers), they become
    ``k / (1 + s)²`` and ``c / (1 + s)``, which is the same.
    """

    name, unit, group = "contact_softness", "fraction", "contact"

    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return −0.8 and 4."""
        del robot
        return torch.tensor([-0.8]).double(), torch.tensor([4.0]).double()

    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Scale the reference of geoms and of pairs."""
        counts = {
            "geom_solref": robot.require_model().ngeom,
            "pair_solref": robot.require_model().npair,
        }
        factor = 1 + strength[..., 0]
        for field, count in counts.items():
            for g in range(count):
                time, damping = fields[field, (g, 0)], fields[field, (g, 1)]
                direct = time < 0
                fields[field, (g, 0)] = torch.where(direct, time / factor**2, time * factor)
                fields[field, (g, 1)] = torch.where(direct, damping / factor, damping)
